"""Lack of fit: residuals with a trend over the image, as those of no camera have.

An image may be squeezed, sheared by a rolling shutter, or bent: its pixels are displaced by a
polynomial of their place. The coefficients of one degree have a common variance, which is estimated
by maximum likelihood beside a free pose and free intrinsics (empirical Bayes; MacKay, Neural
Computation, 1992). What the pose absorbs of a displacement is not in the residuals. So the variance
of the coefficients widens the covariance of the pose, and a large one rejects the image.
"""

import math
from typing import NamedTuple

import numpy as np

from evercal.geometry import SE3, Camera, in_parent_axes
from evercal.geometry.normal_equations import normal_inverse
from evercal.localization.intrinsics import (
    CONTRADICTED,
    FREE,
    INTRINSICS,
    OWN,
    SAME_MODEL,
    UNKNOWN,
    IntrinsicsPrior,
)
from evercal.localization.pose_refinement import (
    SHARED,
    Observed,
    cells_of,
    linearise,
    robust_variance,
    whitened,
)
from evercal.typing import Array

SIGNIFICANT = 3.0
"""Log likelihood ratio above which residuals have a trend."""
WARPED = 0.06
"""Displacement, as a share of half the longer side, above which an image is rejected."""
_SIZES = np.r_[0, np.geomspace(5e-4, 0.2, 9)]
"""Standard deviations of coefficients that are tried, as shares of half the longer side."""
_DEGREE = np.repeat([0, 0, 0, 1, 1, 1], 2)
"""Which of two sizes a coefficient (12,) has: up to linear ones, or quadratic ones."""
_POSE = 6
"""Parameters of a pose."""
_CAMERA = _POSE + INTRINSICS
"""Parameters of pose and intrinsics."""
_ROUNDS = 3
"""Rounds in which the landmarks are weighted."""
_ABSORBED = 3e-3
"""Standard deviation of coefficients above which pose and intrinsics absorb them."""
_RIDGE = 1e-12
"""Ridge of the scaled information."""


class LackOfFit(NamedTuple):
    """A displacement of an image that its pose and intrinsics do not explain."""

    size: float
    """At the edge of the image, as a share of half the longer side."""
    covariance: Array
    """(6, 6) by which it widens that of the pose points_from_camera."""
    reason: str
    """What it looks like."""


class _Equations(NamedTuple):
    """Normal equations of pose, intrinsics and displacement, for errors of unit variance."""

    information: Array
    """(23, 23) of the observations."""
    gradient: Array
    """(23,) at no displacement."""
    scatter: Array
    """(23, 23) covariance of the gradient, as for `Minimum.covariance`."""


def lack_of_fit(
    observed: Observed, camera: Camera, pose: SE3, change: Array
) -> LackOfFit | None:
    """The displacement of an image beside its pose points_from_camera; None if not significant.

    `change` (5,) of the intrinsics: those of another model were free.
    """
    information, gradient, scatter = _weighted(observed, camera, pose)
    inverse = normal_inverse(information + _prior(FREE, camera), _RIDGE)
    coefficients = -(inverse @ gradient)[_CAMERA:]
    scatter = inverse @ scatter @ inverse
    values, axes = np.linalg.eigh(inverse[_CAMERA:, _CAMERA:])
    seen = axes[:, values < _ABSORBED**2]
    sizes = _sizes(coefficients, scatter[_CAMERA:, _CAMERA:], seen)
    if sizes is None:
        return None
    other = change @ (change / SAME_MODEL.variances(camera)) > CONTRADICTED
    known = information + _prior(UNKNOWN if other else OWN, camera)
    inverse = normal_inverse(known[:_CAMERA, :_CAMERA], _RIDGE)
    moved = inverse[:_POSE] @ information[:_CAMERA, _CAMERA:]
    covariance = (moved * sizes[_DEGREE] ** 2) @ moved.T
    return LackOfFit(
        size=float(np.hypot(*sizes)),
        covariance=in_parent_axes(pose.rotation_matrix(), covariance),
        reason=_reason(coefficients, sizes, camera),
    )


def unlikely(camera: Camera, change: Array) -> float:
    """-log10 of the density of focal length and principal point among cameras, largest 1.

    The support of a pose is less by it: a wrong pose needs an unlikely camera.
    """
    deviations = (change**2 / UNKNOWN.variances(camera))[:3]
    return float(deviations.sum()) / (2 * math.log(10))


def _reason(coefficients: Array, sizes: Array, camera: Camera) -> str:
    linear, quadratic = sizes
    stretch = abs(coefficients[2] - coefficients[5])
    shear = abs(coefficients[3] + coefficients[4])
    if quadratic > linear:
        px = quadratic * max(camera.size) / 2
        return f"the image is bent by {px:.0f} px: it is not as a camera took it"
    if shear > stretch:
        px = shear * camera.height
        return f"rows are sheared by {px:.0f} px: a rolling shutter, or a moving camera"
    return (
        f"the image is squeezed by {100 * stretch:.0f} %: give it as the camera took it"
    )


def _prior(intrinsics: IntrinsicsPrior, camera: Camera) -> Array:
    """(23, 23) information: none of the pose, that of intrinsics, little of the displacement."""
    displacement = np.full(len(_DEGREE), _SIZES[-1] ** 2)
    known = np.concatenate([intrinsics.variances(camera), displacement])
    return np.diag(np.concatenate([np.zeros(_POSE), 1 / known]))


def _weighted(observed: Observed, camera: Camera, pose: SE3) -> _Equations:
    """The equations with the Cauchy weights of the errors beside the displacement."""
    errors, slope = linearise(
        observed.pixels,
        observed.points_m,
        pose.rotation_matrix(),
        pose.translation_m,
        camera,
        True,
    )
    # The place is the landmark's: that of the pixel contains its error.
    monomials = _monomials(observed.pixels + errors.T, camera)
    slope = np.concatenate([slope, monomials])
    residual, slope = whitened(observed.whitening, errors, slope)
    prior = _prior(FREE, camera)
    now = residual
    rounds = 0
    while True:
        squares = (now**2).sum(0)
        variance = robust_variance(squares)
        weight = 1 / (variance + squares)
        weighted = slope * weight
        rows = weighted.reshape(len(slope), -1)
        information = rows @ slope.reshape(len(slope), -1).T
        gradient = rows @ residual.ravel()
        if rounds == _ROUNDS:
            break
        step = normal_inverse(information + prior, _RIDGE) @ gradient
        now = residual - np.tensordot(step, slope, 1)
        rounds += 1
    squared = weight**2
    noise = squared @ squares / (2 * squared.sum())
    sums = (weighted @ cells_of(observed.pixels, camera)).reshape(len(slope), -1)
    # Stated noise has variance 1. The landmarks share a part of it, also where they err less.
    shared = SHARED * max(variance, 1.0) ** 2
    scatter = noise * rows @ rows.T
    scatter += shared * sums @ sums.T
    return _Equations(information, gradient, scatter)


def _monomials(pixels: Array, camera: Camera) -> Array:
    """(12, 2, n) displacements by each coefficient: of columns and rows by turns."""
    half = max(camera.size) / 2
    x, y = (pixels.T + 0.5 - [[camera.width / 2], [camera.height / 2]]) / half
    values = np.stack(
        [
            x**0,
            x,
            y,
            x * x,
            x * y,
            y * y,
        ]
    )
    shifts = half * values[:, None, None] * np.eye(2)[..., None]
    return shifts.reshape(len(_DEGREE), 2, -1)


def _sizes(coefficients: Array, covariance: Array, seen: Array) -> Array | None:
    """(2,) sizes of coefficients (12,) along axes (12, k); None where 0 is as likely."""
    deviations = coefficients @ seen
    pairs = np.meshgrid(_SIZES, _SIZES)
    sizes = np.stack(pairs, -1).reshape(-1, 2)
    response = seen.T * sizes[:, None, _DEGREE]
    covariances = response @ response.transpose(0, 2, 1)
    covariances += seen.T @ covariance @ seen
    solved = np.linalg.solve(covariances, deviations[:, None])
    squares = solved[..., 0] @ deviations
    _, volume = np.linalg.slogdet(covariances)
    likelihood = -(squares + volume) / 2
    highest = likelihood.max()
    if highest - likelihood[0] < SIGNIFICANT:
        return None
    # Few coefficients measure their variance to a factor; its mean is above the most likely.
    weight = np.exp(likelihood - highest)
    weight /= weight.sum()
    return np.sqrt(weight @ sizes**2)
