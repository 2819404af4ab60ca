"""The pictures of `evercal bench-report`: test images and renderings at the estimated poses."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evercal.continual.benchmark.scene_views import VIEWS, SceneView, read_views
from evercal.recordings.images import read_image
from evercal.reports.overlay import encode_image, overlay_points
from evercal.reports.page import Picture
from evercal.storage import write_bytes

Image = NDArray[np.uint8]


def view_pictures(
    out: Path, strategies: Sequence[str], rooms: Mapping[str, tuple[str, int]]
) -> dict[str, list[Picture]]:
    """By scene, a test image and what each strategy's pose estimate should show.

    Args:
        out: Folder of results. Renderings are stored there, beside the views.
        strategies: Strategies in order of appearance.
        rooms: Kind and seed of simulated scenes. Their untextured shapes are rendered if the extra
            `sim` is installed. For other scenes, the map points are drawn.
    """
    views = [view for view in read_views(out) if view.strategy in strategies]
    views.sort(key=lambda view: strategies.index(view.strategy))
    for room, model in rooms.items():
        _render(out, [view for view in views if view.found == room], model)
    pictures: dict[str, list[Picture]] = {}
    for view in views:
        if view.scene not in pictures:
            query = encode_image(view.frame.read_image(), "jpg")
            pictures[view.scene] = [Picture(query, f"{view.scene}, {view.frame.name}")]
        file = _file(out, view)
        image = read_image(file) if file.exists() else _draw_points(view)
        caption = f"{view.strategy}: {view.outcome}"
        pictures[view.scene].append(Picture(encode_image(image, "jpg"), caption))
    return pictures


def _file(out: Path, view: SceneView) -> Path:
    return out / VIEWS / f"{view.strategy}-{view.scene}.png"


def _render(out: Path, views: Sequence[SceneView], model: tuple[str, int]) -> None:
    """Render the untextured shapes of a room, except where a rendering exists."""
    todo = [(v, v.pose) for v in views if v.pose is not None and not _file(out, v).exists()]
    if not todo:
        return
    from evercal.simulation.untextured import untextured_renders

    images = untextured_renders(model, [view.frame for view, _ in todo], [pose for _, pose in todo])
    for (view, _), image in zip(todo, images, strict=False):  # no images without the extra
        write_bytes(_file(out, view), encode_image(image))


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
