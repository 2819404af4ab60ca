"""Rays of two lenses over one image: the rotation between them, and what it leaves.

A principal point and tangential distortion trade against a rotation of the camera. So a pose
belongs to the intrinsics that it was estimated with, and answers are compared by their rays.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from evercal.geometry.camera import Camera
from evercal.geometry.se3 import norms, unit_vectors
from evercal.typing import Array

MIDDLE = (0.1, 0.9)
"""Part of width and height in which lenses are compared: few images measure the corners."""
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
    chord = norms(a - b)
    return 2 * np.arcsin(chord / 2)


def fit_rays(own: Camera, other: Camera) -> RayFit:
    """Fit a rotation to the rays of the middle of the image.

    Raises:
        ValueError: The images differ in size, or the distortion leaves no rays.
    """
    size = own.size
    if size != other.size:
        raise ValueError("the intrinsics differ in image size; give both for one size")
    across = np.linspace(*MIDDLE, 8)
    pixels = np.stack(np.meshgrid(across, across), -1).reshape(-1, 2)
    pixels = pixels * size - 0.5
    rays = np.stack([own.unproject(pixels), other.unproject(pixels)])
    rays = rays[:, np.isfinite(rays).all((0, 2))]
    if rays.shape[1] < 3:
        raise ValueError("the distortion leaves no rays in the middle of the image")
    own_rays, other_rays = unit_vectors(rays)
    turn = Rotation.align_vectors(own_rays, other_rays)[0]
    return RayFit(turn, own_rays, turn.apply(other_rays))


def turn_by_lens(camera: Camera, terms: int) -> Array:
    """Rotation (3, 3 + terms) of the rays by the intrinsics of `Camera.slopes`.

    The pose for a lens whose intrinsics are off by d is the true one turned by this times d.
    """
    units = np.ones(3 + terms)
    units[1:3] = camera.fx
    columns = []
    for change in np.diag(_STEP * units):
        turn = fit_rays(camera, camera.changed(change)).own_from_other
        columns.append(turn.as_rotvec() / change.sum())
    return np.stack(columns, 1)
