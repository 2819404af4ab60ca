"""Rays of two lenses over one image: the rotation between them, and what it leaves.

A principal point and tangential distortion trade against a rotation of the camera. So a pose
belongs to the intrinsics that it was estimated with, and answers are compared by their rays.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from evercal.geometry.camera import Camera
from evercal.typing import Array

MIDDLE = 0.8
"""Share of width and height in which lenses are compared: few images measure the corners."""
_GRID = (9, 7)
"""Pixels of the comparison, right and down."""
_STEP = 1e-4
"""Change of a parameter for a derivative, as a share of its unit."""


class RayFit(NamedTuple):
    """Rotation between the rays of two lenses."""

    own_from_other: Rotation
    """A camera with the other lens, turned by it, has nearly the same rays."""
    own: Array
    """(m, 3) unit rays of the first lens."""
    other: Array
    """(m, 3) those of the other lens at the same pixels, turned."""

    @property
    def left_rad(self) -> Array:
        """(m,) angles that the rotation leaves."""
        return angles(self.own, self.other)


def angles(a: Array, b: Array) -> Array:
    """Angles (m,) between unit vectors (m, 3), radians."""
    return 2 * np.arcsin(np.minimum(np.linalg.norm(a - b, axis=-1) / 2, 1))


def fit_rays(own: Camera, other: Camera) -> RayFit:
    """Fit a rotation to the rays of the middle of the image.

    Raises:
        ValueError: The images differ in size, or fewer than three pixels have a ray in both lenses.
    """
    if (own.width, own.height) != (other.width, other.height):
        raise ValueError(
            f"intrinsics of {own.width}x{own.height} and of {other.width}x{other.height} pixels"
            " have no common rays; give both for one image size"
        )
    edge = (1 - MIDDLE) / 2
    right = np.linspace(edge, 1 - edge, _GRID[0]) * own.width - 0.5
    down = np.linspace(edge, 1 - edge, _GRID[1]) * own.height - 0.5
    pixels = np.stack(np.meshgrid(right, down), -1).reshape(-1, 2)
    first = own.unproject(pixels)
    second = other.unproject(pixels)
    valid = np.isfinite(first + second).all(1)
    if valid.sum() < 3:
        raise ValueError("the distortion leaves no rays in the middle of the image")
    first = first[valid] / np.linalg.norm(first[valid], axis=1, keepdims=True)
    second = second[valid] / np.linalg.norm(second[valid], axis=1, keepdims=True)
    u, _, v = np.linalg.svd(first.T @ second)
    turn = Rotation.from_matrix(u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v)
    return RayFit(turn, first, turn.apply(second))


def turn_by_lens(camera: Camera, terms: int) -> Array:
    """Rotation (3, 3 + terms) of the rays by the intrinsics of `Camera.slopes`.

    The pose for a lens whose intrinsics are off by d is the true one turned by this times d.
    """
    units = np.array([1.0, camera.fx, camera.fy, *(1.0,) * terms])
    columns = []
    for i, unit in enumerate(_STEP * units):
        change = np.zeros(len(units))
        change[i] = unit
        turn = fit_rays(camera, camera.changed(change)).own_from_other
        columns.append(turn.as_rotvec() / unit)
    return np.stack(columns, 1)
