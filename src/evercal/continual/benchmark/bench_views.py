"""The pictures of `evercal bench-report`: test images, and the map at the estimated poses."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evercal.continual.benchmark.scene_views import SceneView, read_views
from evercal.reports.overlay import encode_image, overlay_points
from evercal.reports.page import Picture

Image = NDArray[np.uint8]


def view_pictures(out: Path, strategies: Sequence[str]) -> dict[str, list[Picture]]:
    """By scene, a test image and the map points at each strategy's pose estimate.

    Args:
        out: Folder of results.
        strategies: Strategies in order of appearance.
    """
    views = [view for view in read_views(out) if view.strategy in strategies]
    views.sort(key=lambda view: strategies.index(view.strategy))
    pictures: dict[str, list[Picture]] = {}
    for view in views:
        if view.scene not in pictures:
            query = encode_image(view.frame.read_image(), "jpg")
            pictures[view.scene] = [Picture(query, f"{view.scene}, {view.frame.name}")]
        caption = f"{view.strategy}: {view.outcome}"
        pictures[view.scene].append(Picture(encode_image(_draw_points(view), "jpg"), caption))
    return pictures


def _draw_points(view: SceneView) -> Image:
    """The map points at the estimated pose; white without a pose."""
    camera = view.frame.camera
    image = np.full((camera.height, camera.width, 3), 255, np.uint8)
    if view.pose is None:
        return image
    points = view.pose.inverse().apply(view.points_m.astype(float))
    order = np.argsort(-points[:, 2])
    order = order[points[order, 2] > 0.05]
    pinhole = replace(camera, distortion=())
    grey = np.repeat(view.grey[order, None], 3, 1)
    radius = max(1.5, min(image.shape[:2]) / 100)
    return overlay_points(image, pinhole.project(points[order]), grey, radius)
