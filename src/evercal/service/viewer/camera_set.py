"""Many cameras with their images as two objects of the scene.

A browser without a GPU spends its time on the number of objects: one with a transparent image is
drawn twice. A mesh for all images and one set of lines cost about the same for any number.
"""

from collections.abc import Sequence

import numpy as np
import viser
from numpy.typing import NDArray

from evercal.reports.scene.frusta import Frustum
from evercal.reports.scene.map_parts import THUMBNAIL_PX
from evercal.service.viewer.answers import shares_of_light
from evercal.service.viewer.glb import images_glb

Array = NDArray[np.floating]
Colour = tuple[int, int, int]

_LINE_PX = 2.0
_EDGES = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [4, 0], [4, 1], [4, 2], [4, 3], [5, 6]])
"""Pairs of points of `pyramid`."""
_FACES = np.array([[4, 0, 1], [4, 1, 2], [4, 2, 3], [4, 3, 0], [0, 1, 2], [0, 2, 3]])
_NEAREST = 1e-9


class CameraSet:
    """Cameras that are drawn, and clicked, as one.

    Args:
        server: The page.
        name: Name of the nodes in the scene.
        frusta: The cameras, at least one.
        images: Their images.
        size_m: Size of a frustum, as `add_frustum`.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        frusta: Sequence[Frustum],
        images: Sequence[NDArray[np.uint8]],
        size_m: float,
    ):
        self._points = np.stack([pyramid(frustum, size_m) for frustum in frusta])
        scene = server.scene
        self._lines = scene.add_line_segments(
            f"{name}/lines",
            self._points[:, _EDGES].reshape(-1, 2, 3).astype(np.float32),
            np.full((len(_EDGES) * len(frusta), 2, 3), 128, np.uint8),
            thickness=_LINE_PX,
            thickness_units="screen",
        )
        self._images = scene.add_glb(
            f"{name}/images",
            images_glb(self._points[:, :4], images, THUMBNAIL_PX),
            cast_shadow=False,
            receive_shadow=False,
        )

    @property
    def visible(self) -> bool:
        """Whether they are shown."""
        return self._lines.visible

    @visible.setter
    def visible(self, visible: bool) -> None:
        self._lines.visible = self._images.visible = visible

    def colour(self, colours: Sequence[Colour]) -> None:
        """Draw the lines of each camera in a colour."""
        own = linear(np.array(colours))[:, None, None]
        whole = np.broadcast_to(own, (len(colours), len(_EDGES), 2, 3))
        self._lines.colors = np.ascontiguousarray(whole.reshape(-1, 2, 3))

    def hit(
        self, origin_m: Sequence[float], direction: Sequence[float]
    ) -> tuple[float, int] | None:
        """The first camera on a ray: its distance in lengths of `direction`, and its number."""
        if not self.visible:
            return None
        return first_hit(self._points, np.asarray(origin_m), np.asarray(direction))

    def remove(self) -> None:
        """Remove them from the scene."""
        self._lines.remove()
        self._images.remove()


def linear(colours: NDArray[np.integer]) -> NDArray[np.uint8]:
    """Colours as viser's lines expect them: it encodes them as sRGB once more."""
    return np.round(255 * shares_of_light(colours)).astype(np.uint8)


def first_hit(points_m: Array, origin_m: Array, direction: Array) -> tuple[float, int] | None:
    """The first of the frusta (n, 7, 3) that a ray enters (Möller and Trumbore, JGT 1997)."""
    corner, first, second = np.moveaxis(points_m[:, _FACES], 2, 0)
    along, across = first - corner, second - corner
    normal = np.cross(direction, across)
    volume = np.einsum("nfi,nfi->nf", along, normal)
    with np.errstate(divide="ignore", invalid="ignore"):
        away = origin_m - corner
        u = np.einsum("nfi,nfi->nf", away, normal) / volume
        side = np.cross(away, along)
        v = np.einsum("i,nfi->nf", direction, side) / volume
        distance = np.einsum("nfi,nfi->nf", across, side) / volume
        inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > _NEAREST)
    distance = np.where(inside, distance, np.inf).min(1)
    nearest = int(np.argmin(distance))
    return (float(distance[nearest]), nearest) if np.isfinite(distance[nearest]) else None


def pyramid(frustum: Frustum, size_m: float) -> Array:
    """(7, 3) corners of the image, the centre, and two points that mark its upper side."""
    depth = frustum.depth_of(size_m)
    corners = frustum.corners(depth)
    top, down = corners[:2].mean(0), (corners[3] - corners[0]) / 2
    centre = frustum.base_from_camera.translation_m
    return np.concatenate([corners, [centre, top, top - 0.2 * down]])
