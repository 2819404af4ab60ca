"""Robust joint estimate of all unknowns of the hand-eye equation, and its covariance.

The levels of the kinds of noise are estimated from the residuals by restricted maximum likelihood,
because residuals are smaller than the noise: the fit follows part of it. See H. Patterson and
R. Thompson, Recovery of inter-block information, 1971; the iteration is that of H. Zhou and others,
MM algorithms for variance components models, 2019.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2, f

from evercal.calibration.pose_pairs.pose_equation import PoseEquation, System, Unknowns
from evercal.geometry.normal_equations import normal_inverse, normal_solution
from evercal.typing import Array, BoolArray

_STUDENT_FREEDOM = 3.0
"""Degrees of freedom of the Student t distribution of the residuals in `agreement`."""
_GROSS = 40.0
"""Squared distance of gross outliers, which the first noise estimate ignores."""
_REJECTION = 0.001
"""Probability of rejecting any pose of a recording without outliers."""
_MAX_ROUNDS = 12
"""Maximum number of rounds of refinement, noise estimation and rejection."""
_MAX_STEPS = 30
"""Maximum number of Gauss-Newton steps."""
MIN_POSES = 5
"""Minimum number of different poses; an outlier among fewer cannot be detected."""
KINDS = ("translation", "rotation about gripper", "depth", "rotation about board")
"""Kinds of noise: two of an arm, and two of a camera unless corners tell its noise."""
_FLOOR = np.diag([1e-14] * 6)
"""Minimum variance of a pose, metres^2 and radians^2, so that exact poses have finite weight."""
_MAX_LEVEL_ROUNDS = 100
"""Maximum number of rounds of the estimate of noise levels."""
_COVERAGE = 0.95
"""Coverage of the ellipsoids that `ellipsoid_factor` widens."""


class NoiseLevels(NamedTuple):
    """Variances of the kinds of noise."""

    variance: Array
    """(k,) metres^2 or radians^2."""
    uncertainty: Array
    """(k, k) covariance of the variances."""


@dataclass(frozen=True, eq=False)
class HandEyeFit:
    """The refined estimate."""

    at: Unknowns
    covariance: Array
    """(p, p) covariance of the unknowns, before multiplication by `factor`."""
    factor: float
    """Factor on the covariance for noise estimated from few poses, see `ellipsoid_factor`."""
    inliers: BoolArray
    """(n,) poses used for the estimate."""
    residual: Array
    """(n, 6) residuals of all poses in the fixed frame, metres and radians."""
    distance2: Array
    """(n,) squared Mahalanobis distance of each residual."""
    contributions: dict[str, Array]
    """(6, 6) covariance of `parent_from_camera` by kind of noise and group of extras."""
    weights: Array
    """(n, 6, 6) covariance of the noise."""
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
    inliers: BoolArray
    """(n,) poses without gross errors."""


def agreement(equation: PoseEquation, start: Unknowns) -> Agreement:
    """Estimate how well four or more poses agree, from a start of some degrees and centimetres."""
    n = len(equation)
    at = start
    # Median length of a 3-D normal variable, corrected for the degrees of freedom of the fit.
    to_sigma = np.sqrt(n / max(n - 2.0, 1.0)) / np.sqrt(chi2.ppf(0.5, 3))
    sigma = np.zeros(2)
    distance2 = np.zeros(n)
    for _ in range(_MAX_STEPS):
        system = equation.system(at)
        lengths = np.linalg.norm(system.residual.reshape(n, 2, 3), axis=2)
        sigma = np.maximum(np.median(lengths, 0) * to_sigma, 1e-8)
        distance2 = ((lengths / sigma) ** 2).sum(1)
        weight = (_STUDENT_FREEDOM + 6) / (_STUDENT_FREEDOM + distance2)
        information = np.diag(np.repeat(sigma**-2.0, 3))
        step, length2 = _step(system, weight[:, None, None] * information)
        at = at.moved(step)
        if length2 < 1e-2:
            break
    # The median of few poses is uncertain, so an inlier may have a large distance.
    gross = _GROSS * (1 + _GROSS / max(n - 3, 1) ** 2)
    return Agreement(
        at,
        *sigma.tolist(),
        inliers=distance2 < gross,
    )


def robust_fit(equation: PoseEquation, start: Agreement) -> HandEyeFit:
    """Refine the result of `agreement` for at least four sorted poses, and reject outliers."""
    n = len(equation)
    at = start.at
    inliers = start.inliers
    # Outliers cannot be detected; all poses widen the covariance.
    if inliers.sum() < MIN_POSES:
        inliers = np.ones(n, dtype=bool)
    levels = None
    variances = np.repeat([start.metres**2, start.radians**2], 3)
    weights = np.broadcast_to(np.diag(variances), (n, 6, 6))
    for _ in range(_MAX_ROUNDS):
        at = refine(equation, at, weights, inliers)
        used = equation[inliers].system(at)
        system = equation.system(at)
        levels = estimate_levels(used, levels)
        weights = noise_of(system, levels.variance)
        information = np.linalg.inv(weights[inliers])
        covariance = clipped_inverse(_normal(used, information @ used.jacobian))
        distance2 = _distances(system, weights, covariance, inliers)
        freedom = max(6 * int(inliers.sum()) - equation.unknowns, 2)
        limit = 6 * f.ppf(1 - _REJECTION / len(inliers), 6, freedom)
        selected = distance2 < limit
        too_few = selected.sum() < max(MIN_POSES, n // 2)
        if too_few or (selected == inliers).all():
            break
        inliers = selected
    assert levels is not None
    at = refine(equation, at, weights, inliers)
    return _result(equation, at, inliers, levels)


def refine(
    equation: PoseEquation, at: Unknowns, weights: Array, use: BoolArray
) -> Unknowns:
    """Minimize least squares by Gauss-Newton steps; `weights` (n, 6, 6) are covariances."""
    selected = equation[use]
    information = np.linalg.inv(weights[use])
    for _ in range(_MAX_STEPS):
        step, length2 = _step(selected.system(at), information)
        at = at.moved(step)
        if length2 < 1e-4:
            break
    return at


def least_sigma(equation: PoseEquation, fit: HandEyeFit) -> Array:
    """Return the (p,) standard deviations of the unknowns for noise of 0.1 mm and 0.01 degrees.

    With the estimated noise, exact poses would hide an unknown that they do not constrain.
    """
    system = equation[fit.inliers].system(fit.at)
    information = np.repeat([1e-4, np.deg2rad(0.01)], 3) ** -2.0
    normal = _normal(system, information[:, None] * system.jacobian)
    return np.sqrt(np.diag(clipped_inverse(normal)))


def estimate_levels(system: System, start: NoiseLevels | None = None) -> NoiseLevels:
    """Estimate the variance of each kind of noise, from the `start` of a similar fit."""
    spreads = _spreads(system)
    sizes = np.einsum("knii->k", spreads)
    if start is None:
        variance = _first_levels(system)
    else:
        variance = np.maximum(start.variance, 1e-6 * (sizes @ start.variance) / sizes)
    for _ in range(_MAX_LEVEL_ROUNDS):
        weight, weighted, inverse = _weighting(system, spreads, variance)
        gradient = _gradient(system, weighted)
        error = system.residual - system.jacobian @ (inverse @ gradient)
        error = (weight @ error[..., None])[..., 0]
        projector = weight - weighted @ inverse @ weighted.transpose(0, 2, 1)
        forms = np.einsum("ni,knij,nj->k", error, spreads, error)
        expected = np.einsum("nij,knji->k", projector, spreads)
        before = variance
        variance = variance * np.sqrt(forms / expected)
        change = (sizes * np.abs(variance - before)).max()
        if change <= 2e-3 * (sizes * variance).max():
            break
    weight, weighted, inverse = _weighting(system, spreads, variance)
    return NoiseLevels(variance, _level_uncertainty(spreads, weight, weighted, inverse))


def _first_levels(system: System) -> Array:
    metres2 = np.mean(system.residual[:, :3] ** 2)
    radians2 = np.mean(system.residual[:, 3:] ** 2)
    rotations = [kind.startswith("rotation") for kind in system.directions]
    levels = np.where(rotations, radians2, metres2)
    return levels * 2 / len(rotations) + 1e-18


def _weighting(
    system: System, spreads: Array, variance: Array
) -> tuple[Array, Array, Array]:
    weight = np.linalg.inv(system.known + _FLOOR + np.tensordot(variance, spreads, 1))
    weighted = weight @ system.jacobian
    return weight, weighted, clipped_inverse(_normal(system, weighted))


def _level_uncertainty(
    spreads: Array, weight: Array, weighted: Array, inverse: Array
) -> Array:
    turned = spreads @ weight
    own = np.einsum("anij,bnji->ab", turned, turned)
    sides = spreads @ weighted
    terms = "anip,nij,bnjq,pq->ab"
    shared = np.einsum(
        terms,
        sides,
        weight,
        sides,
        inverse,
        optimize=True,
    )
    terms = "nip,anij,njq->apq"
    grams = (
        np.einsum(
            terms,
            weighted,
            spreads,
            weighted,
            optimize=True,
        )
        @ inverse
    )
    gram = own - 2 * shared + np.einsum("apq,bqp->ab", grams, grams)
    return 2.0 * normal_inverse(gram, 1e-9)


def noise_of(system: System, variance: Array) -> Array:
    """Return the (n, 6, 6) covariance of the residuals, known and estimated noise together."""
    return system.known + _FLOOR + np.tensordot(variance, _spreads(system), 1)


def _spreads(system: System) -> Array:
    directions = system.directions.values()
    return np.stack([part @ part.transpose(0, 2, 1) for part in directions])


def ellipsoid_factor(
    covariance: Array,
    slopes: Array,
    uncertainty: Array,
) -> float:
    """Return the factor on a covariance (d, d) for its chi-square quantile of 95 % to cover 95 %.

    Squared distances by an estimated covariance follow an F distribution. A variance with nu
    degrees of freedom has a relative variance of 2 / nu (F. Satterthwaite, An approximate
    distribution of estimates of variance components, 1946); the axis with the fewest decides.
    `slopes` (k, d, d) are the derivatives of the covariance by the variances of the noise.
    """
    d = len(covariance)
    values, axes = np.linalg.eigh(covariance)
    whiten = axes / np.sqrt(np.maximum(values, 1e-300))
    gradient = np.einsum("dm,kde,em->mk", whiten, slopes, whiten)
    relative = np.einsum("mk,kl,ml->m", gradient, uncertainty, gradient).max()
    freedom = float(np.clip(2 / max(relative, 1e-300), 2.5, 1e6))
    quantile = d * f.ppf(_COVERAGE, d, freedom)
    return max(1.0, float(quantile / chi2.ppf(_COVERAGE, d)))


def clipped_inverse(normal: Array) -> Array:
    """Invert (p, p) normal equations; an unconstrained unknown gets a huge variance."""
    unit = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-200))
    units = np.outer(unit, unit)
    values, axes = np.linalg.eigh(normal * units)
    return units * ((axes / np.maximum(values, 1e-14)) @ axes.T)


def _normal(system: System, weighted: Array) -> Array:
    p = weighted.shape[2]
    return weighted.reshape(-1, p).T @ system.jacobian.reshape(-1, p) + system.prior


def _gradient(system: System, weighted: Array) -> Array:
    from_prior = system.prior @ system.change
    return np.einsum("nip,ni->p", weighted, system.residual) + from_prior


def _step(
    system: System,
    information: Array,
) -> tuple[Array, float]:
    """Return the Gauss-Newton step (p,) and its squared Mahalanobis length."""
    weighted = information @ system.jacobian
    normal = _normal(system, weighted)
    step = -normal_solution(normal, _gradient(system, weighted))
    return step, float(step @ normal @ step)


def _result(
    equation: PoseEquation, at: Unknowns, use: BoolArray, levels: NoiseLevels
) -> HandEyeFit:
    system = equation.system(at)
    used = equation[use].system(at)
    noise = noise_of(system, levels.variance)
    weighted = np.linalg.inv(noise[use]) @ used.jacobian
    covariance = clipped_inverse(_normal(used, weighted))
    # (n, p, 6) response of the unknowns to each residual.
    gain = covariance @ weighted.transpose(0, 2, 1)
    by_pose = gain[:, :6]
    slopes = np.zeros((len(levels.variance), 6, 6))
    contributions: dict[str, Array] = {}
    for k, (kind, directions) in enumerate(used.directions.items()):
        moves = by_pose @ directions
        slopes[k] = (moves @ moves.transpose(0, 2, 1)).sum(0)
        contributions[kind] = slopes[k] * levels.variance[k]
    known = by_pose @ used.known @ by_pose.transpose(0, 2, 1)
    contributions["known"] = known.sum(0)
    for group in dict.fromkeys(equation.extras.groups):
        columns = 12 + equation.extras.indices(group)
        by_prior = covariance[:6, columns]
        prior = used.prior[np.ix_(columns, columns)]
        contributions[group] = by_prior @ prior @ by_prior.T
    # Without a pose its residual no longer pulls; the leverage is the share it explains itself.
    leverage = used.jacobian @ gain
    free = np.eye(6) * (1 + 1e-9) - leverage
    pull = np.linalg.solve(free, used.residual[..., None])
    moved = np.zeros((len(use), 6))
    moved[use] = (by_pose @ pull)[..., 0]
    information = np.zeros(len(use))
    information[use] = np.trace(leverage, axis1=1, axis2=2) / equation.unknowns
    return HandEyeFit(
        at=at,
        covariance=covariance,
        factor=ellipsoid_factor(
            covariance[:6, :6],
            slopes,
            levels.uncertainty,
        ),
        inliers=use,
        residual=system.residual,
        distance2=_distances(system, noise, covariance, use),
        contributions=contributions,
        weights=noise,
        moved=moved,
        information=information,
    )


def _distances(
    system: System, noise: Array, covariance: Array, use: BoolArray
) -> Array:
    # Used poses have moved the estimate towards themselves. Alone, one has no spread on some axis.
    sign = np.where(use, -1.0, 1.0)[:, None, None]
    transposed = system.jacobian.transpose(0, 2, 1)
    explained = system.jacobian @ covariance @ transposed
    spread = (1 + 1e-3) * noise + sign * explained
    residual = system.residual[..., None]
    whitened = np.linalg.solve(spread, residual)[..., 0]
    return (system.residual * whitened).sum(1)
