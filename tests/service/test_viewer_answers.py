"""Answers and calibrations as the 3D view shows them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evercal.calibration.calibration import Calibration
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_distance
from evercal.localization.localizer import Localizer
from evercal.mapping.scene_map import MapContents
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.streams import StreamFrame
from evercal.service.viewer.answers import (
    AMBER,
    GREEN,
    RED,
    AnswerView,
    LocatedImage,
    answer_view,
)
from evercal.service.viewer.calibrations import CalibrationView, read_views

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
GRIPPER = SE3.exp([0.3, 0.1, 0.6, 0.2, 0.5, -0.4])
HAND = SE3.exp([0.05, 0.0, 0.02, 0.0, 0.1, 1.5])


@pytest.fixture(scope="module")
def localizer(hall_map: MapContents) -> Localizer:
    return Localizer(hall_map)


@pytest.fixture(scope="module")
def located(localizer: Localizer, hall: Recording) -> LocatedImage:
    frame = hall.test[7]
    image = frame.read_image()
    estimate = localizer.localize(image)
    assert estimate.status == "ok"
    return LocatedImage("a.png", image, estimate)


def rows(view: AnswerView) -> dict[str, str]:
    return dict(view.rows)


def median_px(view: AnswerView) -> float:
    found = re.match(r"median ([\d.]+) px", rows(view)["residuals"])
    assert found
    return float(found[1])


def test_a_located_image_is_green_with_its_pose(
    located: LocatedImage, localizer: Localizer
) -> None:
    view = answer_view(located, localizer)
    pose = located.estimate.base_from_camera
    assert pose is not None
    assert (view.state, view.colour, view.scene) == ("located", GREEN, "hall")
    [frustum] = view.frusta
    assert max(pose_distance(frustum.base_from_camera, pose)) < 1e-12
    assert view.ellipsoid is not None
    np.testing.assert_allclose(view.ellipsoid.centre_m, pose.translation_m)
    assert view.stated is None
    assert rows(view)["inliers"].startswith(f"{located.estimate.inliers} ")
    for edge in (view.picture[0], view.picture[-1], view.picture[:, 0], view.picture[:, -1]):
        assert (edge == GREEN).all()


def test_the_error_is_the_distance_from_the_stated_pose(
    located: LocatedImage, localizer: Localizer
) -> None:
    pose = located.estimate.base_from_camera
    assert pose is not None
    stated = SE3(pose.rotation_wxyz, pose.translation_m + np.array([0.003, 0.0, 0.004]))
    view = answer_view(replace(located, stated=stated), localizer)
    assert rows(view)["from stated pose"] == "5.0 mm, 0.00°"
    assert view.stated is not None
    assert max(pose_distance(view.stated.base_from_camera, stated)) < 1e-12


def test_residuals_at_a_wrong_stated_pose_are_as_long_as_it_is_wrong(
    located: LocatedImage, localizer: Localizer, hall: Recording
) -> None:
    pose, camera = located.estimate.base_from_camera, hall.test[7].camera
    assert pose is not None
    turned = pose @ SE3.exp([0, 0, 0, 0, 0.02, 0])  # to the side: f times the angle, in pixels
    wrong = replace(located, stated=turned)
    assert median_px(answer_view(wrong, localizer)) < 0.5
    far = median_px(answer_view(wrong, localizer, at_stated=True))
    assert far == pytest.approx(0.02 * camera.fx, rel=0.25)


def test_an_unknown_place_is_red_without_a_pose(localizer: Localizer) -> None:
    image = np.random.default_rng(0).integers(0, 256, (240, 320, 3)).astype(np.uint8)
    stranger = LocatedImage("noise", image, localizer.localize(image))
    view = answer_view(stranger, localizer)
    assert view.state in ("unknown", "failed")
    assert (view.colour, view.frusta, view.scene, view.ellipsoid) == (RED, (), None, None)
    assert rows(view)["reason"] == stranger.estimate.reason != ""
    assert (view.picture[0] == RED).all()
    assert answer_view(replace(stranger, tracked="lost"), localizer).state == "lost"


def test_an_ambiguous_image_is_amber_with_both_poses(
    located: LocatedImage, localizer: Localizer
) -> None:
    poses = (SE3.identity(), GRIPPER)
    estimate = replace(
        located.estimate,
        status="ambiguous",
        base_from_camera=None,
        covariance=None,
        alternatives=poses,
    )
    view = answer_view(replace(located, estimate=estimate, tracked="lost"), localizer)
    assert (view.state, view.colour, view.scene) == ("ambiguous", AMBER, "hall")
    for frustum, pose in zip(view.frusta, poses, strict=True):
        assert max(pose_distance(frustum.base_from_camera, pose)) < 1e-12


@pytest.mark.parametrize("tracked", ["tracking", "relocalized"])
def test_a_tracked_frame_has_its_state(
    tracked: Any, located: LocatedImage, localizer: Localizer
) -> None:
    view = answer_view(replace(located, tracked=tracked), localizer)
    assert (view.state, view.colour) == (tracked, GREEN)


def test_names_of_files_are_no_markup(located: LocatedImage, localizer: Localizer) -> None:
    from evercal.service.viewer.text import answer_html, note_html

    page = answer_html(answer_view(replace(located, name="<script>"), localizer), [("<b>", "&")])
    assert "&lt;script&gt;" in page
    assert "&lt;b&gt;" in page
    assert "<script>" not in page + note_html("<script>")


def calibration(mount: Any, **more: Any) -> Calibration:
    covariance = np.diag([1e-6, 4e-6, 9e-6, 1e-8, 1e-8, 1e-8])
    parent = "gripper" if mount == "eye_in_hand" else "base"
    return Calibration(mount, HAND, covariance, parent, **more)


def test_a_camera_on_the_gripper_moves_with_it() -> None:
    view = CalibrationView("wrist", calibration("eye_in_hand"), CAMERA)
    assert view.shapes(None) is None
    shapes = view.shapes(GRIPPER)
    assert shapes is not None
    frustum, ellipsoid = shapes
    assert max(pose_distance(frustum.base_from_camera, GRIPPER @ HAND)) < 1e-12
    np.testing.assert_allclose(ellipsoid.axes_m, [1e-3, 2e-3, 3e-3], rtol=1e-6)
    axes = SE3(ellipsoid.rotation_wxyz, np.zeros(3)).rotation_matrix()
    np.testing.assert_allclose(np.abs(axes.T @ GRIPPER.rotation_matrix()), np.eye(3), atol=1e-6)


def test_a_fixed_camera_stays(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        calibration("eye_to_hand", source={"scene": "hall"}).write(tmp_path / folder / "cam.json")
    views = read_views([tmp_path / "a" / "cam.json", tmp_path / "b" / "cam.json"], CAMERA)
    assert [view.name for view in views] == ["cam (1)", "cam (2)"]
    assert (views[0].scene, views[0].camera) == ("hall", CAMERA)
    shapes = views[0].shapes(GRIPPER)
    assert shapes is not None
    assert max(pose_distance(shapes[0].base_from_camera, HAND)) < 1e-12
    # The root mean square of 1, 2 and 3 mm.
    assert views[0].label(50) == "cam (1): 2.2 mm (1 sigma), ellipsoid x 50"
    with pytest.raises(InputError, match=r"gone.json: calibration file is missing"):
        read_views([tmp_path / "gone.json"], CAMERA)


def test_the_stated_pose_comes_from_the_recording_or_from_the_gripper() -> None:
    pytest.importorskip("viser")
    from evercal.service.viewer.playback import stated_pose

    image = np.zeros((48, 64, 3), np.uint8)
    posed = Frame("a", image, CAMERA, GRIPPER, HAND)
    assert stated_pose(posed, HAND) == (GRIPPER, "stated pose")
    on_arm = Frame("a", image, CAMERA, None, GRIPPER)
    pose, by = stated_pose(on_arm, HAND)
    assert pose is not None
    assert by == "gripper pose and calibration"
    assert max(pose_distance(pose, GRIPPER @ HAND)) < 1e-12
    assert stated_pose(on_arm, None)[0] is None


def frames(count: int) -> Iterator[StreamFrame]:
    for i in range(count):
        yield StreamFrame(str(i), i / 10, np.zeros((1, 1, 3), np.uint8))


def test_frames_of_a_file_come_at_their_times() -> None:
    pytest.importorskip("viser")
    from evercal.service.viewer.live import paced

    now, slept = [100.0], []

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        now[0] += seconds

    names = []
    for frame in paced(frames(4), lambda: now[0], sleep):
        names.append(frame.name)
        now[0] += 0.03 if frame.name != "1" else 0.5  # the time to locate it
    assert names == list("0123")
    # Frame 2 comes late and at once, and frame 3 a step after it.
    np.testing.assert_allclose(slept, [0.07, 0.07])
