"""Variance components: estimate the level of each kind of noise from the residuals of a fit.

Residuals are smaller than the noise because the fit follows part of it. Restricted maximum
likelihood corrects this: it chooses the levels for which quadratic forms of the residuals equal
their expectations. See H. Patterson and R. Thompson, Recovery of inter-block information, 1971, and
C. R. Rao, Estimation of variance and covariance components, 1971.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.stats import chi2, f

if TYPE_CHECKING:
    from evercal.calibration.pose_pairs.pose_equation import System

Array = NDArray[np.floating]

MAX_POSES = 50
"""Maximum number of poses for the estimate; more take longer and hardly change it."""
_FLOOR = np.diag([1e-14] * 6)
"""Minimum variance of a pose, metres^2 and radians^2, so that exact poses have finite weight."""
_PLAIN_SHARE = 0.25
"""Share of isotropic noise in the weights of a fit."""
_ROUNDS, _HALVINGS = 30, 8
_COVERAGE = 0.95


@dataclass(frozen=True, eq=False)
class NoiseLevels:
    """Variance of each kind of noise, with its uncertainty."""

    kinds: tuple[str, ...]
    """(k,) names of the kinds."""
    variance: Array
    """(k,) metres^2 or radians^2; zero for kinds that are absent."""
    uncertainty: Array
    """(k, k) covariance of `variance`; zero for kinds that are absent."""

    def covariances(self, system: "System") -> Array:
        """Return the (n, 6, 6) covariance of the residuals of a system."""
        columns = np.concatenate([system.directions[kind] for kind in self.kinds], 2)
        counts = [system.directions[kind].shape[2] for kind in self.kinds]
        sized = columns * np.repeat(self.variance, counts)
        return system.known + _FLOOR + sized @ columns.transpose(0, 2, 1)


def estimate_levels(
    system: "System", kinds: tuple[str, ...], start: NoiseLevels | None = None
) -> NoiseLevels:
    """Estimate the noise levels by restricted maximum likelihood.

    Args:
        system: Linear system at the estimate.
        kinds: Kinds of noise of the poses.
        start: Levels of a similar fit.
    """
    chosen = np.linspace(0, system.poses - 1, MAX_POSES).round().astype(int)
    rows = np.r_[np.unique(chosen), system.poses : len(system.residual)]
    directions = tuple(system.directions[kind][rows] for kind in kinds)
    basis = _basis(system.jacobian[rows])
    problem = _Problem(system.residual[rows], basis, directions, system.known[rows])
    poses = system.residual[: system.poses]
    variance = _first_guess(poses, kinds) if start is None else start.variance
    forms = problem.at(variance)
    for _ in range(_ROUNDS):
        proposed = _solve_nonnegative(forms.gram, forms.values)
        change = problem.sizes * np.abs(proposed - variance)
        if change.max() <= 0.02 * (problem.sizes * proposed).max():
            break
        trial = problem.at(proposed)
        for _ in range(_HALVINGS):
            if trial.log_likelihood >= forms.log_likelihood:
                break
            proposed = (proposed + variance) / 2
            trial = problem.at(proposed)
        variance, forms = proposed, trial
    return NoiseLevels(kinds, variance, _level_uncertainty(forms.gram, variance))


def working_noise(noise: Array, use: NDArray[np.bool_]) -> Array:
    """Return the covariance (n, 6, 6) for the weights of a fit: the estimate, made more even.

    Estimated levels may assign almost no noise to some combination of translation and rotation, and
    the fit would then depend on it. A share of isotropic noise, equal for all poses, costs little
    accuracy if the levels are right and makes the fit robust if they are wrong.
    """
    mean = noise[use].mean(0)
    metres2, radians2 = np.trace(mean[:3, :3]) / 3, np.trace(mean[3:, 3:]) / 3
    plain = np.diag(np.repeat([metres2, radians2], 3))
    return (1 - _PLAIN_SHARE) * noise + _PLAIN_SHARE * plain


def normal_inverse(normal: Array) -> Array:
    """Invert (p, p) normal equations; an unconstrained unknown gets a huge variance."""
    unit = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-200))
    values, axes = np.linalg.eigh(normal * np.outer(unit, unit))
    return np.outer(unit, unit) * ((axes / np.maximum(values, 1e-14)) @ axes.T)


@dataclass(frozen=True, eq=False)
class Gain:
    """Linear response of the p unknowns of a weighted fit to the residuals of n poses."""

    gain: Array
    """(n, p, 6) derivative of the unknowns by each residual, up to the sign."""
    covariance: Array
    """(p, p) covariance of the unknowns under the actual noise."""

    @classmethod
    def of(cls, jacobian: Array, working: Array, noise: Array) -> Self:
        """Compute it from (n, 6, p) derivatives and (n, 6, 6) assumed and actual covariances."""
        p = jacobian.shape[-1]
        weighted = np.linalg.inv(working) @ jacobian
        normal = weighted.reshape(-1, p).T @ jacobian.reshape(-1, p)
        gain = normal_inverse(normal) @ weighted.transpose(0, 2, 1)
        return cls(gain, (gain @ noise @ gain.transpose(0, 2, 1)).sum(0))

    def slopes(self, directions: Sequence[Array]) -> Array:
        """Return the (k, p, p) derivatives of the covariance by the variances of the noise."""
        moves = [self.gain @ columns for columns in directions]
        return np.stack([(move @ move.transpose(0, 2, 1)).sum(0) for move in moves])


def ellipsoid_factor(covariance: Array, slopes: Array, uncertainty: Array) -> float:
    """Return the factor that corrects a covariance for estimated noise levels.

    Squared distances by an estimated covariance follow an F distribution rather than chi-square. A
    variance with nu degrees of freedom has a relative variance of 2 / nu (F. Satterthwaite, An
    approximate distribution of estimates of variance components, 1946); the axis with the fewest
    degrees of freedom decides. With this factor, the chi-square quantile of 95 % has a coverage of
    95 %.

    Args:
        covariance: (d, d).
        slopes: (k, d, d) derivatives of the covariance by the variances of the noise.
        uncertainty: (k, k) covariance of the variances.
    """
    d = len(covariance)
    values, axes = np.linalg.eigh(covariance)
    whiten = axes / np.sqrt(np.maximum(values, 1e-300))
    gradient = np.einsum("dm,kde,em->mk", whiten, slopes, whiten)
    relative = np.einsum("mk,kl,ml->m", gradient, uncertainty, gradient).max()
    freedom = float(np.clip(2 / max(relative, 1e-300), 2.5, 1e6))
    return max(1.0, float(d * f.ppf(_COVERAGE, d, freedom) / chi2.ppf(_COVERAGE, d)))


@dataclass(frozen=True, eq=False)
class _Forms:
    """Quadratic forms of the residuals, one for each kind of noise."""

    gram: Array
    """(k, k) derivative of the expected forms by the variances."""
    values: Array
    """(k,) forms, less the contribution of known noise."""
    log_likelihood: float
    """Restricted log likelihood up to a constant."""


@dataclass(frozen=True, eq=False)
class _Problem:
    """Data of the estimate; m poses."""

    residual: Array
    """(m, 6)"""
    basis: Array
    """(m, 6, r) basis of the residuals that the unknowns can explain."""
    directions: tuple[Array, ...]
    """(m, 6, c) of each kind."""
    known: Array
    """(m, 6, 6)"""

    @property
    def sizes(self) -> Array:
        """(k,) squared residual due to a unit of variance, metres and radians together."""
        return np.array([(part**2).sum() / len(part) for part in self.directions])

    def at(self, variance: Array) -> _Forms:
        """Return the forms with weights of these variances."""
        m = len(self.residual)
        covariance = self.known + _FLOOR
        for part, level in zip(self.directions, variance, strict=True):
            covariance = covariance + level * part @ part.transpose(0, 2, 1)
        weight = np.linalg.inv(covariance)
        weighted = (weight @ self.basis).reshape(6 * m, -1)
        normal = self.basis.reshape(6 * m, -1).T @ weighted
        projector = -weighted @ np.linalg.solve(normal, weighted.T)
        projector.reshape(m, 6, m, 6)[np.arange(m), :, np.arange(m)] += weight
        error = projector @ self.residual.ravel()
        # Known noise is one more kind, with variance one.
        columns = np.concatenate([*self.directions, np.linalg.cholesky(self.known + _FLOOR)], 2)
        starts = np.cumsum([0, *(part.shape[2] for part in self.directions)])
        right = projector.reshape(6 * m, m, 6).transpose(1, 0, 2) @ columns
        right = right.reshape(m, m, 6, -1).transpose(1, 0, 2, 3)
        both = columns.transpose(0, 2, 1)[:, None] @ right
        squares = np.einsum("ijab,ijab->ab", both, both)
        gram = np.add.reduceat(np.add.reduceat(squares, starts, 0), starts, 1)
        projected = (error.reshape(m, 1, 6) @ columns)[:, 0]
        values = np.add.reduceat((projected**2).sum(0), starts)
        likelihood = -np.linalg.slogdet(covariance)[1].sum() - np.linalg.slogdet(normal)[1]
        likelihood -= error @ self.residual.ravel()
        return _Forms(gram[:-1, :-1], values[:-1] - gram[:-1, -1], float(likelihood))


def _first_guess(residual: Array, kinds: tuple[str, ...]) -> Array:
    """Return variances that explain equal shares of the residuals."""
    metres2, radians2 = (np.mean(part**2) for part in np.split(residual, 2, 1))
    rotations = [kind.startswith("rotation") for kind in kinds]
    return np.where(rotations, radians2, metres2) / max(len(kinds) / 2, 1) + 1e-18


def _basis(jacobian: Array) -> Array:
    """Return (m, 6, r) orthonormal columns that span the columns of the unknowns.

    The restricted likelihood depends only on this space. The column of an unconstrained unknown
    would make the normal equations singular.
    """
    columns = jacobian.reshape(-1, jacobian.shape[2])
    columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
    left, values, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, values > 1e-10 * values[0]].reshape(*jacobian.shape[:2], -1)


def _solve_nonnegative(gram: Array, forms: Array) -> Array:
    """Return the nonnegative variances nearest to the solution, by their uncertainty."""
    unit = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    # Kinds with similar effects on these poses make the matrix nearly singular.
    values, axes = np.linalg.eigh(gram / np.outer(unit, unit))
    root = axes * np.sqrt(np.maximum(values, 1e-9))
    right = (axes.T @ (forms / unit)) / np.sqrt(np.maximum(values, 1e-9))
    return nnls(root.T, right)[0] / unit


def _level_uncertainty(gram: Array, variance: Array) -> Array:
    present = variance > 0
    uncertainty = np.zeros_like(gram)
    if present.any():
        unit = np.sqrt(np.maximum(np.diag(gram), 1e-300))[present]
        scaled = gram[np.ix_(present, present)] / np.outer(unit, unit)
        inverse = np.linalg.inv(scaled + 1e-9 * np.eye(len(scaled)))
        uncertainty[np.ix_(present, present)] = 2.0 * inverse / np.outer(unit, unit)
    return uncertainty
