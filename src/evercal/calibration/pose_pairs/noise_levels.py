"""How large each kind of noise is, judged from the residuals of a fit, and what follows for it.

Residuals are smaller than the noise because the fit followed some of it. Restricted maximum
likelihood takes that into account: the levels are those for which quadratic forms of the residuals
have the values that they are expected to have (H. Patterson and R. Thompson, Recovery of
inter-block information, 1971; C. R. Rao, Estimation of variance and covariance components, 1971).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.stats import chi2, f

Array = NDArray[np.floating]

MAX_POSES = 50
"""Poses that the levels are judged from; more take longer and hardly change them."""
_FLOOR = np.diag([1e-14] * 6)
"""Metres^2 and radians^2 that no pose is better than, so that exact poses can be weighted."""
_PLAIN_SHARE = 0.25
"""Of plain noise in what a fit is weighted by."""
_ROUNDS, _HALVINGS = 30, 8


@dataclass(frozen=True, eq=False)
class NoiseLevels:
    """Variances of kinds of noise, and how sure they are."""

    kinds: tuple[str, ...]
    """Names of the kinds."""
    variance: Array
    """(k,) metres^2 or radians^2; 0 where a kind does not show."""
    uncertainty: Array
    """(k, k) covariance of `variance`; 0 for kinds that do not show."""

    def covariances(self, directions: Mapping[str, Array], known: Array) -> Array:
        """(n, 6, 6) of the residuals.

        Args:
            directions: by kind (n, 6, c) residuals by errors of one metre or one radian.
            known: (n, 6, 6) covariance that is there besides.
        """
        columns = np.concatenate([directions[kind] for kind in self.kinds], 2)
        counts = [directions[kind].shape[2] for kind in self.kinds]
        sized = columns * np.repeat(self.variance, counts)
        return known + _FLOOR + sized @ columns.transpose(0, 2, 1)


def estimate_levels(
    residual: Array,
    jacobian: Array,
    directions: Mapping[str, Array],
    known: Array,
    start: NoiseLevels | None = None,
) -> NoiseLevels:
    """The noise for which the residuals of a weighted fit are as large as they should be.

    Args:
        residual: (n, 6) of a fit.
        jacobian: (n, 6, p) of its unknowns.
        directions: by kind (n, 6, c) residuals by errors of one metre or one radian.
        known: (n, 6, 6) covariance of noise that is known already.
        start: levels of a similar fit.
    """
    chosen = np.unique(np.linspace(0, len(residual) - 1, MAX_POSES).round().astype(int))
    residual, jacobian, known = residual[chosen], jacobian[chosen], known[chosen]
    directions = {kind: columns[chosen] for kind, columns in directions.items()}
    problem = _Problem(residual, _basis(jacobian), tuple(directions.values()), known)
    variance = problem.first_guess() if start is None else start.variance
    forms = problem.at(variance)
    for _ in range(_ROUNDS):
        wanted = _solve_nonnegative(forms.gram, forms.values)
        change = problem.sizes * np.abs(wanted - variance)
        if change.max() <= 0.02 * (problem.sizes * wanted).max():
            break
        tried = problem.at(wanted)
        for _ in range(_HALVINGS):
            if tried.log_likelihood >= forms.log_likelihood:
                break
            wanted = (wanted + variance) / 2
            tried = problem.at(wanted)
        variance, forms = wanted, tried
    return NoiseLevels(tuple(directions), variance, _level_uncertainty(forms.gram, variance))


def working_noise(noise: Array, use: NDArray[np.bool_]) -> Array:
    """The covariance that a fit is weighted by: the estimated one, made more even.

    Estimated levels can claim that a certain mixture of shift and turn has hardly any noise, and a
    fit would then rest on that claim. A share of plain noise, equal in all directions and poses,
    costs little where the claim is right and keeps the fit sound where it is not.

    Args:
        noise: (n, 6, 6) as estimated.
        use: (n,) poses that count.
    """
    mean = noise[use].mean(0)
    metres2, radians2 = np.trace(mean[:3, :3]) / 3, np.trace(mean[3:, 3:]) / 3
    plain = np.diag(np.repeat([metres2, radians2], 3))
    return (1 - _PLAIN_SHARE) * noise + _PLAIN_SHARE * plain


def normal_inverse(normal: Array) -> Array:
    """Inverse of (p, p) normal equations; what they leave open comes out huge, not zero."""
    unit = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-200))
    values, axes = np.linalg.eigh(normal * np.outer(unit, unit))
    return np.outer(unit, unit) * ((axes / np.maximum(values, 1e-14)) @ axes.T)


@dataclass(frozen=True, eq=False)
class Gain:
    """How residuals of n poses move the p unknowns of a weighted fit, and what noise does there."""

    gain: Array
    """(n, p, 6) step of the unknowns by each residual, up to the sign."""
    covariance: Array
    """(p, p) of the unknowns under the noise, which need not be what the fit was weighted by."""

    @classmethod
    def of(cls, jacobian: Array, working: Array, noise: Array) -> Self:
        """From (n, 6, p) derivatives and (n, 6, 6) covariances, assumed and actual."""
        p = jacobian.shape[-1]
        weighted = np.linalg.inv(working) @ jacobian
        normal = weighted.reshape(-1, p).T @ jacobian.reshape(-1, p)
        gain = normal_inverse(normal) @ weighted.transpose(0, 2, 1)
        return cls(gain, (gain @ noise @ gain.transpose(0, 2, 1)).sum(0))

    def slopes(self, directions: Mapping[str, Array]) -> Array:
        """(k, p, p) how the covariance grows with the variance of each kind of noise."""
        moves = [self.gain @ columns for columns in directions.values()]
        return np.stack([(move @ move.transpose(0, 2, 1)).sum(0) for move in moves])


def loss_by_weights(
    jacobian: Array, noise: Array, directions: Mapping[str, Array], uncertainty: Array
) -> Array:
    """(p, p) what a fit loses because its weights were estimated from the same residuals.

    M. Kenward and J. Roger, Small sample inference for fixed effects from restricted maximum
    likelihood, 1997.

    Args:
        jacobian: (n, 6, p).
        noise: (n, 6, 6) covariance of the residuals.
        directions: by kind (n, 6, c).
        uncertainty: (k, k) covariance of the variances.
    """
    best = Gain.of(jacobian, noise, noise)
    inverse = np.linalg.inv(noise)
    # (k, n, p, 6): how noise of one kind in each residual reaches the unknowns.
    reached = np.stack([best.gain @ part @ part.transpose(0, 2, 1) for part in directions.values()])
    whitened = reached @ inverse
    products = np.einsum("knpi,lnqi->klpq", whitened, reached, optimize=True)
    slopes = best.slopes(directions)
    precision = normal_inverse(best.covariance)
    products -= np.einsum("kpq,qr,lrs->klps", slopes, precision, slopes, optimize=True)
    loss = 2 * np.einsum("kl,klpq->pq", uncertainty, products)
    return (loss + loss.T) / 2


def ellipsoid_factor(
    covariance: Array, slopes: Array, uncertainty: Array, share: float = 0.95
) -> float:
    """By how much to enlarge a covariance whose noise levels were estimated.

    Squared distances in units of an estimated covariance follow F rather than chi-square. Its
    degrees of freedom come from how sure the variance along each axis is (A. Fai and P. Cornelius,
    Approximate F-tests of multiple degree of freedom hypotheses, 1996). Enlarged by this factor,
    the chi-square quantile of `share` holds the truth as often as it says.

    Args:
        covariance: (d, d).
        slopes: (k, d, d) its derivatives by the variances of the noise.
        uncertainty: (k, k) covariance of those variances.
        share: probability.
    """
    d = len(covariance)
    variances, axes = np.linalg.eigh(covariance)
    gradient = np.einsum("dm,kde,em->mk", axes, slopes, axes)
    spread = np.einsum("mk,kl,ml->m", gradient, uncertainty, gradient)
    freedom = np.minimum(2 * variances**2 / np.maximum(spread, 1e-300), 1e6)
    expected = float(np.sum(np.where(freedom > 2, freedom / np.maximum(freedom - 2, 1e-9), 0.0)))
    freedom_all = 2 * expected / (expected - d) if expected > d else 2.0
    freedom_all = float(np.clip(freedom_all, 2.0, 1e6))
    return max(1.0, float(d * f.ppf(share, d, freedom_all) / chi2.ppf(share, d)))


@dataclass(frozen=True, eq=False)
class _Forms:
    """Quadratic forms of the residuals, one for each kind of noise, at some levels."""

    gram: Array
    """(k, k) how much a variance adds to the expectation of a form."""
    values: Array
    """(k,) less what known noise adds to them."""
    log_likelihood: float
    """Restricted, up to a constant."""


@dataclass(frozen=True, eq=False)
class _Problem:
    """What the levels are judged from; m poses."""

    residual: Array
    basis: Array
    """(m, 6, r) of what the unknowns can explain."""
    directions: tuple[Array, ...]
    known: Array

    @property
    def sizes(self) -> Array:
        """(k,) what a unit of variance adds to a residual; metres and radians on one footing."""
        return np.array([(part**2).sum() / len(part) for part in self.directions])

    def first_guess(self) -> Array:
        """Each kind alone explains a share of the residuals."""
        metres2, radians2 = (np.mean(part**2) for part in np.split(self.residual, 2, 1))
        turns = [bool(part[:, 3:].any()) for part in self.directions]
        return np.where(turns, radians2, metres2) / max(len(turns) / 2, 1) + 1e-18

    def at(self, variance: Array) -> _Forms:
        """The forms where the residuals are weighted by these levels."""
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
        # Noise that is known counts as one more kind, whose variance is one.
        columns = np.concatenate([*self.directions, np.linalg.cholesky(self.known + _FLOOR)], 2)
        starts = np.cumsum([0, *(part.shape[2] for part in self.directions)])
        right = projector.reshape(6 * m, m, 6).transpose(1, 0, 2) @ columns
        right = right.reshape(m, m, 6, -1).transpose(1, 0, 2, 3)
        both = columns.transpose(0, 2, 1)[:, None] @ right
        squares = np.einsum("ijab,ijab->ab", both, both)
        gram = np.add.reduceat(np.add.reduceat(squares, starts, 0), starts, 1)
        found = (error.reshape(m, 1, 6) @ columns)[:, 0]
        values = np.add.reduceat((found**2).sum(0), starts)
        likelihood = -np.linalg.slogdet(covariance)[1].sum() - np.linalg.slogdet(normal)[1]
        likelihood -= error @ self.residual.ravel()
        return _Forms(gram[:-1, :-1], values[:-1] - gram[:-1, -1], float(likelihood))


def _basis(jacobian: Array) -> Array:
    """(m, 6, r) orthonormal columns in place of those of the unknowns.

    The restricted likelihood depends on the space that the columns span alone. An unknown that the
    poses leave open adds nothing to it; with its column the normal equations would be singular.
    """
    columns = jacobian.reshape(-1, jacobian.shape[2])
    columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
    left, values, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, values > 1e-10 * values[0]].reshape(*jacobian.shape[:2], -1)


def _solve_nonnegative(gram: Array, forms: Array) -> Array:
    """Variances that are not negative, nearest in the metric of their uncertainty."""
    unit = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    # Kinds that look alike in these poses leave the matrix next to singular.
    values, axes = np.linalg.eigh(gram / np.outer(unit, unit))
    root = axes * np.sqrt(np.maximum(values, 1e-9))
    right = (axes.T @ (forms / unit)) / np.sqrt(np.maximum(values, 1e-9))
    return nnls(root.T, right)[0] / unit


def _level_uncertainty(gram: Array, variance: Array) -> Array:
    shows = variance > 0
    found = np.zeros_like(gram)
    if shows.any():
        unit = np.sqrt(np.maximum(np.diag(gram), 1e-300))[shows]
        scaled = gram[np.ix_(shows, shows)] / np.outer(unit, unit)
        inverse = np.linalg.inv(scaled + 1e-9 * np.eye(len(scaled)))
        found[np.ix_(shows, shows)] = 2.0 * inverse / np.outer(unit, unit)
    return found
