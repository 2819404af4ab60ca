"""Acceptance: the law by which poses are accepted.

One law and one rate decide. At a wrong pose some landmarks match by chance, and how many differs
from place to place: the inliers among n searched landmarks have a beta-binomial distribution. The
support of a pose is -log10 of the probability that a wrong one has as many inliers. A pose is
accepted where that is below the rate of false accepts.
"""

from functools import lru_cache
from math import lgamma, log, log10

import numpy as np

CHANCE = 17.2, 306.0
"""Beta distribution of the inlier ratio of wrong poses: 0.053 +- 0.012 (research/map.md)."""
SAME_SURFACE = 3
"""Landmarks that show the same piece of a surface from several keyframes and match together."""
FALSE_ACCEPTS = 1e-4
"""Probability that a wrong pose is accepted."""
FULL_SUPPORT = 36.0
"""Poses with less support get a wider covariance: their landmarks are on few surfaces, whose errors
are correlated (research/map.md)."""
USELESS_M = 0.05
"""Standard deviation of the position per axis, metres, above which an answer is `uncertain`."""
APART_SIGMAS = 5.0
"""Poses that differ by fewer standard deviations are the same answer."""
APART_M = 0.01
"""Poses that differ by less, in metres and in radians, are the same answer."""
APART_RAD = np.deg2rad(1.0)
"""See `APART_M`."""


def required_support() -> float:
    """Support of an accepted pose."""
    return -log10(FALSE_ACCEPTS)


@lru_cache(maxsize=64)
def support(inliers: int, expected: int) -> float:
    """Support of a pose with inliers among expected landmarks; 0 without inliers."""
    if not inliers:
        return 0.0
    k = inliers / SAME_SURFACE
    n = expected / SAME_SURFACE
    a, b = CHANCE
    more = np.arange(k, n - 1e-6)
    # Logarithms of the probabilities of k, k + 1, ... n inliers, relative to that of k.
    rest = n - more
    ratios = rest / (more + 1)
    ratios = ratios * (more + a)
    ratios = ratios / (rest - 1 + b)
    relative = np.cumsum(np.log(ratios))
    relative = np.r_[0.0, relative]
    largest = relative.max()
    total = np.exp(relative - largest).sum()
    tail = largest + log(total)
    first = lgamma(n + 1)
    first -= lgamma(k + 1)
    first -= lgamma(n - k + 1)
    first += _log_beta(k + a, n - k + b)
    first -= _log_beta(a, b)
    return max(0.0, -(first + tail) / log(10))


def _log_beta(a: float, b: float) -> float:
    return lgamma(a) + lgamma(b) - lgamma(a + b)
