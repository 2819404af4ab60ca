"""Shapes in the base frame: frusta of cameras and ellipsoids of their uncertainty."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from evercal.geometry import SE3, Camera, UncertainPose

Array = NDArray[np.float64]

DRAWN_M = 0.05
"""Longest half axis of a drawn ellipsoid."""
_SCALES = (1, 2, 5, 10, 20, 50, 100, 200, 500)


@dataclass(frozen=True, eq=False)
class Frustum:
    """The view of a pinhole camera whose principal point is the centre of its image."""

    base_from_camera: SE3
    fov_rad: float
    """Vertical angle of view, radians."""
    aspect: float
    """Width of the view divided by its height."""

    @classmethod
    def of(cls, base_from_camera: SE3, camera: Camera) -> Self:
        """The view of a camera; its distortion and the offset of its centre are left out."""
        fov = 2 * np.arctan2(camera.height / 2, camera.fy)
        aspect = (camera.width / camera.fx) / (camera.height / camera.fy)
        return cls(base_from_camera, float(fov), float(aspect))

    def corners(self, depth_m: float) -> Array:
        """(4, 3) corners of the view at a depth, in the base frame, metres."""
        high = np.tan(self.fov_rad / 2)
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        plane = signs * [high * self.aspect, high]
        return self.base_from_camera.apply(depth_m * np.column_stack([plane, np.ones(4)]))


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """The translation of a pose within one standard deviation."""

    centre_m: Array
    """(3,) in the base frame, metres."""
    axes_m: Array
    """(3,) standard deviations along the principal axes, metres, ascending."""
    rotation_wxyz: Array
    """(4,) from the principal axes to the base frame."""

    @classmethod
    def of(cls, pose: UncertainPose) -> Self:
        """The ellipsoid of the translation's covariance."""
        variance, axes = np.linalg.eigh(pose.covariance[:3, :3])
        axes[:, 2] *= np.sign(np.linalg.det(axes))  # a rotation, and no reflection
        matrix = np.eye(4)
        matrix[:3, :3] = axes
        rotation = SE3.from_matrix(matrix).rotation_wxyz
        return cls(pose.pose.translation_m, np.sqrt(np.maximum(variance, 0)), rotation)

    @property
    def sigmas_mm(self) -> str:
        """Standard deviations along the principal axes, the largest first."""
        return " / ".join(f"{1000 * axis:.2g}" for axis in self.axes_m[::-1])


def readable_scale(ellipsoids: list[Ellipsoid], drawn_m: float = DRAWN_M) -> int:
    """The largest round factor that draws the half axes of ellipsoids no longer than `drawn_m`.

    Without ellipsoids, that of a standard deviation of 1 mm.
    """
    longest = max((float(ellipsoid.axes_m[-1]) for ellipsoid in ellipsoids), default=0.001)
    return max([scale for scale in _SCALES if scale * longest <= drawn_m], default=1)
