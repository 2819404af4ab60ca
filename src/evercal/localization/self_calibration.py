"""Pose and intrinsics of an image; a prior of the intrinsics that is contradicted gives way."""

from dataclasses import dataclass

import numpy as np

from evercal.geometry import Camera, UncertainPose, in_parent_axes
from evercal.localization.intrinsics import FREE, SAME_MODEL, IntrinsicsPrior
from evercal.localization.pose_refinement import (
    Minimum,
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


@dataclass(frozen=True, eq=False)
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
    doubt, variances = prior.decided(camera, freed.change, measured + scatter)
    if variances is not None:
        start = freed.rotation, freed.position
        best = minimise(
            observed, camera, start, _MAX_ITERATIONS, variances, freed.change
        )
    if variances is not None:
        covariance, lens = _covariances(best, variances, cells)
    else:
        covariance, lens = _covariances(best, stated, cells)
        if doubt:
            wider = _reaching_other_camera(best, stated, lens, cells)
            more = min(1.0, doubt / _REACHED) * wider
            covariance = covariance + more
            lens = lens + more
    slope = best.by_intrinsics()
    more = slope @ scatter @ slope.T
    # Stated rotations may have absorbed it: it does not tie rotation to position.
    more[:3, 3:] = 0
    more[3:, :3] = 0
    by_lens = in_parent_axes(best.rotation, lens + more)
    pose = best.pose(covariance + more)
    return RefinedPose(
        pose=pose,
        observed=observed,
        residual_px=best.residual_px,
        camera=best.camera,
        change=best.change,
        by_intrinsics=by_lens,
        measured=measured,
    )


def _reaching_other_camera(
    minimum: Minimum, stated: Array, lens: Array, cells: Array
) -> Array:
    """(6, 6) covariance whose deviation reaches to the pose of another camera of the model."""
    other = SAME_MODEL.variances(minimum.camera)
    to_other, _ = minimum.moved(minimum.against(other))
    to_stated, _ = minimum.moved(minimum.against(stated))
    offset = (to_other - to_stated)[:6]
    _, of_other = _covariances(minimum, other, cells)
    return of_other - lens + np.outer(offset, offset)


def _covariances(
    minimum: Minimum, variances: Array, cells: Array
) -> tuple[Array, Array]:
    """(6, 6) covariance of a pose in camera axes, and the share of the intrinsics in it."""
    whole = minimum.covariance(minimum.against(variances), cells)[:6, :6]
    share = whole - minimum.covariance(np.zeros(0), cells)
    values, axes = np.linalg.eigh(share)
    return whole, (axes * np.maximum(values, 0)) @ axes.T
