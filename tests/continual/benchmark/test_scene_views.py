"""Views keep image, pose, and points of the estimated scene."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest
from evercal.continual.benchmark.scene_views import keep_views, read_views

from evercal.geometry import SE3, Camera
from evercal.localization.estimate import PoseEstimate
from evercal.localization.learned import LearnedLocalizer
from evercal.recordings import Frame, Recording

CAMERA = Camera(32, 24, 30.0, 30.0, 15.5, 11.5)
AHEAD = SE3(np.array([1.0, 0, 0, 0]), np.array([0.0, 0.0, -1.0]))


def frame(name: str, level: int, depth: Path | None = None) -> Frame:
    image = np.full((24, 32, 3), level, np.uint8)
    return Frame(name, image, CAMERA, AHEAD, depth=depth, joints_rad=(0.1, 0.2))


def scene(name: str, level: int, depth: Path | None = None) -> Recording:
    train = tuple(frame(f"train-{i}", level, depth) for i in range(3))
    posed = tuple(frame(f"test-{i}", level) for i in range(3))
    return Recording(name, train, (replace(posed[0], base_from_camera=None), *posed))


@dataclass
class FakeLocalizer:
    """Returns (scene, pose, points) by the grey level of the image."""

    estimates: dict[int, tuple[str | None, SE3 | None, list[list[float]]]]
    calls: list[int] = field(default_factory=list)
    contents = type("", (), {"short_side": 12})

    def localize(self, image: np.ndarray, camera: Camera | None = None) -> PoseEstimate:
        self.calls.append(int(image[0, 0, 0]))
        name, pose, points = self.estimates[self.calls[-1]]
        status = "ok" if pose is not None else "failed"
        pixels = np.tile([3.5, 3.5], (len(points), 1))
        return PoseEstimate(status, "", name, pose, None, 0, 0.0, 0.0, pixels, np.array(points))


def test_views_have_the_points_of_the_estimated_scene(tmp_path: Path) -> None:
    estimate = SE3(np.array([1.0, 0, 0, 0]), np.array([0.0, 0.03, -1.0]))
    localizer = FakeLocalizer(
        {
            10: ("hall", estimate, [[1.0, 2.0, 3.0]]),
            20: ("hall", AHEAD, []),
            30: (None, None, []),
        }
    )
    scenes = [scene("hall", 10), scene("attic", 20), scene("cellar", 30)]
    keep_views(tmp_path, "er@0.3", cast("LearnedLocalizer", localizer), scenes)
    attic, cellar, hall = read_views(tmp_path)
    assert [v.scene for v in (attic, cellar, hall)] == ["attic", "cellar", "hall"]
    assert {v.strategy for v in (attic, cellar, hall)} == {"er@0.3"}
    assert [v.outcome for v in (attic, cellar, hall)] == ["in hall", "no pose", "3.0 cm, 0.0 deg"]
    assert hall.frame.name == "test-1"
    assert hall.frame.joints_rad == (0.1, 0.2)
    assert hall.frame.camera == CAMERA
    np.testing.assert_array_equal(hall.frame.read_image(), scenes[0].test[0].read_image())
    assert hall.pose is not None
    np.testing.assert_allclose(hall.pose.matrix(), estimate.matrix())
    # The image of the attic was estimated to be in the hall.
    for view in (hall, attic):
        np.testing.assert_array_equal(np.unique(view.points_m, axis=0), [[1, 2, 3]])
        assert set(view.grey) == {10}
    assert len(cellar.points_m) == 0
    # Existing views are not computed again.
    localizer.calls.clear()
    keep_views(tmp_path, "er@0.3", cast("LearnedLocalizer", localizer), scenes)
    assert localizer.calls == []


def test_points_come_from_depth_images_if_there_are_any(tmp_path: Path) -> None:
    depth = np.zeros((24, 32), np.uint16)
    depth[:, 16:] = 2000
    assert cv2.imwrite(str(tmp_path / "depth.png"), depth)
    localizer = FakeLocalizer({10: ("hall", AHEAD, [[9.0, 9.0, 9.0]])})
    keep_views(
        tmp_path,
        "er",
        cast("LearnedLocalizer", localizer),
        [scene("hall", 10, tmp_path / "depth.png")],
    )
    (view,) = read_views(tmp_path)
    # Two metres in front of a camera one metre behind the origin, right half of the image.
    np.testing.assert_allclose(view.points_m[:, 2], 1.0)
    assert len(np.unique(view.points_m, axis=0)) == 6 * 4
    assert view.points_m[:, 0].min() == pytest.approx(2 * 0.5 / 30, abs=1e-6)
    assert localizer.calls == [10]


def test_folder_without_views(tmp_path: Path) -> None:
    assert read_views(tmp_path) == []
