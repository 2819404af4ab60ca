"""Bundle adjustment of tags on a rigid thing, of camera poses and of intrinsics."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from evercal.calibration.boards.corners import board_pose, lens_vector
from evercal.calibration.boards.intrinsics import LensPrior, moved_camera
from evercal.calibration.boards.marker_layout import Markers
from evercal.calibration.boards.tags import Corners, view_of
from evercal.geometry import SE3, Camera
from evercal.typing import Array

_SIGMA_PX = 0.1
"""Usual standard deviation of a corner coordinate."""
_OUTLIER = 5.0
"""Residual from which corners count less, standard deviations."""
_BEHIND_PX = 1e4
"""Residual of corners that the camera cannot see."""
_TERMS = 7
"""Unknowns of a tag: shift, rotation about its middle, relative size."""
_MOST_IMAGES = 30
"""Number of images that are adjusted."""
_MEDIAN = 0.6745
"""Median of the absolute value of a standard normal variable."""


class Bundle(NamedTuple):
    """Tags and intrinsics after bundle adjustment."""

    corners: Corners
    camera: Camera
    sigma_px: float = 0.0
    """Standard deviation of a corner coordinate."""


def adjusted(
    found: Sequence[Markers], start: Bundle, kept: set[int], stated: bool
) -> Bundle:
    """Adjust camera poses, tags that are not `kept`, and intrinsics that are not stated."""
    camera = start.camera
    numbers = sorted(start.corners)
    first = np.array([start.corners[number] for number in numbers])
    poses = []
    seen = []
    for markers in found[:: -(-len(found) // _MOST_IMAGES)]:
        view = view_of(markers, start.corners)
        if view:
            for number, own in zip(markers.ids.tolist(), markers.corners, strict=True):
                if number in numbers:
                    seen.append((len(poses), numbers.index(number), own))
            poses.append(board_pose(view, camera).camera_from_board)
    image, tag, pixels = map(np.array, zip(*seen, strict=True))
    start_poses = SE3.stack(poses)
    lens = len(lens_vector(camera))
    prior = LensPrior.usual(camera)
    known = np.linalg.cholesky(prior.information[:lens, :lens]).T
    is_kept = np.repeat([number in kept for number in numbers], _TERMS)
    free = ~np.r_[np.full(lens, stated), is_kept, np.zeros(6 * len(poses), bool)]

    def moved(values: Array) -> tuple[Camera, Array, SE3]:
        change = np.zeros(len(free))
        change[free] = values
        of_lens, of_tags, of_poses = np.split(change, [lens, lens + len(is_kept)])
        return (
            moved_camera(camera, of_lens),
            _moved_tags(first, of_tags.reshape(-1, _TERMS)),
            start_poses @ SE3.exp(of_poses.reshape(-1, 6)),
        )

    def residuals(values: Array) -> Array:
        own, corners, poses = moved(values)
        projected = own.project(poses[image[:, None]].apply(corners[tag]))
        errors = np.nan_to_num(projected - pixels, nan=_BEHIND_PX) / _SIGMA_PX
        return np.r_[errors.ravel(), known @ (lens_vector(own) - prior.mean[:lens])]

    start_values = np.zeros(free.sum())
    fit = least_squares(
        residuals, start_values, loss="soft_l1", f_scale=_OUTLIER, x_scale="jac"
    )
    own, corners, _ = moved(fit.x)
    errors = fit.fun[: pixels.size]
    freedom = max(1, pixels.size - int(free.sum()))
    sigma = _SIGMA_PX * np.median(np.abs(errors)) / _MEDIAN
    sigma_px = float(sigma * np.sqrt(pixels.size / freedom))
    return Bundle(dict(zip(numbers, corners, strict=True)), own, sigma_px)


def _moved_tags(corners: Array, change: Array) -> Array:
    """Corners (t, 4, 3) of tags after a (t, 7) change."""
    middle = corners.mean(1, keepdims=True)
    arms = (corners - middle) * np.exp(change[:, None, 6:])
    return middle + SE3.exp(change[:, :6])[:, None].apply(arms)
