"""Noise of the hand-eye equation, and the sizes of its kinds by restricted maximum likelihood.

Residuals are smaller than the noise, because the fit follows part of it: H. Patterson and
R. Thompson, Recovery of inter-block information, 1971.
"""

from dataclasses import replace
from functools import partial

import numpy as np
from scipy.linalg import block_diag
from scipy.stats import chi2, f, norm

from evercal.calibration.pose_pairs.pose_equation import System
from evercal.geometry.normal_equations import normal_inverse
from evercal.robot.pose_errors import FIRST_SHARED, SharedNoise, most_likely
from evercal.typing import Array

FLOOR = np.diag([1e-14] * 6)
"""Minimum variance of a pose, metres^2 and radians^2, so that exact poses have finite weight."""

_PSEUDO = 1.0
"""Number of pseudo-residuals of each independent kind, as large as all residuals together: without
them, few poses have a likelihood that is largest where one kind is zero and fits exactly."""
_AT_ZERO = 0.3
"""Mean of a variance whose likelihood falls from zero on like that of a normal variable, by the
mean of the positive half of that variable."""
_LEAST_LEFT = 0.5
"""Share of a variance that is left at least."""
_MOST_RATIO = 30.0
"""Standard deviations from zero at which a variance is known as well as any."""
_RIDGE = 1e-9
"""Share by which kinds of noise differ at least."""
_NOTHING_SEEN = 2 * (_AT_ZERO * np.sqrt(2 / np.pi)) ** 2
"""Information on a variance without any residual, by which its mean is that of the prior."""
_COVERAGE = 0.95
"""Coverage of the ellipsoids that `ellipsoid_factor` widens."""


class Noise(SharedNoise):
    """Covariance of the residuals (n, 6) of a system, by the variances of its kinds."""

    def __init__(self, system: System, variance: Array) -> None:
        count = len(system.directions)
        own = np.tensordot(variance[:count], _spreads(system), 1)
        super().__init__(
            system.known + FLOOR + own,
            variance[count:],
            system.shared,
        )


def clipped_inverse(normal: Array) -> Array:
    """Invert (p, p) normal equations; an unconstrained unknown gets a huge variance."""
    factor, _ = _factor(normal)
    return factor @ factor.T


def normal_matrix(system: System, weighted: Array) -> Array:
    """(p, p) normal equations of a system, by its weighted Jacobian (n, 6, p)."""
    p = weighted.shape[2]
    return weighted.reshape(-1, p).T @ system.jacobian.reshape(-1, p) + system.prior


def slope_of(system: System, weighted: Array) -> Array:
    """(p,) half of the slope of the sum of squares."""
    from_prior = system.prior @ system.change
    return np.einsum("nip,ni->p", weighted, system.residual) + from_prior


def estimate_levels(system: System, start: Array | None = None) -> Array:
    """Variance (k,) of each kind of noise, metres^2 or radians^2; `start` is that of a similar fit.

    The kinds are those of `System.directions`, then of `System.shared`.
    """
    return _most_likely(system, start)[0]


def evidence_of_shared(system: System) -> float:
    """Logarithm of the likelihood ratio of a system and the same without errors that are shared."""
    _, alone = _most_likely(replace(system, shared={}))
    _, least = _most_likely(system)
    return (alone - least) / 2


def _most_likely(system: System, start: Array | None = None) -> tuple[Array, float]:
    first = _first_levels(system)
    at = first
    if start is not None:
        at = np.clip(start, 1e-5 * first, 1e3 * first)
    likelihood = partial(_likelihood, system=system, first=first)
    return most_likely(likelihood, first, at)


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
    gradient = np.einsum(
        "dm,kde,em->mk",
        whiten,
        slopes,
        whiten,
    )
    relative = np.einsum(
        "mk,kl,ml->m",
        gradient,
        uncertainty,
        gradient,
    ).max()
    freedom = float(np.clip(2 / max(relative, 1e-300), 2.5, 1e6))
    quantile = d * f.ppf(_COVERAGE, d, freedom)
    return max(1.0, float(quantile / chi2.ppf(_COVERAGE, d)))


def mean_levels(system: System, variance: Array) -> Array:
    """Mean of each variance (k,), given that where its likelihood is largest.

    They differ where it is largest near zero, by what the residuals do not exclude.
    """
    uncertainty = level_uncertainty(system, variance)
    sigma = np.sqrt(np.diag(uncertainty))
    ratio = np.minimum(variance / sigma, _MOST_RATIO)
    excess = _AT_ZERO * sigma * norm.pdf(ratio) / norm.cdf(ratio)
    # A kind that grows takes from kinds that look like it.
    shift = uncertainty @ (excess / sigma**2)
    return np.maximum(variance + shift, _LEAST_LEFT * variance)


def level_uncertainty(system: System, variance: Array) -> Array:
    """(k, k) covariance of the variances, by their expected information."""
    noise = Noise(system, variance)
    rows = system.residual.size
    weighted = noise.weighted(system.jacobian)
    factor, _ = _factor(normal_matrix(system, weighted))
    explained = (weighted @ factor).reshape(rows, -1)
    pull = noise.inverse() - explained @ explained.T
    effects: list[Array] = []
    for directions in system.directions.values():
        effects.append(np.asarray(block_diag(*directions)))
    for kind in system.shared.values():
        effects.append(kind.slopes.reshape(rows, -1))
    ranks = [kind.shape[1] for kind in effects]
    # Which effects are of which kind.
    member = np.eye(len(effects))[np.repeat(np.arange(len(effects)), ranks)]
    every = np.concatenate(effects, 1)
    between = (every.T @ pull @ every) ** 2
    information = member.T @ between @ member
    count = len(system.directions)
    for k, kind in enumerate(system.shared.values(), count):
        information[k, k] += _NOTHING_SEEN / kind.usual**4
    return 2 * normal_inverse(information, _RIDGE)


def _likelihood(logarithms: Array, system: System, first: Array) -> tuple[float, Array]:
    """Twice the negative logarithm of the restricted likelihood, and its slope.

    `first` are rough variances, the size of the pseudo-residuals.
    """
    variance = np.exp(logarithms)
    noise = Noise(system, variance)
    weighted = noise.weighted(system.jacobian)
    factor, determinant = _factor(normal_matrix(system, weighted))
    step = -factor @ (factor.T @ slope_of(system, weighted))
    error = system.residual + system.jacobian @ step
    pull = noise.weighted(error[..., None])[..., 0]
    squares = (pull * system.residual).sum()
    squares += system.change @ system.prior @ (system.change + step)
    value = noise.logarithm() + determinant + squares
    half = weighted @ factor
    own = noise.blocks() - half @ half.transpose(0, 2, 1)
    slope = []
    count = len(system.directions)
    kinds = zip(
        variance,
        first,
        system.directions.values(),
        strict=False,
    )
    for size, level, spread in kinds:
        expected = (spread * (own @ spread)).sum()
        observed = ((spread.transpose(0, 2, 1) @ pull[..., None]) ** 2).sum()
        slope.append(size * (expected - observed) + _PSEUDO * (1 - level / size))
        value += _PSEUDO * (np.log(size) + level / size)
    rows = pull.size
    effects = noise.shared.reshape(rows, noise.shared.shape[2]).T
    observed = (effects @ pull.ravel()) ** 2
    explained = ((effects @ half.reshape(rows, -1)) ** 2).sum(1)
    expected = 1 - np.diag(noise.unexplained()) - explained
    begin = 0
    for size, kind in zip(variance[count:], system.shared.values(), strict=True):
        end = begin + kind.slopes.shape[2]
        usual = size / kind.usual**2
        value += usual
        slope.append((expected - observed)[begin:end].sum() + usual)
        begin = end
    return float(value), np.array(slope)


def _factor(normal: Array) -> tuple[Array, float]:
    """Factor F of the inverse F F^T of (p, p) normal equations; logarithm of their determinant."""
    unit = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-200))
    values, axes = np.linalg.eigh(normal * np.outer(unit, unit))
    values = np.maximum(values, 1e-14)
    determinant = np.log(values).sum() - 2 * np.log(unit).sum()
    return unit[:, None] * axes / np.sqrt(values), float(determinant)


def _first_levels(system: System) -> Array:
    """Rough variances of all kinds, by the residuals."""
    metres2 = np.mean(system.residual[:, :3] ** 2)
    radians2 = np.mean(system.residual[:, 3:] ** 2)
    levels = []
    for kind in system.directions:
        own = radians2 if kind.startswith("rotation") else metres2
        levels.append(2 / len(system.directions) * own)
    for kind in system.shared:
        own = metres2 if kind.endswith("translation") else radians2
        levels.append(FIRST_SHARED * own)
    return np.array(levels) + 1e-18


def _spreads(system: System) -> Array:
    directions = system.directions.values()
    return np.stack([part @ part.transpose(0, 2, 1) for part in directions])
