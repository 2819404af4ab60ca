"""Robust joint estimate of all unknowns of the hand-eye equation, and its covariance."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, f

from evercal.calibration.pose_pairs.noise import (
    Gain,
    NoiseLevels,
    ellipsoid_factor,
    estimate_levels,
    normal_inverse,
    working_noise,
)
from evercal.calibration.pose_pairs.pose_equation import PoseEquation, System, Unknowns

_TAILS = 3.0
"""Degrees of freedom of the Student t distribution in the first refinement."""
_GROSS = 40.0
"""Squared distance of gross outliers, which the first noise estimate ignores."""
_REJECTION = 0.001
"""Probability of rejecting any pose of a recording without outliers."""
_ROUNDS = 12
"""Maximum number of rounds of refinement, noise estimation and rejection."""
MIN_POSES = 5
"""Minimum number of different poses; an outlier among fewer cannot be detected."""
_MANY = 12
"""Number of poses that separate four kinds of noise."""
ARM_KINDS = ("translation", "rotation about gripper")
"""Kinds of noise besides that of the corners, and the kinds that few poses can separate."""
POSE_KINDS = (*ARM_KINDS, "depth", "rotation about board")
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
    contributions: dict[str, Array]
    """(6, 6) covariance of `parent_from_camera` due to each kind of noise, to the noise that is
    known (`known`) and to each group of extras."""
    weights: Array
    """(n, 6, 6) covariance that weights the residuals."""

    moved: Array
    """(n, 6) change of `parent_from_camera` if a pose is left out; zero for rejected poses."""
    information: Array
    """(n,) share of the information on all unknowns; zero for rejected poses."""

    @property
    def sigma(self) -> Array:
        """(p,) standard deviations of the unknowns."""
        return np.sqrt(self.factor * np.diag(self.covariance))


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


def agreement(equation: PoseEquation, start: Unknowns) -> Agreement:
    """Estimate how well four or more poses agree, from a start of some degrees and centimetres."""
    n, at = len(equation), start
    # Median length of a 3-D normal variable, corrected for the degrees of freedom of the fit.
    to_sigma = np.sqrt(n / max(n - 2.0, 1.0)) / np.sqrt(chi2.ppf(0.5, 3))
    sigma, distance2 = np.zeros(2), np.zeros(n)
    for _ in range(30):
        system = equation.system(at)
        lengths = np.linalg.norm(system.residual[:n].reshape(n, 2, 3), axis=2)
        sigma = np.maximum(np.median(lengths, 0) * to_sigma, 1e-8)
        distance2 = ((lengths / sigma) ** 2).sum(1)
        information = np.broadcast_to(np.eye(6), (len(system.residual), 6, 6)).copy()
        weight = (_TAILS + 6) / (_TAILS + distance2)
        information[:n] = weight[:, None, None] * np.diag(np.repeat(sigma**-2.0, 3))
        step, length2 = _step(system, information)
        at = at.moved(step)
        if length2 < 1e-2:
            break
    # The median of few poses is uncertain, so an inlier may have a large distance.
    gross = _GROSS * (1 + _GROSS / max(n - 3, 1) ** 2)
    return Agreement(at, float(sigma[0]), float(sigma[1]), distance2 < gross)


def robust_fit(equation: PoseEquation, start: Agreement) -> HandEyeFit:
    """Refine the result of `agreement` for at least four sorted poses, and reject outliers."""
    at, inliers = start.at, start.inliers
    few = len(equation) < _MANY or "intrinsics" in equation.extras.groups
    kinds = ARM_KINDS if few else POSE_KINDS
    if inliers.sum() < MIN_POSES:  # outliers cannot be detected; all poses widen the covariance
        inliers = np.ones(len(equation), dtype=bool)
    plain = np.diag(np.repeat([start.metres**2, start.radians**2], 3))
    weights = np.broadcast_to(plain, (len(equation), 6, 6))
    levels: NoiseLevels | None = None
    visited: list[bytes] = []
    for _ in range(_ROUNDS):
        at = refine(equation, at, weights, inliers)
        used = equation[inliers].system(at)
        before, levels = levels, estimate_levels(used, kinds, levels)
        system = equation.system(at)
        noise = levels.covariances(system)
        weights = working_noise(noise[: len(equation)], inliers)
        distance2 = _distances(system, noise, weights, inliers)
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
    at = refine(equation, at, weights, inliers)
    return _result(equation, at, inliers, levels)


def refine(equation: PoseEquation, at: Unknowns, weights: Array, use: Mask) -> Unknowns:
    """Minimize weighted least squares by the Gauss-Newton method.

    Args:
        equation: n poses.
        at: Start within a few degrees and centimetres.
        weights: (n, 6, 6) covariance of the residuals.
        use: (n,).
    """
    selected, information = equation[use], np.linalg.inv(weights[use])
    for _ in range(30):
        system = selected.system(at)
        step, length2 = _step(system, _with_identity(information, system))
        at = at.moved(step)
        if length2 < 1e-4:
            break
    return at


def least_sigma(equation: PoseEquation, fit: HandEyeFit) -> Array:
    """Return the (p,) standard deviations of the unknowns by the geometry of the poses alone.

    The noise is set to 0.1 mm and 0.01 degrees. With the estimated noise, exact poses would hide an
    unknown that they do not constrain.
    """
    system = equation[fit.inliers].system(fit.at)
    whitened = system.jacobian.copy()
    whitened[: system.poses] /= np.repeat([1e-4, np.deg2rad(0.01)], 3)[:, None]
    flat = whitened.reshape(-1, equation.unknowns)
    return np.sqrt(np.diag(normal_inverse(flat.T @ flat)))


def _with_identity(blocks: Array, system: System) -> Array:
    """Append the unit covariance of the priors."""
    priors = np.broadcast_to(np.eye(6), (len(system.residual) - len(blocks), 6, 6))
    return np.concatenate([blocks, priors])


def _step(system: System, information: Array) -> tuple[Array, float]:
    """Return a Gauss-Newton step and its squared Mahalanobis length."""
    p = system.jacobian.shape[2]
    weighted = (information @ system.jacobian).reshape(-1, p)
    normal = weighted.T @ system.jacobian.reshape(-1, p)
    # Scale the unknowns so that the normal equations are well conditioned.
    unit = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    right = unit * (weighted.T @ system.residual.ravel())
    step = -unit * np.linalg.lstsq(normal * np.outer(unit, unit), right, rcond=1e-13)[0]
    return step, float(step @ normal @ step)


def _converged(before: NoiseLevels | None, now: NoiseLevels) -> bool:
    return before is not None and bool(
        np.abs(now.variance - before.variance).max() <= 0.05 * now.variance.max()
    )


def _result(equation: PoseEquation, at: Unknowns, use: Mask, levels: NoiseLevels) -> HandEyeFit:
    system, used = equation.system(at), equation[use].system(at)
    noise, used_noise = levels.covariances(system), levels.covariances(used)
    weights = working_noise(noise[: len(equation)], use)
    working = _with_identity(weights[use], used)
    gain = Gain.of(used.jacobian, working, used_noise)
    slopes = gain.slopes([used.directions[kind] for kind in levels.kinds])[:, :6, :6]
    factor = ellipsoid_factor(gain.covariance[:6, :6], slopes, levels.uncertainty)
    parts = dict(zip(levels.kinds, slopes * levels.variance[:, None, None], strict=True))
    own = gain.gain[:, :6] @ used.known @ gain.gain[:, :6].transpose(0, 2, 1)
    for name, block in zip(("known",) * used.poses + used.priors, own, strict=True):
        parts[name] = parts.get(name, 0.0) + block
    # Without a pose its residual no longer pulls; the leverage is the share it explains itself.
    leverage = used.jacobian @ gain.gain
    pull = np.linalg.solve(np.eye(6) * (1 + 1e-9) - leverage, used.residual[..., None])
    moved, information = np.zeros((len(use), 6)), np.zeros(len(use))
    moved[use] = (gain.gain[:, :6] @ pull)[: used.poses, :, 0]
    information[use] = np.trace(leverage, axis1=1, axis2=2)[: used.poses] / equation.unknowns
    distance2 = _distances(system, noise, weights, use)
    residual = system.residual[: len(equation)]
    return HandEyeFit(
        at=at,
        covariance=gain.covariance,
        factor=factor,
        inliers=use,
        residual=residual,
        distance2=distance2,
        levels=levels,
        contributions=parts,
        weights=weights,
        moved=moved,
        information=information,
    )


def _distances(system: System, noise: Array, weights: Array, use: Mask) -> Array:
    """Return the (n,) squared Mahalanobis distance of each residual."""
    n = system.poses
    rows = np.concatenate([use, np.ones(len(noise) - n, dtype=bool)])
    gain = Gain.of(system.jacobian[rows], _with_identity(weights, system)[rows], noise[rows])
    jacobian, noise = system.jacobian[:n], noise[:n]
    spread = noise + jacobian @ gain.covariance @ jacobian.transpose(0, 2, 1)
    # Used poses have moved the estimate towards themselves. A pose that alone constrains an unknown
    # has no spread along some axis.
    correlation = jacobian[use] @ gain.gain[: use.sum()] @ noise[use]
    spread[use] -= correlation + correlation.transpose(0, 2, 1)
    spread = spread + 1e-3 * noise
    residual = system.residual[:n]
    return (residual * np.linalg.solve(spread, residual[..., None])[..., 0]).sum(1)


def _within_noise(distance2: Array, use: Mask, unknowns: int) -> Mask:
    """Return (n,) whether the distance of each pose is explained by the estimated noise."""
    freedom = max(6 * int(use.sum()) - unknowns, 2)
    return distance2 < 6 * f.ppf(1 - _REJECTION / len(use), 6, freedom)
