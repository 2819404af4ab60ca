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
_ROUGH = 0.7
"""If the residual variance changes by more than this ratio, the pose is estimated again."""
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


def self_calibrated(
    observed: Observed,
    camera: Camera,
    start: Pose,
    change: Array,
    prior: IntrinsicsPrior,
) -> RefinedPose:
    """Pose and intrinsics; the prior gives way where the image contradicts it.

    The start is that of `minimise`. Other priors than the stated one are a linear step away, unless
    the image contradicts it.
    """
    stated = prior.variances(camera)
    free = FREE.variances(camera)
    best = minimise(observed, camera, start, _MAX_ITERATIONS, stated, change)
    cells = cells_of(observed.pixels, camera)
    step, _ = best.moved(best.against(free))
    relaxed = best.after(step)
    measured = _measured(relaxed, free, cells)
    doubt, variances = prior.decided(camera, best.change + step[6:], measured)
    rough = not _ROUGH < relaxed.variance / best.variance < 1 / _ROUGH
    if variances is not None or doubt > prior.other_camera or rough:
        start = best.rotation, best.position
        freed = minimise(observed, camera, start, _MAX_ITERATIONS, free, best.change)
        if freed.variance < relaxed.variance:
            measured = _measured(freed, free, cells)
            doubt, variances = prior.decided(camera, freed.change, measured)
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
    more = best.bent / best.variance * lens
    by_lens = in_parent_axes(best.rotation, lens + more)
    pose = best.pose(covariance + more)
    return RefinedPose(
        pose=pose,
        observed=observed,
        residual_px=best.residual_px,
        camera=best.camera,
        change=best.change,
        by_intrinsics=by_lens,
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


def _measured(minimum: Minimum, free: Array, cells: Array) -> Array:
    """(5, 5) covariance of intrinsics without a prior."""
    formal = minimum.covariance(minimum.against(free), cells)[6:, 6:]
    return (1 + minimum.bent / minimum.variance) * formal


def _covariances(
    minimum: Minimum, variances: Array, cells: Array
) -> tuple[Array, Array]:
    """(6, 6) covariance of a pose in camera axes, and the share of the intrinsics in it."""
    whole = minimum.covariance(minimum.against(variances), cells)[:6, :6]
    share = whole - minimum.covariance(np.zeros(0), cells)
    values, axes = np.linalg.eigh(share)
    return whole, (axes * np.maximum(values, 0)) @ axes.T
