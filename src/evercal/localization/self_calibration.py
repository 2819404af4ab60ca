"""Pose and intrinsics of an image; a prior of the intrinsics that is contradicted gives way."""

import numpy as np

from evercal.classes import frozen_arrays
from evercal.geometry import Camera, UncertainPose, in_parent_axes
from evercal.localization.intrinsics import FREE, SAME_MODEL, IntrinsicsPrior
from evercal.localization.pose_refinement import (
    Observed,
    Pose,
    cells_of,
    minimise,
)
from evercal.typing import Array

_MAX_ITERATIONS = 10
"""Gauss-Newton iterations of pose and intrinsics."""
_REACHED = 0.05 * 7.815
"""Probability times squared distance of another camera's pose above which the covariance includes
it: 5 % at the 95 % quantile of chi-squared with three degrees of freedom."""


@frozen_arrays
class RefinedPose:
    """A pose, intrinsics and the residuals of the observations."""

    pose: UncertainPose
    """points_from_camera; the uncertainty of the intrinsics is part of its covariance."""
    observed: Observed
    """Landmarks that the pose was refined by."""
    residual_px: Array
    """(n,) reprojection errors, pixels of the image."""
    camera: Camera
    """Refined intrinsics."""
    change: Array
    """(5,) change of the intrinsics."""
    by_intrinsics: Array
    """(6, 6) share of the pose's covariance that is due to the intrinsics."""
    measured: Array
    """(5, 5) covariance of the change as the image alone measures it."""


def self_calibrated(
    observed: Observed,
    camera: Camera,
    start: Pose,
    change: Array,
    prior: IntrinsicsPrior,
) -> RefinedPose:
    """Pose and intrinsics; the prior gives way where the image contradicts it.

    The start is that of `minimise`.
    """
    stated = prior.variances(camera)
    free = FREE.variances(camera)
    scatter = np.diag(prior.scattered(camera))
    cells = cells_of(observed.pixels, camera)
    best = minimise(observed, camera, start, _MAX_ITERATIONS, stated, change)
    start = best.rotation, best.position
    # A linear step would show half of the difference of another camera.
    freed = minimise(observed, camera, start, _MAX_ITERATIONS, free, best.change)
    measured = freed.covariance(freed.against(free), cells)[6:, 6:]
    measured *= 1 + freed.bent / freed.variance
    doubt, variances = prior.decided(camera, freed.change, measured + scatter)
    if variances is not None:
        start = freed.rotation, freed.position
        best = minimise(
            observed, camera, start, _MAX_ITERATIONS, variances, freed.change
        )
    known = stated
    if variances is not None:
        known = variances
    certain = _posterior(measured, known)
    if variances is None and doubt:
        other = _posterior(measured, SAME_MODEL.variances(camera))
        offset = other @ np.linalg.solve(measured, freed.change)
        wider = other - certain + np.outer(offset, offset)
        certain += min(1.0, doubt / _REACHED) * wider
    slope = best.by_intrinsics()
    lens = slope @ certain @ slope.T
    moving = slope @ scatter @ slope.T
    # Stated rotations may have absorbed it: it does not tie rotation to position.
    moving[:3, 3:] = 0
    moving[3:, :3] = 0
    lens += moving
    return RefinedPose(
        pose=best.pose(best.covariance(np.zeros(0), cells) + lens),
        observed=observed,
        residual_px=best.residual_px,
        camera=best.camera,
        change=best.change,
        by_intrinsics=in_parent_axes(best.rotation, lens),
        measured=measured,
    )


def _posterior(measured: Array, variances: Array) -> Array:
    """Covariance (5, 5) of intrinsics that were measured, with a prior of variances (5,)."""
    return np.linalg.inv(np.linalg.inv(measured) + np.diag(1 / variances))
