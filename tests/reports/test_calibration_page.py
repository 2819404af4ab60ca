"""The report shows the contents of the calibration and lists what it lacks."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from evercal.calibration.calibration import (
    Calibration,
    ErrorTerm,
    ImageUse,
    JointOffset,
)
from evercal.calibration.checks import Checks
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, UncertainPose
from evercal.reports.calibration_images import AnnotatedImages
from evercal.reports.calibration_page import (
    CalibrationPage,
    NamedCalibration,
    calibration_page,
    camera_views,
    difference,
    residual_chart,
)
from evercal.reports.overlay import LandmarkPicture
from evercal.reports.scene import Surroundings, ellipse
from evercal.robot.frame_names import FrameNames

from .html_reader import HtmlReader


def pose(quaternion: ArrayLike, translation: ArrayLike) -> SE3:
    return SE3(np.array(quaternion, np.float64), np.array(translation, np.float64))


MARKUP = "<script>alert(\"1\")</script> & '$x^{$'"
CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5, (0.1, 0.0, 0.0, 0.0))
POSE = pose([0.0, 1.0, 0.0, 0.0], [0.1, 0.05, 1.0])
GREY = np.full((120, 160, 3), 90, np.uint8)


def full(**changes: Any) -> Calibration:
    calibration = Calibration(
        "eye_to_hand",
        POSE,
        np.diag([1e-8, 4e-8, 9e-8, 1e-10, 1e-10, 4e-10]),
        FrameNames("panda_link0", camera="camera_optical"),
        CAMERA,
        (
            ImageUse("shots/a.png", True, "", 0.51, 0.012),
            ImageUse(
                "shots/b.png",
                False,
                "lies 20.8 mm and 1.14 deg from the other images",
                20.8,
            ),
            ImageUse("shots/c.png", False, "failed: too dark"),
        ),
        (
            ErrorTerm("landmarks and lens", 0.2, 0.001),
            ErrorTerm("scatter", 0.05, 0.0002),
        ),
        Checks.from_dict(
            {
                "repeatability_mm": 0.31,
                "repeatability_deg": 0.013,
                "held_out_mm": 2.25,
                "spots": 3,
            }
        ),
        "Good enough for bin picking. Move closer.",
        {
            "command": "calibrate",
            "scene": "cell",
            "map": "abc",
            "store": "cell.evercal",
        },
        "2026-01-02T03:04:05+00:00",
    )
    return replace(calibration, **changes)


def solved() -> Calibration:
    """A calibration without images and intrinsics."""
    return Calibration(
        "eye_in_hand", POSE, 1e-6 * np.eye(6), source={"command": "solve"}
    )


def read(
    calibration: Calibration,
    images: AnnotatedImages | None = None,
    store: str | None = None,
    older: Calibration | None = None,
    name: str = "c.json",
) -> tuple[HtmlReader, CalibrationPage]:
    before = None if older is None else NamedCalibration("old.json", older)
    file = NamedCalibration(name, calibration)
    page = calibration_page(file, images or AnnotatedImages(), store, before)
    return HtmlReader(page.html), page


def test_verdict_comes_first() -> None:
    reader, _ = read(full())
    # After title and style.
    assert reader.strings[3] == (
        "h1",
        "Good enough for bin picking",
    )
    assert reader.strings[4] == ("p", "Move closer.")
    # The uncertainty decides; the held-out error of 2.25 mm is that of one image.
    assert reader.strings[5] == ("strong", "0.37 mm")
    suitable = {row[0]: row[3] for row in reader.rows[1:4]}
    assert suitable == {
        "precision assembly": "yes",
        "bin picking": "yes",
        "tabletop tasks": "yes",
    }


@pytest.mark.parametrize(
    ("mm", "level", "headline"),
    [
        (0.5, "good", "Good for precision assembly"),
        (5.0, "fair", "Good for tabletop tasks"),
        (50.0, "bad", "Unusable"),
    ],
)
def test_verdict_has_its_colour(mm: float, level: str, headline: str) -> None:
    reader, page = read(
        full(checks=Checks.from_dict({"repeatability_mm": 2 * mm}), verdict="")
    )
    assert f'<header class="{level}"' in page.html
    assert reader.text("h1").startswith(headline)


def test_point_of_the_camera_has_a_standard_deviation_along_each_axis() -> None:
    page = calibration_page(
        NamedCalibration("c.json", full()), AnnotatedImages(), None, None, (0, 0, 2)
    )
    [row] = [row for row in HtmlReader(page.html).rows if row[0].startswith("point ")]
    assert (
        row[0]
        == "point (0, 0, 2) m of camera_optical along the axes of panda_link0 (mm)"
    )
    # 2 m ahead, 0.01 mrad about the camera's x and y are 0.02 mm across.
    across = [np.hypot(0.1, 0.02), np.hypot(0.2, 0.02), 0.3]
    rms = np.sqrt(np.mean(np.square(across)))
    assert row[1:] == [f"{value:.3f}" for value in (*across, rms)]
    assert "point (" not in read(full())[1].html


def test_every_image_and_reason_is_listed() -> None:
    calibration = full()
    reader, _ = read(calibration)
    rows = {row[1]: row for row in reader.rows if len(row) == 6}
    for image, name in zip(
        calibration.images, ("a.png", "b.png", "c.png"), strict=True
    ):
        assert rows[name][2] == ("yes" if image.used else "no")
        assert rows[name][3] == image.reason
    assert rows["a.png"][4:] == ["0.51", "0.012"]
    assert rows["b.png"][4:] == ["20.80", "-"]
    assert rows["c.png"][4:] == ["-", "-"]
    assert "1 of 3 images used, all in shots/" in reader.text("caption")


def test_transform_is_complete() -> None:
    reader, _ = read(full())
    assert "pose of camera_optical in panda_link0" in reader.text("p")
    assert "takes points from camera_optical to panda_link0" in reader.text("p")
    for order, numbers in (
        ("w, x, y, z", (0, 1, 0, 0)),
        ("x, y, z, w (ROS)", (1, 0, 0, 0)),
    ):
        shown = reader.row(f"quaternion {order}")[1].split(", ")
        assert shown == [f"{value:.8f}" for value in numbers]
    assert reader.row("translation x, y, z (mm)")[1] == "100.000, 50.000, 1000.000"
    matrix = np.array(reader.text("pre").split(), float).reshape(4, 4)
    assert matrix == pytest.approx(POSE.matrix())
    sigma = reader.row("position along the axes of panda_link0 (mm)")[1:]
    assert sigma == ["0.100", "0.200", "0.300", "0.216"]


def test_checks_ellipsoid_and_source_are_shown() -> None:
    reader, page = read(full())
    # sqrt of 7.815, the 95 % point of chi squared, times the standard deviations.
    assert "half axes of 0.84, 0.56 and 0.28 mm" in reader.text("figcaption")
    assert "lies 0 deg from the viewing direction" in reader.text("figcaption")
    assert reader.row("landmarks and lens")[1:] == ["0.20", "0.001", "94"]
    assert reader.row("all")[1:] == ["0.22", "0.001", "100"]
    for name, value in (
        ("command", "calibrate"),
        ("store", "cell.evercal"),
        ("scene", "cell"),
        ("spots", "3"),
        ("created", "2026-01-02T03:04:05+00:00"),
        ("image size (px)", "160x120"),
        ("fx (px)", "150.0000"),
        ("k1", "0.1000"),
        ("two halves of the data differ by (mm)", "0.31"),
    ):
        assert reader.row(name)[1] == value
    assert page.missing == ()
    assert reader.text("text").count("residual") == 2
    assert {f"{axis} of panda_link0 (m)" for axis in "xyz"} < {
        *reader.text("text").splitlines()
    }
    assert "lens: intrinsics" in page.html


def test_the_independent_check_is_named_or_what_to_do_for_one() -> None:
    reader, _ = read(full(checks=Checks.from_dict({"held_out_mm": 0.284})))
    assert "left out are predicted within 0.28 mm (median)" in reader.text("p")
    for page in (reader, read(solved())[0]):
        assert "run 'evercal verify c.json'" in " ".join(page.text("p").split())


def test_missing_contents_are_listed() -> None:
    nothing = AnnotatedImages(
        missing=("No pictures: the calibration holds no intrinsics.",)
    )
    reader, page = read(solved(), nothing)
    assert {sentence.split(":")[0] for sentence in page.missing} == {
        "No pictures",
        "No list of images",
        "No error budget",
        "No held-out error or repeatability",
        "No intrinsics",
    }
    assert reader.text("li").splitlines() == list(page.missing)
    assert reader.tags.count("figure") == 1  # the ellipsoid
    assert "Good for bin picking (within 3 mm" in reader.text("h1")


def test_verdict_without_any_measure_has_no_basis() -> None:
    reader, page = read(replace(solved(), covariance=np.zeros((6, 6)), source={}))
    assert "figure" not in reader.tags
    assert "this verdict has no basis" in reader.text("p")
    assert "No uncertainty" in {text.split(":")[0] for text in page.missing}


def test_all_strings_are_escaped() -> None:
    calibration = full(
        frames=FrameNames(gripper=MARKUP, camera="c" + MARKUP),
        images=(ImageUse(MARKUP, False, MARKUP, 1.0, 1.0),),
        error_terms=(ErrorTerm(MARKUP, 1.0, 1.0),),
        checks=Checks.from_dict({MARKUP: MARKUP}),
        verdict=MARKUP,
        source={MARKUP: MARKUP, "deep": {"a": [MARKUP]}},
        created=MARKUP,
    )
    images = AnnotatedImages({MARKUP: LandmarkPicture(GREY, 0, MARKUP)})
    reader, _ = read(calibration, images, MARKUP, calibration, MARKUP)
    assert not {"script", "a", "link", "iframe", "object"} & set(reader.tags)
    assert reader.text("h1") == MARKUP
    assert [MARKUP, MARKUP] in reader.rows


def test_pictures_show_the_origin_and_the_landmarks() -> None:
    images = AnnotatedImages(
        {
            "shots/a.png": LandmarkPicture(GREY, 12, "used; 12 landmarks"),
            "b.png": LandmarkPicture(GREY, 3, "used; 3 landmarks"),
        }
    )
    bare = full(images=(), covariance=np.zeros((6, 6)))
    reader, _ = read(bare, images, "cell.evercal")
    # K [R | t] by hand: the camera looks straight down from a metre above.
    assert "origin of panda_link0 projects to pixel (64.5, 67.0)" in reader.text("p")
    assert "a.png: used; 12 landmarks" in reader.text("figcaption")
    assert "landmarks of cell.evercal" in reader.text("p")
    assert len(reader.images) == 2
    behind = replace(bare, parent_from_child=pose([1.0, 0, 0, 0], [0, 0, 0.2]))
    reader, _ = read(behind, replace(images, other_map=True), "cell.evercal")
    assert "panda_link0 lies behind the camera" in reader.text("p")
    assert "is not the map of this calibration" in reader.text("p")


@pytest.mark.parametrize("sigma_mm", [0.01, 1.0, 300.0])
@pytest.mark.parametrize("mount", ["eye_to_hand", "eye_in_hand"])
def test_the_ellipsoid_fits_its_drawing(sigma_mm: float, mount: Any) -> None:
    covariance = (sigma_mm / 1000) ** 2 * np.diag([1.0, 4.0, 9.0, 1e-6, 1e-6, 1e-6])
    panels, _ = camera_views(full(mount=mount, covariance=covariance), Surroundings())
    for panel in panels:
        [shape] = [shape for shape in panel.shapes if shape.kind == "area"]
        (low, high), (first, last) = (
            panel.limits,
            (shape.points.min(0), shape.points.max(0)),
        )
        assert ((low < first) & (first < last) & (last < high)).all()


def test_bars_are_as_high_as_the_residuals_of_their_images() -> None:
    chart = residual_chart(full())
    assert chart is not None
    for panel, residuals, ticks in zip(
        chart[0], ((0.51, 20.8, 0), (0.012, 0, 0)), (0, 5), strict=True
    ):
        used, rejected = panel.shapes
        assert (used.kind, used.ink, rejected.kind, rejected.ink) == (
            "line", "blue", "stripes", "orange"
        )  # fmt: skip
        np.testing.assert_array_equal(used.points[:2], [(1, residuals[0]), (1, 0)])
        np.testing.assert_array_equal(
            rejected.points[[0, 1, 3]], [(2, residuals[1]), (2, 0), (3, 0)]
        )
        # The bar of the rejected image is cut: the chart ends at twice the largest used one.
        assert panel.limits[1, 1] == pytest.approx(
            min(2 * residuals[0], 1.1 * max(residuals))
        )
        numbers = [words for words, *_ in panel.texts if words.isdigit()]
        assert len(numbers) == ticks
    assert residual_chart(full(images=())) is None


@pytest.mark.parametrize("plane", [(0, 1), (0, 2), (1, 2)])
def test_outline_is_the_projection_of_the_ellipsoid(plane: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = root @ root.T
    # Points of the surface: 95 % of three-dimensional Gaussian errors have a squared length of
    # at most 7.815 (tables of chi squared).
    ball = rng.normal(size=(100_000, 3))
    ball *= np.sqrt(7.814728) / np.linalg.norm(ball, axis=1, keepdims=True)
    surface = (ball @ root.T)[:, plane]
    outline = ellipse(UncertainPose(SE3.identity(), covariance), 1, plane)
    for angle in np.linspace(0, np.pi, 7):
        along = np.array([np.cos(angle), np.sin(angle)])
        assert (outline @ along).max() == pytest.approx(
            (surface @ along).max(), rel=3e-3
        )


def test_difference_between_calibrations() -> None:
    older = full(parent_from_child=SE3.exp([0, 0.003, 0.004, 0, 0, 0]) @ POSE)
    rotated = full(parent_from_child=POSE @ SE3.exp([0, 0, 0, np.deg2rad(2), 0, 0]))
    moved = difference(full(), older)
    assert (moved.mm, moved.deg) == pytest.approx((5.0, 0.0), abs=1e-9)
    assert moved.offset_mm == pytest.approx((0.0, -3.0, -4.0), abs=1e-9)
    assert difference(full(), rotated).deg == pytest.approx(2.0, abs=1e-9)
    reader, _ = read(full(), older=older)
    assert "Compared with old.json" in reader.text("h2")
    assert "differs by 5.00 mm and 0.000 deg from old.json" in reader.text("p")
    assert "-3.00 and -4.00 mm along x, y and z of panda_link0" in reader.text("p")
    assert "use the same map" in reader.text("p")
    reader, _ = read(full(), older=replace(older, frames=FrameNames("base"), source={}))
    assert "names its parent frame base" in reader.text("p")
    assert "use different maps" in reader.text("p")
    with pytest.raises(
        InputError, match="it is eye_in_hand and the calibration is eye_to_hand"
    ):
        difference(full(), full(mount="eye_in_hand"))


def test_boards_show_what_each_image_contributes() -> None:
    checks = {
        "camera_sigma": {"fx": 0.5},
        "information_percent": {"shots/a.png": 30.0},
        "leave_one_out_mm": {"shots/a.png": 0.2},
    }
    reader, _ = read(full(checks=Checks.from_dict(checks)))
    assert reader.row("fx (px)") == ["fx (px)", "150.0000", "0.5000"]
    [row] = [row for row in reader.rows if row[1:2] == ["a.png"]]
    assert row[-2:] == ["30.0", "0.200"]


def test_joints_of_the_arm_are_listed_with_what_would_close_them() -> None:
    joints = (
        JointOffset("pan", 0.0, 0.02, open="its offset turns the frame of the base"),
        JointOffset("lift", np.deg2rad(1.25), np.deg2rad(0.2)),
        JointOffset("rail", -0.0031, 0.0004, is_angle=False),
    )
    checks = {"joints_move_mm": [4.5, 6.25]}
    own = full(
        joints=joints, joint_covariance=np.eye(3), checks=Checks.from_dict(checks)
    )
    reader, page = read(own)
    assert [
        "pan (deg)",
        "-",
        "-",
        "its offset turns the frame of the base",
    ] in reader.rows
    assert ["lift (deg)", "+1.250", "0.200", ""] in reader.rows
    assert ["rail (mm)", "-3.100", "0.400", ""] in reader.rows
    assert "They move the gripper by 4.50 mm, at most 6.25 mm." in page.html
    assert "joints move mm" not in page.html
    assert "Joints of the arm" in page.html
    assert "Joints of the arm" not in read(full())[1].html
