"""Selection of the images of a calibration, and the axes and landmarks drawn into them."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.board_poses import board_poses
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.calibration import Calibration, ImageUse
from evercal.calibration.checks import Checks
from evercal.geometry import SE3, Camera
from evercal.localization.estimate import PoseEstimate
from evercal.mapping.map_frame import MapFrame
from evercal.mapping.scene_map import SceneMap
from evercal.recordings.images import write_image
from evercal.reports.calibration_images import (
    annotate_images,
    boards_seen,
    select_images,
)
from evercal.reports.overlay import LandmarkPicture
from evercal.robot.frame_names import FrameNames


def pose(quaternion: ArrayLike, translation: ArrayLike) -> SE3:
    return SE3(np.array(quaternion, np.float64), np.array(translation, np.float64))


CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
BASE_FROM_CAMERA = pose([0.0, 1.0, 0.0, 0.0], [0.1, 0.05, 1.0])


def calibration(names: dict[str, bool], **more: Any) -> Calibration:
    uses = tuple(
        ImageUse(name, used, "" if used else "blurred") for name, used in names.items()
    )
    result = Calibration(
        "eye_to_hand", BASE_FROM_CAMERA, 1e-6 * np.eye(6), camera=CAMERA, images=uses
    )
    return replace(result, **more)


def write_images(
    folder: Path, *names: str, size: tuple[int, int] = (120, 160)
) -> list[Path]:
    for name in names:
        write_image(folder / name, np.full((*size, 3), 90, np.uint8))
    return [folder / name for name in names]


class FixedLocalizer:
    """Detects two landmarks in every image: one at its projection, one three pixels off."""

    scenes = ("room",)

    def __init__(self, pose: SE3 | None) -> None:
        keyframes: Any = SimpleNamespace(
            images=(), landmarks=(), cameras=(), base_from_camera=SE3.identity()
        )
        scene = SceneMap("room", CAMERA, CAMERA, keyframes, MapFrame(), 10)
        self.contents = SimpleNamespace(scenes=[scene], short_side=60)
        self.pose = pose

    def localize(self, image: np.ndarray, camera: Camera | None = None) -> PoseEstimate:
        assert camera is not None
        if self.pose is None:
            return PoseEstimate("failed", "too dark", None, None, None, 0, 0.0, 1.0)
        points = BASE_FROM_CAMERA.apply([[0.1, 0.1, 1.0], [0.2, -0.1, 1.0]])
        pixels = camera.resized(80, 60).project([[0.1, 0.1, 1.0], [0.2, -0.1, 1.0]])
        pixels[1, 0] += 3
        return PoseEstimate(
            "ok", "", "room", self.pose, None, 2, 1.0, 1.0, pixels, points
        )


def drawn_in(own: Calibration, folder: Path, localizer: Any) -> list[LandmarkPicture]:
    """The annotated images of a calibration in a folder."""
    files, _ = select_images(own, folder)
    return list(annotate_images(own, files, None, localizer).images.values())


def test_selection_is_spread_and_includes_a_rejected_image(tmp_path: Path) -> None:
    names = {f"{i}.png": i not in (4, 7) for i in range(10)}
    write_images(tmp_path, *names)
    files, reason = select_images(calibration(names), tmp_path)
    assert reason == ""
    assert [file.path.name for file in files] == ["0.png", "5.png", "9.png", "4.png"]
    assert [file.use is not None and file.use.used for file in files] == [
        True,
        True,
        True,
        False,
    ]


def test_given_images_replace_those_of_the_calibration(tmp_path: Path) -> None:
    own = write_images(tmp_path, "a.png")
    others = write_images(tmp_path, *(f"{i}.png" for i in range(6)))
    files, _ = select_images(
        calibration({str(own[0]): True}), tmp_path, [*others[:3], *own]
    )
    assert [file.path for file in files] == [*others[:3], *own]
    assert [file.use is None for file in files] == [True, True, True, False]
    assert len(select_images(calibration({}), tmp_path, others)[0]) == 4


def test_reason_for_no_images_is_given(tmp_path: Path) -> None:
    assert "names no images" in select_images(calibration({}), tmp_path)[1]
    files, reason = select_images(
        calibration({"gone.png": True, "b.png": True}), tmp_path
    )
    assert files == []
    assert "none of the 2 images" in reason
    assert "gone.png" in reason
    without_camera = annotate_images(calibration({}, camera=None), [])
    assert not without_camera.images
    assert "no intrinsics" in without_camera.missing[0]


def test_unusable_images_are_reported(tmp_path: Path) -> None:
    write_images(tmp_path, "a.png")
    write_images(tmp_path, "wide.png", size=(90, 160))
    (tmp_path / "broken.png").write_bytes(b"no image")
    own = calibration({"a.png": True, "wide.png": True, "broken.png": True})
    result = annotate_images(own, select_images(own, tmp_path)[0])
    [(name, image)] = result.images.items()
    assert (Path(name).name, image.summary, image.landmarks) == ("a.png", "used", 0)
    text = " ".join(result.missing)
    assert "wide.png is 160x90, which does not fit the camera, 160x120" in text
    assert "broken.png: not a readable image" in text
    assert "No landmarks: pass `store`" in text


def test_axes_of_an_older_calibration_are_added(tmp_path: Path) -> None:
    write_images(tmp_path, "a.png")
    own = calibration({"a.png": True})
    older = replace(own, parent_from_child=pose([0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0]))
    files, _ = select_images(own, tmp_path)
    alone, both = (
        next(iter(annotate_images(own, files, other).images.values())).image
        for other in (None, older)
    )
    # K [R | t] by hand: both look straight down from a metre above.
    coloured = np.argwhere(np.ptp(alone.astype(int), axis=2) > 60)
    assert np.abs(coloured - [4 * (59.5 + 7.5), 4 * (79.5 - 15)]).max(axis=1).min() < 6
    differ = np.argwhere((alone != both).any(axis=2))
    assert np.abs(differ - [4 * 60, 4 * 80]).max(axis=1).min() < 12


@pytest.mark.parametrize(
    ("mount", "median_px"),
    [
        ("eye_to_hand", 0.5 * (0 + 6)),  # 0 and 3 pixels of an image of half the size
        (
            "eye_in_hand",
            3.75 + 6.75,
        ),  # relative to the image's own pose, 50 mm off: 3.75 pixels
    ],
)
def test_residuals_refer_to_the_calibration_of_a_fixed_camera(
    tmp_path: Path, mount: str, median_px: float
) -> None:
    write_images(tmp_path, "a.png")
    own = calibration({"a.png": True}, mount=mount, frames=FrameNames("table", "hand"))
    localizer: Any = FixedLocalizer(BASE_FROM_CAMERA @ SE3.exp([0.05, 0, 0, 0, 0, 0]))
    [image] = drawn_in(own, tmp_path, localizer)
    assert image.landmarks == 2
    words = f"used; 2 landmarks, median residual {median_px:.2f} px, lines "
    assert image.summary.startswith(words)


def test_lines_lead_from_the_detections_to_the_projections(tmp_path: Path) -> None:
    write_images(tmp_path, "a.png")
    own = calibration({"a.png": True})
    localizer: Any = FixedLocalizer(BASE_FROM_CAMERA)
    [image] = drawn_in(own, tmp_path, localizer)
    assert image.summary.endswith("lines 2 times as long")
    # The second landmark is seen 24 pixels of the page right of its projection.
    [(x, y)] = CAMERA.resized(640, 480).project([[0.2, -0.1, 1.0]]).round().astype(int)
    red, _, blue = image.image[y].astype(int).T
    orange = np.flatnonzero(red - blue > 100)
    assert orange.min() == pytest.approx(x + 24 - 2 * 24, abs=2)
    # With the radius of the yellow dot.
    assert orange.max() == pytest.approx(x + 24 + 3, abs=2)


def test_reason_for_missing_landmarks_is_given(tmp_path: Path) -> None:
    write_images(tmp_path, "a.png")
    own = calibration({"a.png": True}, source={"scene": "room", "map": "another"})
    files, _ = select_images(own, tmp_path)
    without_pose: Any = FixedLocalizer(None)
    result = annotate_images(own, files, None, without_pose)
    assert [image.summary for image in result.images.values()] == ["used; too dark"]
    assert result.other_map
    assert not annotate_images(calibration({}), [], None, without_pose).other_map
    localizer: Any = FixedLocalizer(BASE_FROM_CAMERA)
    elsewhere = replace(own, source={"scene": "attic"})
    [image] = drawn_in(elsewhere, tmp_path, localizer)
    assert image.summary == "used; shows room, not attic"


def test_corners_are_projected_with_the_estimated_size(tmp_path: Path) -> None:
    points = np.array([[x, y, 0] for y in range(3) for x in range(3)]) * 0.03
    board_pose = SE3.from_translation([0.01, 0.02, 0.5])
    # The board is stated 2 % too large.
    view = BoardView(1.02 * points, CAMERA.project(board_pose.apply(points)))
    views = {"images/a.png": view, "images/b.png": "no board"}
    board_poses(Board("chessboard", 0.03, 3, 3), CAMERA, views).write(
        tmp_path / "board.json"
    )
    (tmp_path / "images").mkdir()
    write_images(tmp_path, "images/a.png")
    stated = {"translation_m": [0.01, 0.02, 0.5], "quaternion_wxyz": [1, 0, 0, 0]}
    own = calibration(
        {"images/a.png": True},
        checks=Checks.from_dict(
            {"camera_from_board": {"images/a.png": stated}, "scale": 1 / 1.02}
        ),
        source={"command": "solve", "camera_poses": "board.json"},
    )
    seen = boards_seen(own, tmp_path)
    assert list(seen) == ["images/a.png"]
    assert seen["images/a.png"].projected(CAMERA) == pytest.approx(
        view.pixels, abs=1e-9
    )
    files, _ = select_images(own, tmp_path)
    result = annotate_images(own, files, boards=seen)
    assert [image.summary for image in result.images.values()] == [
        "used; 9 corners, 0.00 px rms, lines 100 times as long"
    ]
    assert not result.missing
    assert boards_seen(own, tmp_path / "elsewhere") == {}
    (tmp_path / "board.json").write_text("0 0 0 0 0 0 1")
    assert boards_seen(own, tmp_path) == {}
