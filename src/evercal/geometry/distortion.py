"""Radial distortion of a pinhole and of a fisheye, and where its polynomial folds back.

Coefficients are in OpenCV's order: k1 k2 p1 p2 k3 k4 k5 k6, and k1 k2 k3 k4 of a fisheye.
"""

import math

import numpy as np
from numpy.polynomial import Polynomial
from numpy.polynomial.polynomial import polyroots
from numpy.typing import ArrayLike

from evercal.typing import Array, ArrayPair, Floats

FISHEYE_DEG = 85.0
"""Largest angle to the optical axis of a ray of a fisheye."""
USUAL_DISTORTION = {
    "pinhole": (0.3, 0.5, 2e-3, 2e-3, 0.5),
    "fisheye": (0.1,) * 4,
}
"""Standard deviations of the coefficients of an unknown lens. Files of real lenses err as much:
many state no distortion."""


def radial_pinhole(coefficients: Floats, r2: Array) -> ArrayPair:
    """Distorted over ideal radius, and its derivative by the ideal squared radius `r2`."""
    k1, k2, _, _, k3, k4, k5, k6 = coefficients
    above = k2 + r2 * k3
    above = k1 + r2 * above
    above = 1 + r2 * above
    steeper = 2 * k2 + r2 * 3 * k3
    steeper = k1 + r2 * steeper
    if not (k4 or k5 or k6):
        return above, steeper
    below = k5 + r2 * k6
    below = k4 + r2 * below
    below = 1 + r2 * below
    change = 2 * k5 + r2 * 3 * k6
    change = k4 + r2 * change
    radial = above / below
    return radial, (steeper - radial * change) / below


def radial_fisheye(coefficients: Floats, r2: Array) -> ArrayPair:
    """The same of a fisheye."""
    k1, k2, k3, k4 = coefficients
    t2 = np.arctan(np.sqrt(r2)) ** 2
    longer = k3 + t2 * k4
    longer = k2 + t2 * longer
    longer = k1 + t2 * longer
    longer = 1 + t2 * longer
    steeper = 7 * k3 + t2 * 9 * k4
    steeper = 5 * k2 + t2 * steeper
    steeper = 3 * k1 + t2 * steeper
    steeper = 1 + t2 * steeper
    radial = angle_per_radius(r2) * longer
    change = steeper / (1 + r2) - radial
    change = change / (2 * np.maximum(r2, 1e-8))
    return radial, np.where(r2 > 1e-8, change, k1 - 1 / 3)


def angle_per_radius(r2: Array) -> Array:
    """atan(r) / r of squared radii."""
    r = np.sqrt(np.maximum(r2, 1e-12))
    return np.arctan(r) / r


def widest_pinhole(coefficients: Floats) -> float:
    """Largest tangent of the angle to the optical axis at which the distortion is valid."""
    k1, k2, _, _, k3, k4, k5, k6 = coefficients
    folds = _roots([1.0, 3 * k1, 5 * k2, 7 * k3])
    if k4 or k5 or k6:
        squared = Polynomial([0, 1])
        above = Polynomial([1, k1, k2, k3])
        below = Polynomial([1, k4, k5, k6])
        change = above.deriv() * below - above * below.deriv()
        slope = above * below + 2 * squared * change
        folds = [*_roots(slope.coef), *_roots(below.coef)]
    return math.sqrt(min(folds, default=math.inf))


def widest_fisheye(coefficients: Floats) -> float:
    """The same of a fisheye, at most `FISHEYE_DEG`."""
    k1, k2, k3, k4 = coefficients
    folds = _roots([1.0, 3 * k1, 5 * k2, 7 * k3, 9 * k4])
    angle = math.sqrt(min(folds, default=9.0))
    return math.tan(min(angle, math.radians(FISHEYE_DEG)))


def _roots(coefficients: ArrayLike) -> list[float]:
    """Positive real roots of a polynomial, from its coefficients in ascending order."""
    roots = polyroots(np.trim_zeros(np.asarray(coefficients), "b"))
    positive = (np.abs(roots.imag) < 1e-9) & (roots.real > 0)
    return roots.real[positive].tolist()
