"""Textured rectangles, the surfaces of box rooms: where rays hit them, and their images."""

from functools import cached_property

import cv2
import numpy as np

from evercal.classes import frozen
from evercal.geometry import Camera
from evercal.typing import Array, BoolArray, Image

NEAR_M = 0.05
"""Depth of the near plane of rendered images, metres."""
_CORNERS = np.array(
    [
        (0, 0),
        (1, 0),
        (1, 1),
        (0, 1),
    ]
)
"""(4, 2) corners of a rectangle, in units of its edges."""

Pyramid = tuple[Image, ...]
"""A texture (h, w, 3) and its halvings, against aliasing."""
Face = tuple[Array, Array, Array]
"""Corner and two edges of a rectangle, each (3,), metres."""


@frozen
class Surface:
    """One textured rectangle in the base frame, visible from the side of its normal."""

    corner_m: Array
    """(3,) corner of texture pixel (0, 0)."""
    edge_u_m: Array
    """(3,) along texture columns."""
    edge_v_m: Array
    """(3,) along texture rows."""
    pyramid: Pyramid

    @cached_property
    def normal(self) -> Array:
        """Unit normal, shape (3,)."""
        return unit_vector(np.cross(self.edge_u_m, self.edge_v_m))

    def depths(self, origin: Array, rays: Array) -> Array:
        """Depths (n,) of rays that hit the front, in units of the ray length; infinite for others.

        Origins and directions have shape (n, 3).
        """
        slope = rays @ self.normal
        distance = (self.corner_m - origin) @ self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = distance / slope
            points = origin + depth[:, None] * rays
            local = points - self.corner_m
            u = local @ self.edge_u_m / (self.edge_u_m @ self.edge_u_m)
            v = local @ self.edge_v_m / (self.edge_v_m @ self.edge_v_m)
            ahead = (slope < 0) & (depth > 1e-6)
            hit = ahead & _in_unit_square(u, v)
        return np.where(hit, depth, np.inf)


def box_faces(
    low: Array,
    edges: Array,
    inward: bool = False,
) -> list[Face]:
    """The visible faces of a box: all but its bottom.

    The edges (3, 3), one a row, start at `low`, are right-handed and orthogonal; the last one
    points up. `inward` is a box that is seen from inside, with its floor.
    """
    ex, ey, ez = edges
    faces = [
        (low, ex, ez),
        (low + ey + ex, -ex, ez),
        (low + ex, ey, ez),
        (low + ey, -ey, ez),
        (low + ez, ex, ey),
    ]
    if not inward:
        return faces
    faces.append((low + ey, ex, -ey))
    return [(corner + u, -u, v) for corner, u, v in faces]


def _window(corners: Array, camera: Camera) -> tuple[slice, slice] | None:
    """Rows and columns of the image that corners (4, 3) span; None if no pixel shows them."""
    depths = corners[:, 2]
    if depths.max() < NEAR_M:
        return None
    if depths.min() <= NEAR_M:
        return slice(0, camera.height), slice(0, camera.width)
    pixels = camera.project(corners)
    size = camera.size
    low = np.floor(pixels.min(0))
    high = np.ceil(pixels.max(0)) + 1
    start = np.maximum(low, 0).astype(int)
    stop = np.minimum(high, size).astype(int)
    if (start >= stop).any():
        return None
    columns, rows = map(slice, start, stop)
    return rows, columns


def draw(
    image: Image,
    nearness: Array,
    pyramid: Pyramid,
    corner: Array,
    edges: Array,
    camera: Camera,
) -> None:
    """Warp a rectangle in camera coordinates into `image` where it is nearest, by `nearness`."""
    edge_u, edge_v = edges.T
    if np.cross(edge_u, edge_v) @ corner >= 0:  # back side
        return
    window = _window(corner + _CORNERS @ edges.T, camera)
    if not window:
        return
    # image ~ K [edges | corner] (s, t, 1): its inverse gives texture coordinates and 1 / depth.
    image_from_texture = camera.matrix() @ np.column_stack([edges, corner])
    texture_from_image = np.linalg.inv(image_from_texture)
    v, u = np.mgrid[window].astype(np.float32)

    def product(row: Array) -> Array:
        along_u, along_v, offset = row
        values = along_u * u + along_v * v + offset
        return values.astype(np.float32)

    a, b, w = map(product, texture_from_image)
    front = nearness[window]
    with np.errstate(divide="ignore", invalid="ignore"):
        s = a / w
        t = b / w
    visible = _in_unit_square(s, t)
    visible &= w > front
    visible &= w < 1 / NEAR_M
    if not visible.any():
        return
    # The pyramid level follows from texture pixels per image pixel over the visible area.
    covered = np.ptp(s[visible]) * np.ptp(t[visible])
    texture_pixels = covered * len(pyramid[0]) ** 2
    ratio = texture_pixels / visible.sum()
    level = np.round(0.5 * np.log2(max(ratio, 1.0)))
    texture = pyramid[min(int(level), len(pyramid) - 1)]
    height, width, _ = texture.shape
    column = np.where(visible, s * width - 0.5, 0)
    row = np.where(visible, t * height - 0.5, 0)
    warped = cv2.remap(
        texture,
        map1=column.astype(np.float32),
        map2=row.astype(np.float32),
        interpolation=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    np.copyto(image[window], warped, where=visible[..., None])
    np.copyto(front, w, where=visible)


def unit_vector(vector: Array) -> Array:
    """A vector (3,) divided by its length."""
    return vector / np.linalg.norm(vector)


def _in_unit_square(u: Array, v: Array) -> BoolArray:
    inside_u = (u >= 0) & (u <= 1)
    inside_v = (v >= 0) & (v <= 1)
    return inside_u & inside_v
