"""The covariance of a camera that was calibrated by the outlines of an arm.

Errors of outlines are not independent: those of one image share its light and its moment, those of
one link its mesh. So the residuals count as clusters of images and of links (sandwich estimator).
What all images share, the priors of the fit hold: each is a part of its own.
"""

import numpy as np

from evercal.calibration.arm_in_view.fit import (
    CENTRE,
    FOCAL,
    JOINTS,
    LEAST_REPEATS,
    OUTLINE,
    POSE,
    ArmFit,
    cluster_scatter,
)
from evercal.geometry import in_parent_axes
from evercal.typing import Array, IntArray

_SHARED = {
    "intrinsics": (slice(FOCAL, CENTRE.stop), "lens"),
    "a shift of all outlines": (slice(OUTLINE, JOINTS), "images"),
    "offsets of joints": (slice(JOINTS, None), "arm"),
}
"""Parameters with a prior, by the name of their part, and its cause."""


def parts(fit: ArmFit) -> dict[str, tuple[Array, str]]:
    """Covariances (10 + k, 10 + k) of the parameters by name, with their causes.

    Parameters that are not free have zeros. The sum is the covariance.
    """
    free = np.flatnonzero(fit.free)
    inverse = np.linalg.inv(fit.normal)
    sigma = fit.priors.sigma()
    count = len(sigma)
    found = {}
    for name, (columns, cause) in _SHARED.items():
        own = np.full(count, np.inf)
        own[columns] = sigma[columns]
        added = inverse @ np.diag(1 / own[free] ** 2) @ inverse
        found[name] = (_whole(added, free, count), cause)
    scatter = inverse @ _scatter(fit) @ inverse
    return {
        "scatter of the outlines": (_whole(scatter, free, count), "images"),
        **found,
    }


def in_base(fit: ArmFit, covariance: Array) -> Array:
    """(6, 6) of base_from_camera: its translation in the base, its rotation about camera axes."""
    base_from_camera = fit.estimate.camera_from_base.inverse()
    return in_parent_axes(base_from_camera.rotation_matrix(), covariance[POSE, POSE])


def halves(fit: ArmFit) -> Array:
    """(6,) distance of the poses by every second image and by the others, in camera axes."""
    numbers = np.unique(fit.equations.image)
    is_odd = np.isin(fit.equations.image, numbers[1::2])
    precision = 1 / fit.priors.sigma()[fit.free] ** 2
    steps = []
    for rows in (is_odd, ~is_odd):
        slopes = fit.equations.slopes[rows][:, fit.free]
        weighted = slopes * fit.weights[rows, None] / (fit.scale_px**2 * fit.repeats)
        normal = weighted.T @ slopes + np.diag(precision)
        steps.append(np.linalg.solve(normal, weighted.T @ fit.equations.px[rows]))
    return (steps[0] - steps[1])[POSE]


def _scatter(fit: ArmFit) -> Array:
    """Covariance of the right side of the normal equations by clusters of residuals."""
    slopes = fit.equations.slopes[:, fit.free]
    weighted = slopes * fit.weights[:, None] / (fit.scale_px**2 * fit.repeats)
    gradients = weighted * fit.equations.px[:, None]
    least = LEAST_REPEATS / fit.repeats * weighted.T @ slopes
    return least + cluster_scatter(gradients, fit.equations)


def _whole(covariance: Array, free: IntArray, count: int) -> Array:
    whole = np.zeros((count, count))
    whole[np.ix_(free, free)] = covariance
    return whole
