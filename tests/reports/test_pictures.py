"""Landmarks are drawn at their detections, coloured by reprojection error."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from evercal.geometry import SE3, Camera
from evercal.localization.estimate import PoseEstimate
from evercal.mapping.map_frame import MapFrame
from evercal.mapping.scene_map import SceneMap
from evercal.reports.pictures import draw_landmarks

LENS = Camera(320, 240, 300, 300, 159.5, 119.5)


def answer(pose: SE3 | None, pixels: np.ndarray | None, points: np.ndarray | None) -> PoseEstimate:
    status = "failed" if pose is None else "ok"
    return PoseEstimate(status, "", "room", pose, None, 2, 0.5, 1.0, pixels, points)


def localizer(common: SE3) -> Any:
    keyframes: Any = None
    scene = SceneMap("room", LENS, LENS, keyframes, MapFrame(common), 10)
    return SimpleNamespace(contents=SimpleNamespace(scenes=[scene], short_side=240))


def test_landmarks_are_coloured_by_their_reprojection_error() -> None:
    image = np.full((240, 320, 3), 90, np.uint8)
    common = SE3.exp([0.01, 0.02, -0.01, 0.02, 0, 0.01])
    adjusted = SE3.exp([0.3, 0.1, 0.2, 0.1, -0.2, 0.05])
    points = adjusted.apply([[0.2, 0.1, 2.0], [-0.3, 0.2, 1.5]])
    pixels = LENS.project(adjusted.inverse().apply(points))
    pixels[1] += [0.6, 0.8]  # a whole pixel off
    estimate = answer(adjusted @ common.inverse(), pixels, points)
    drawn = draw_landmarks(image, estimate, localizer(common), legend=False)
    assert drawn.shape == (480, 640, 3)
    exact, off = (
        drawn[tuple(np.round(2 * at + 0.5).astype(int)[::-1])].astype(int) for at in pixels
    )
    assert exact[2] > exact[1]  # dark blue: no error
    assert off[0] > 200  # yellow: one pixel
    assert off[1] > 200
    assert (draw_landmarks(image, answer(None, None, None), localizer(common)) == 90).all()
