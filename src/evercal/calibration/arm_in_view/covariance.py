"""The covariance of a camera that was calibrated by the outlines of an arm.

Errors of outlines are not independent: those of one image share its light and its moment, those of
one link its mesh. So the residuals count as clusters of images and of links (sandwich estimator).
What all images share, the priors of the fit hold: each is a part of its own.
"""

from dataclasses import replace

import numpy as np

from evercal.calibration.arm_in_view.equations import (
    FOCAL,
    JOINTS,
    LEAST_REPEATS,
    LENS,
    OUTLINE,
    POSE,
    ArmFit,
)
from evercal.geometry import in_parent_axes
from evercal.typing import Array, BoolArray, IntArray

_SHARED = {
    "intrinsics": (LENS, "lens"),
    "a shift of all outlines": (slice(OUTLINE, JOINTS), "images"),
    "offsets of joints": (slice(JOINTS, None), "arm"),
}
"""Parameters with a prior, by the name of their part, and its cause."""
SCATTER = "scatter of the outlines"
"""Name of the part of the residuals."""
ESTIMATED_FOCAL = 0.003
"""Standard deviation of the logarithm of a focal length that outlines alone tell: errors of meshes
and light that all images share."""
WRONG_LENS = 0.02
"""Standard deviation of the logarithm of the focal length where the stated one is wrong."""


def parts(fit: ArmFit, free: BoolArray | None = None) -> dict[str, tuple[Array, str]]:
    """Covariances (10 + k, 10 + k) of the parameters by name, with their causes.

    Their sum is the covariance. Intrinsics that were not estimated err by what the images leave of
    their prior (S. Schmidt, Application of state-space methods to navigation problems, 1966).
    """
    lens = np.zeros((3, 3))
    if free is None:
        free = fit.free
        lens = lens_covariance(fit)
        if fit.estimate.parameters[FOCAL]:
            lens[0, 0] += ESTIMATED_FOCAL**2
    columns = np.flatnonzero(free)
    inverse = np.linalg.inv(fit.normal(free))
    sigma = fit.priors.sigma()
    least = LEAST_REPEATS / fit.repeats * fit.information()[np.ix_(free, free)]
    scatter = inverse @ (fit.scatter(free) + least) @ inverse
    found = {SCATTER: (_whole(scatter, columns, len(sigma)), "images")}
    by_lens = inverse @ fit.information()[np.ix_(columns, np.arange(len(sigma))[LENS])]
    for name, (own, cause) in _SHARED.items():
        precision = np.zeros(len(sigma))
        precision[own] = 1 / np.maximum(sigma[own], 1e-12) ** 2
        added = inverse @ np.diag(precision[free]) @ inverse
        if cause == "lens":
            added = added + by_lens @ lens @ by_lens.T
        found[name] = (_whole(added, columns, len(sigma)), cause)
    return found


def covariance_of(by_name: dict[str, tuple[Array, str]]) -> Array:
    """(10 + k, 10 + k) the sum of `parts`."""
    return np.sum([part for part, _ in by_name.values()], 0)


def lens_covariance(fit: ArmFit) -> Array:
    """(3, 3) of focal length and principal point, by their prior and the images."""
    return covariance_of(parts(fit, _with_lens(fit)))[LENS, LENS]


def focal_sigmas(fit: ArmFit) -> float:
    """Change of the focal length that the images ask for, in its standard deviations."""
    fit = replace(fit, priors=replace(fit.priors, focal=WRONG_LENS))
    step = fit.step(_with_lens(fit)) + fit.estimate.parameters
    return abs(step[FOCAL]) / float(np.sqrt(lens_covariance(fit)[0, 0]))


def _with_lens(fit: ArmFit) -> BoolArray:
    free = fit.free.copy()
    free[LENS] = True
    return free


def in_base(fit: ArmFit, covariance: Array) -> Array:
    """(6, 6) of base_from_camera: its translation in the base, its rotation about camera axes."""
    base_from_camera = fit.estimate.camera_from_base.inverse()
    return in_parent_axes(base_from_camera.rotation_matrix(), covariance[POSE, POSE])


def halves(fit: ArmFit) -> Array:
    """(6,) distance of the poses by the first half of the images and by the second, camera axes."""
    numbers = np.unique(fit.equations.image)
    is_late = fit.equations.image >= numbers[len(numbers) // 2]
    return (fit.step(fit.free, is_late) - fit.step(fit.free, ~is_late))[POSE]


def _whole(covariance: Array, columns: IntArray, count: int) -> Array:
    whole = np.zeros((count, count))
    whole[np.ix_(columns, columns)] = covariance
    return whole
