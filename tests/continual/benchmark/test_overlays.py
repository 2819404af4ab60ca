"""Contours lie on the edges of the image by the true pose, and beside them by a wrong one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from evercal.continual.benchmark.overlays import record_overlay
from evercal.evaluation.metrics import FrameResult
from evercal.features.views import working_image
from evercal.geometry import SE3
from evercal.recordings import read_image

if TYPE_CHECKING:
    from evercal.recordings import Recording
    from evercal.typing import Image


def picture(scene: Recording, shift_m: float, folder: Path) -> Image:
    """The picture of a strategy that is off by `shift_m` sideways in every image."""
    results = []
    for frame in scene.test:
        assert frame.base_from_camera
        estimated = frame.base_from_camera @ SE3.exp([shift_m, 0, 0, 0, 0, 0])
        results.append(
            FrameResult(
                scene.name,
                frame.name,
                shift_m,
                0.0,
                "ok",
                scene.name,
                False,
                1.0,
                50,
                0.5,
                estimated=estimated,
            )
        )
    record_overlay(folder, f"off {shift_m}", scene, results)
    return read_image(folder / "overlays" / scene.name / f"off {shift_m}.png")


def test_contours_lie_on_edges_by_the_true_pose_only(
    arcs: tuple[Recording, Recording], tmp_path: Path
) -> None:
    scene, _ = arcs
    frame = scene.test[len(scene.test) // 2]
    grey, _ = working_image(frame.read_image(), frame.camera, frame.camera.height)
    edges = cv2.Canny(grey, 60, 140) > 0
    on_edges = []
    for shift_m in (0.0, 0.2):
        drawn = picture(scene, shift_m, tmp_path)[:-20]
        contours = (drawn[..., 0] > 200) & (drawn[..., 2] < 50)
        assert contours.sum() > 100
        on_edges.append(np.mean(edges[:-20][contours]))
    assert on_edges[0] == 1.0
    assert on_edges[1] < 0.5
