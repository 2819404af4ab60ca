"""Robust joint refinement of both unknown transforms and their covariance."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, f

from evercal.calibration.pose_pairs.consensus import consensus_start
from evercal.calibration.pose_pairs.noise_levels import (
    Gain,
    NoiseLevels,
    ellipsoid_factor,
    estimate_levels,
    loss_by_weights,
    normal_inverse,
    working_noise,
)
from evercal.calibration.pose_pairs.pose_equation import PoseEquation, Unknowns

_TAILS = 3.0
"""Degrees of freedom of the Student t distribution in the first refinement."""
_GROSS = 40.0
"""Squared distance of gross outliers, which the first noise estimate ignores."""
_PLAIN_BELOW = 12
"""Number of poses below which similar kinds of noise are not separated."""
_REJECTION = 0.001
"""Probability of rejecting any pose of a recording without outliers."""
_ROUNDS = 12
"""Maximum number of rounds of refinement, noise estimation and rejection."""
MIN_POSES = 5
"""Minimum number of different poses; an outlier among fewer cannot be detected."""
Array = NDArray[np.floating]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class HandEyeFit:
    """The refined estimate."""

    at: Unknowns
    covariance: Array
    """(p, p) covariance of the unknowns, before multiplication by `factor`."""
    factor: float
    """Factor on the covariance for noise estimated from few poses, see `ellipsoid_factor`."""
    inliers: Mask
    """(n,) poses used for the estimate."""
    residual: Array
    """(n, 6) residuals of all poses in the fixed frame, metres and radians."""
    distance2: Array
    """(n,) squared Mahalanobis distance of each residual."""
    levels: NoiseLevels
    contributions: Array
    """(k, 6, 6) covariance of `parent_from_camera` due to each kind of noise."""


@dataclass(frozen=True)
class Agreement:
    """A quick robust estimate and its residuals."""

    at: Unknowns
    metres: float
    """Standard deviation of the board position per axis."""
    radians: float
    """Standard deviation of the board rotation per axis."""
    inliers: Mask
    """(n,) poses without gross errors."""


def agreement(equation: PoseEquation) -> Agreement:
    """Estimate how well four or more poses agree."""
    n, at = len(equation), consensus_start(equation)
    # Median length of a 3-D normal variable, corrected for the degrees of freedom of the fit.
    to_sigma = np.sqrt(n / max(n - 2.0, 1.0)) / np.sqrt(chi2.ppf(0.5, 3))
    sigma, distance2 = np.zeros(2), np.zeros(n)
    for _ in range(30):
        lengths = np.linalg.norm(equation.residuals(at).reshape(n, 2, 3), axis=2)
        sigma = np.maximum(np.median(lengths, 0) * to_sigma, 1e-8)
        distance2 = ((lengths / sigma) ** 2).sum(1)
        weight = (_TAILS + 6) / (_TAILS + distance2)
        information = weight[:, None, None] * np.diag(np.repeat(sigma**-2.0, 3))
        step, length2 = _step(equation, at, information)
        at = at.moved(step, equation.scale_known)
        if length2 < 1e-2:
            break
    # The median of few poses is uncertain, so an inlier may have a large distance.
    gross = _GROSS * (1 + _GROSS / max(n - 3, 1) ** 2)
    return Agreement(at, float(sigma[0]), float(sigma[1]), distance2 < gross)


def robust_fit(equation: PoseEquation, start: Agreement) -> HandEyeFit:
    """Refine the result of `agreement` for at least four sorted poses, and reject outliers."""
    at, inliers = start.at, start.inliers
    if inliers.sum() < MIN_POSES:  # outliers cannot be detected; all poses widen the covariance
        inliers = np.ones(len(equation), dtype=bool)
    covariance = np.broadcast_to(
        np.diag(np.repeat([start.metres**2, start.radians**2], 3)), (len(equation), 6, 6)
    )
    levels: NoiseLevels | None = None
    visited: list[bytes] = []
    for _ in range(_ROUNDS):
        at = refine(equation, at, covariance, inliers)
        before, levels = levels, _levels(equation, at, inliers, levels)
        noise = _noise(equation, at, levels)
        covariance = working_noise(noise, inliers)
        distance2 = _distances(equation, at, noise, inliers)
        selected = _within_noise(distance2, inliers, equation.unknowns)
        if selected.sum() < max(MIN_POSES, len(selected) // 2):
            break
        same, converged = bool((selected == inliers).all()), _converged(before, levels)
        # A pose at the threshold may alternate for ever; stop at the second visit.
        if (same and converged) or (not same and selected.tobytes() in visited):
            break
        visited.append(inliers.tobytes())
        inliers = selected
    assert levels is not None
    at = refine(equation, at, covariance, inliers)
    return _result(equation, at, inliers, levels)


def refine(equation: PoseEquation, at: Unknowns, covariance: Array, use: Mask) -> Unknowns:
    """Minimize weighted least squares by the Gauss-Newton method.

    Args:
        equation: n poses.
        at: Start within a few degrees and centimetres.
        covariance: (n, 6, 6) of the residuals.
        use: (n,).
    """
    selected, weight = equation[use], np.linalg.inv(covariance[use])
    for _ in range(30):
        step, length2 = _step(selected, at, weight)
        at = at.moved(step, equation.scale_known)
        if length2 < 1e-4:
            break
    return at


def _step(equation: PoseEquation, at: Unknowns, weight: Array) -> tuple[Array, float]:
    """Return a Gauss-Newton step and its squared Mahalanobis length."""
    p = equation.unknowns
    residual = equation.residuals(at)
    jacobian = equation.jacobian(at, residual)
    weighted = (weight @ jacobian).reshape(-1, p)
    normal = weighted.T @ jacobian.reshape(-1, p)
    # Scale the unknowns so that the normal equations are well conditioned.
    unit = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    right = unit * (weighted.T @ residual.ravel())
    step = -unit * np.linalg.lstsq(normal * np.outer(unit, unit), right, rcond=1e-13)[0]
    return step, float(step @ normal @ step)


def _levels(
    equation: PoseEquation, at: Unknowns, use: Mask, start: NoiseLevels | None
) -> NoiseLevels:
    selected = equation[use]
    residual = selected.residuals(at)
    jacobian = selected.jacobian(at, residual)
    directions = selected.noise_directions(at, plain=len(equation) < _PLAIN_BELOW)
    known = selected.known_noise(at)
    return estimate_levels(residual, jacobian, directions, known, start)


def fit_weights(equation: PoseEquation, fit: HandEyeFit) -> Array:
    """Return the (n, 6, 6) covariance used to weight the residuals of a fit."""
    return working_noise(_noise(equation, fit.at, fit.levels), fit.inliers)


def least_sigma(equation: PoseEquation, fit: HandEyeFit) -> Array:
    """Return the (p,) standard deviations of the unknowns by the geometry of the poses alone.

    The noise is set to 0.1 mm and 0.01 degrees. With the estimated noise, exact poses would hide an
    unknown that they do not constrain.
    """
    jacobian = equation[fit.inliers].jacobian(fit.at, fit.residual[fit.inliers])
    whitened = jacobian / np.repeat([1e-4, np.deg2rad(0.01)], 3)[:, None]
    flat = whitened.reshape(-1, equation.unknowns)
    return np.sqrt(np.diag(normal_inverse(flat.T @ flat)))


def _noise(equation: PoseEquation, at: Unknowns, levels: NoiseLevels) -> Array:
    return levels.covariances(equation.noise_directions(at), equation.known_noise(at))


def _converged(before: NoiseLevels | None, now: NoiseLevels) -> bool:
    return before is not None and bool(
        np.abs(now.variance - before.variance).max() <= 0.05 * now.variance.max()
    )


def _result(equation: PoseEquation, at: Unknowns, use: Mask, levels: NoiseLevels) -> HandEyeFit:
    noise = _noise(equation, at, levels)
    selected, residual = equation[use], equation.residuals(at)
    jacobian = selected.jacobian(at, residual[use])
    gain = Gain.of(jacobian, working_noise(noise, use)[use], noise[use])
    all_kinds = selected.noise_directions(at)
    kinds = {kind: all_kinds[kind] for kind in levels.kinds}
    covariance = gain.covariance + loss_by_weights(jacobian, noise[use], kinds, levels.uncertainty)
    slopes = gain.slopes(kinds)[:, :6, :6]
    factor = ellipsoid_factor(covariance[:6, :6], slopes, levels.uncertainty)
    distance2 = _distances(equation, at, noise, use)
    parts = slopes * levels.variance[:, None, None]
    return HandEyeFit(at, covariance, factor, use, residual, distance2, levels, parts)


def _distances(equation: PoseEquation, at: Unknowns, noise: Array, use: Mask) -> Array:
    """Return the (n,) squared Mahalanobis distance of each residual."""
    residual = equation.residuals(at)
    jacobian = equation.jacobian(at, residual)
    gain = Gain.of(jacobian[use], working_noise(noise, use)[use], noise[use])
    spread = noise + jacobian @ gain.covariance @ jacobian.transpose(0, 2, 1)
    # Used poses have moved the estimate towards themselves. A pose that alone constrains an unknown
    # has no spread along some axis.
    correlation = jacobian[use] @ gain.gain @ noise[use]
    spread[use] -= correlation + correlation.transpose(0, 2, 1)
    spread = spread + 1e-3 * noise
    return (residual * np.linalg.solve(spread, residual[..., None])[..., 0]).sum(1)


def _within_noise(distance2: Array, use: Mask, unknowns: int) -> Mask:
    """Return (n,) whether the distance of each pose is explained by the estimated noise."""
    freedom = max(6 * int(use.sum()) - unknowns, 2)
    return distance2 < 6 * f.ppf(1 - _REJECTION / len(use), 6, freedom)
