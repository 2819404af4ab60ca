"""`SharedNoise`: the covariance of errors of n poses, of which some are shared.

It is the sum of a block of each pose and a matrix of low rank, and is inverted as such:
M. Woodbury, Inverting modified matrices, 1950.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.linalg import block_diag, cho_solve, solve_triangular
from scipy.stats import norm

from evercal.geometry.normal_equations import normal_inverse
from evercal.robot.pose_errors import SharedErrors
from evercal.typing import Array

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


class SharedNoise:
    """Covariance of the errors (n, 6) of poses.

    `variance` (k,) are those of the k kinds `shared`.
    """

    def __init__(
        self,
        independent: Array,
        variance: Array,
        shared: Mapping[str, SharedErrors],
    ) -> None:
        self.independent = independent
        """(n, 6, 6) of errors that no other pose shares."""
        n = len(independent)
        parts = [np.zeros((n, 6, 0))]
        for size, kind in zip(np.sqrt(variance), shared.values(), strict=True):
            parts.append(size * kind.slopes)
        self.shared = np.concatenate(parts, 2)
        """(n, 6, r) errors by the effects of all kinds that poses share; their covariance is the
        identity before the errors are known."""
        self.information = np.linalg.inv(independent)
        rank = self.shared.shape[2]
        flat = self.shared.reshape(6 * n, rank)
        weighted = (self.information @ self.shared).reshape(6 * n, rank)
        inner = flat.T @ weighted
        inner.flat[:: rank + 1] += 1.0
        self._root = np.linalg.cholesky(inner)
        half = solve_triangular(self._root, weighted.T, lower=True, check_finite=False)
        self.half = half.T
        """(6 n, r): the inverse covariance is that of independent errors less half @ half.T."""

    def weighted(self, values: Array) -> Array:
        """Multiply (n, 6, m) by the inverse covariance."""
        own = self.information @ values
        flat = values.reshape(len(self.half), values.shape[2])
        shared = self.half @ (self.half.T @ flat)
        return own - shared.reshape(own.shape)

    def blocks(self) -> Array:
        """(n, 6, 6) blocks of the inverse covariance."""
        half = self.half.reshape(*self.shared.shape)
        return self.information - half @ half.transpose(0, 2, 1)

    def inverse(self) -> Array:
        """(6 n, 6 n) inverse covariance."""
        return block_diag(*self.information) - self.half @ self.half.T

    def unexplained(self) -> Array:
        """(r, r) covariance of the effects, if the errors were known but for independent ones."""
        return cho_solve((self._root, True), np.eye(len(self._root)))

    def logarithm(self) -> float:
        """Logarithm of the determinant of the covariance."""
        own = np.linalg.slogdet(self.independent)[1].sum()
        return float(own + 2 * np.log(np.diag(self._root)).sum())


def variance_uncertainty(
    pull: Array, independent: Sequence[Array], shared: Mapping[str, SharedErrors]
) -> Array:
    """(k, k) covariance of the variances of all kinds, by their expected information.

    Args:
        pull: (6 n, 6 n) inverse covariance of the residuals less what the unknowns explain.
        independent: (6 n, c) effects of each kind that poses do not share.
        shared: Kinds that they share.
    """
    effects = list(independent)
    for kind in shared.values():
        effects.append(kind.slopes.reshape(len(pull), -1))
    ranks = [kind.shape[1] for kind in effects]
    # Which effects are of which kind.
    member = np.eye(len(effects))[np.repeat(np.arange(len(effects)), ranks)]
    every = np.concatenate(effects, 1)
    between = (every.T @ pull @ every) ** 2
    information = member.T @ between @ member
    for k, kind in enumerate(shared.values(), len(independent)):
        information[k, k] += _NOTHING_SEEN / kind.usual**4
    return 2 * normal_inverse(information, _RIDGE)


def mean_variances(variance: Array, uncertainty: Array) -> Array:
    """Means (k,) of variances whose likelihood is largest at `variance`.

    They differ where it is largest near zero, by what the residuals do not exclude.
    """
    sigma = np.sqrt(np.diag(uncertainty))
    ratio = np.minimum(variance / sigma, _MOST_RATIO)
    excess = _AT_ZERO * sigma * norm.pdf(ratio) / norm.cdf(ratio)
    # A kind that grows takes from kinds that look like it.
    shift = uncertainty @ (excess / sigma**2)
    return np.maximum(variance + shift, _LEAST_LEFT * variance)
