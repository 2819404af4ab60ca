"""What the corners of a board say about the lens that all images share.

The corners of an image determine the pose of the board up to the intrinsics. Eliminating the poses
from the normal equations leaves the information on the intrinsics (the Schur complement of bundle
adjustment). A prior is added to it: a stated lens, or what is usual for a lens.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.boards.corners import BoardPose
from evercal.geometry import Camera

Array = NDArray[np.floating]

LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_USUAL_CENTRE, _USUAL_ASPECT = 0.1, 0.02
"""Standard deviations of the principal point from the middle of the image, in widths, and of the
ratio of both focal lengths from one."""
_ROUGH_FOCAL = 0.5
"""Relative standard deviation of a rough focal length."""
_USUAL_DISTORTION = (0.3, 0.5, 2e-3, 2e-3, 0.5, 0.1, 0.1, 0.1)
_STATED = 0.005
"""Standard deviation of a stated focal length and principal point, relative to the focal length."""
_STATED_DISTORTION = (0.02, 0.05, 5e-4, 5e-4, 0.1, 0.02, 0.02, 0.02)


class LensPrior(NamedTuple):
    """A Gaussian over the (q,) intrinsics in the order of `LENS`."""

    mean: Array
    information: Array
    """(q, q) inverse covariance."""

    @classmethod
    def stated(cls, camera: Camera) -> "LensPrior":
        """Prior of intrinsics from the maker or from another calibration."""
        mean = lens_vector(camera)
        sigma = np.r_[np.full(4, _STATED * camera.fx), _STATED_DISTORTION][: len(mean)]
        return cls(mean, np.diag(sigma**-2.0))

    @classmethod
    def usual(cls, camera: Camera) -> "LensPrior":
        """Prior of an unknown lens; `camera` gives image size and a rough focal length."""
        mean = np.zeros(len(lens_vector(camera)))
        mean[:2] = camera.fx
        mean[2:4] = (camera.width - 1) / 2, (camera.height - 1) / 2
        sigma = np.r_[np.full(4, _USUAL_CENTRE * camera.width), _USUAL_DISTORTION][: len(mean)]
        information = np.diag(sigma**-2.0)
        aspect = np.array([[1.0, -1.0], [-1.0, 1.0]]) / (_USUAL_ASPECT * camera.fx) ** 2
        information[:2, :2] = aspect + np.eye(2) / (_ROUGH_FOCAL * camera.fx) ** 2
        return cls(mean, information)


class LensEstimate(NamedTuple):
    """The best intrinsics relative to those that the board poses were fitted with."""

    change: Array
    """(q,)."""
    information: Array
    """(q, q) of the corners and the prior."""

    @property
    def covariance(self) -> Array:
        """(q, q)."""
        unit = 1 / np.sqrt(np.maximum(np.diag(self.information), 1e-300))
        scaled = self.information * np.outer(unit, unit)
        return np.outer(unit, unit) * np.linalg.pinv(scaled, 1e-13, hermitian=True)


def lens_estimate(
    poses: Sequence[BoardPose], sigma_px: float, camera: Camera, prior: LensPrior
) -> LensEstimate:
    """Estimate the change of the intrinsics `camera` from board poses fitted with them."""
    variance = sigma_px**2
    normal = np.sum([pose.lens_normal for pose in poses], 0) / variance
    gradient = np.sum([pose.lens_gradient for pose in poses], 0) / variance
    information = normal + prior.information
    right = gradient + prior.information @ (prior.mean - lens_vector(camera))
    unit = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information * np.outer(unit, unit)
    change = unit * np.linalg.lstsq(scaled, unit * right, rcond=1e-13)[0]
    return LensEstimate(change, information)


def lens_vector(camera: Camera) -> Array:
    """Return the (q,) intrinsics in the order of `LENS`, q = 9 or 12."""
    distortion = np.zeros(max(5, len(camera.distortion)))
    distortion[: len(camera.distortion)] = camera.distortion
    return np.r_[camera.fx, camera.fy, camera.cx, camera.cy, distortion]


def moved_camera(camera: Camera, change: Array) -> Camera:
    """Return the camera after a (q,) change of its intrinsics.

    Raises:
        ValueError: A focal length is no longer positive.
    """
    fx, fy, cx, cy, *distortion = (float(value) for value in lens_vector(camera) + change)
    return Camera(camera.width, camera.height, fx, fy, cx, cy, tuple(distortion))
