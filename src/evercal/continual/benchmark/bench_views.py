"""The pictures of `evercal bench-report`: test images beside the scene at the estimated poses."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evercal.continual.benchmark.scene_views import VIEWS, SceneView, read_views
from evercal.recordings.images import read_image
from evercal.reports import Picture, contact_sheet, encode_image, overlay_points
from evercal.storage import write_bytes

Image = NDArray[np.uint8]

CELL_PX = 240


def view_pictures(
    out: Path, strategies: Sequence[str], rooms: Mapping[str, tuple[str, int]]
) -> list[Picture]:
    """One picture per scene: a test image, and what each method takes for the same view.

    Args:
        out: folder of results; what is rendered is kept there, beside the views.
        strategies: which are shown, in order.
        rooms: kind and seed of scenes that the simulator made; their bare shapes are rendered where
            the extra `sim` is installed, points are drawn for others.
    """
    views = [view for view in read_views(out) if view.strategy in strategies]
    views.sort(key=lambda view: strategies.index(view.strategy))
    for room, model in rooms.items():
        _render(out, [view for view in views if view.found == room], model)
    found = []
    for scene in dict.fromkeys(view.scene for view in views):
        chosen = [view for view in views if view.scene == scene]
        images = [chosen[0].frame.read_image()]
        images += [_seen(out, view) for view in chosen]
        captions = ["query", *(f"{view.strategy}: {view.outcome}" for view in chosen)]
        sheet = contact_sheet(images, 4, captions, CELL_PX)
        found.append(Picture(encode_image(sheet, "jpg"), f"{scene}, {chosen[0].frame.name}"))
    return found


def _file(out: Path, view: SceneView) -> Path:
    return out / VIEWS / f"{view.strategy}-{view.scene}.png"


def _render(out: Path, views: Sequence[SceneView], model: tuple[str, int]) -> None:
    """Renders the bare shapes of a room for views that were found in it, if not done before."""
    todo = [(v, v.pose) for v in views if v.pose is not None and not _file(out, v).exists()]
    if not todo:
        return
    from evercal.simulation.untextured import untextured_renders

    images = untextured_renders(model, [view.frame for view, _ in todo], [pose for _, pose in todo])
    for (view, _), image in zip(todo, images, strict=False):  # none without the extra
        write_bytes(_file(out, view), encode_image(image))


def _seen(out: Path, view: SceneView) -> Image:
    file = _file(out, view)
    return read_image(file) if file.exists() else _drawn(view)


def _drawn(view: SceneView) -> Image:
    """The points of the scene that a method found, from the pose that it found; white without."""
    camera = view.frame.camera
    image = np.full((camera.height, camera.width, 3), 255, np.uint8)
    if view.pose is None:
        return image
    points = view.pose.inverse().apply(view.points_m.astype(float))
    order = np.argsort(-points[:, 2])
    order = order[points[order, 2] > 0.05]
    plain = replace(camera, distortion=())
    grey = np.repeat(view.grey[order, None], 3, 1)
    radius = max(1.5, min(image.shape[:2]) / 100)
    return overlay_points(image, plain.project(points[order]), grey, radius)
