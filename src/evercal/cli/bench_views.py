"""The pictures of `evercal bench-report`: test images beside the scene at the estimated poses."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from evercal.drawing import Picture, contact_sheet, encode_image, overlay_points
from evercal.evaluation.views import SceneView

Image = NDArray[np.uint8]

SHOWN = 7
CELL_PX = 240


def view_pictures(
    views: Sequence[SceneView],
    strategies: Sequence[str],
    rooms: Mapping[str, tuple[str, int]],
) -> list[Picture]:
    """One picture per scene: a test image, and what each method takes for the same view.

    Args:
        views: of any strategies.
        strategies: which are shown, at most seven, in order.
        rooms: kind and seed of scenes that the simulator made; their bare shapes are rendered where
            the extra `sim` is installed, points are drawn for others.
    """
    found = []
    for scene in dict.fromkeys(view.scene for view in views):
        of = {view.strategy: view for view in views if view.scene == scene}
        chosen = [of[name] for name in strategies if name in of][:SHOWN]
        if not chosen:
            continue
        images = [chosen[0].frame.read_image(), *(_seen(view, rooms) for view in chosen)]
        captions = ["query", *(f"{view.strategy}: {view.outcome}" for view in chosen)]
        sheet = contact_sheet(images, 4, captions, CELL_PX)
        found.append(Picture(encode_image(sheet, "jpg"), f"{scene}, {chosen[0].frame.name}"))
    return found


def _seen(view: SceneView, rooms: Mapping[str, tuple[str, int]]) -> Image:
    """The scene that a method found, from the pose that it found; white without one."""
    camera = view.frame.camera
    image = np.full((camera.height, camera.width, 3), 255, np.uint8)
    if view.pose is None:
        return image
    if view.found is not None and view.found in rooms:
        from evercal.simulation.mini import clay_views

        rendered = clay_views(rooms[view.found], [view.frame], [view.pose])
        if rendered:
            return rendered[0]
    points = view.pose.inverse().apply(view.points_m.astype(float))
    order = np.argsort(-points[:, 2])
    order = order[points[order, 2] > 0.05]
    plain = replace(camera, distortion=())
    grey = np.repeat(view.grey[order, None], 3, 1)
    radius = max(1.5, min(image.shape[:2]) / 100)
    return overlay_points(image, plain.project(points[order]), grey, radius)
