"""Normal equations whose unknowns have units that differ by orders of magnitude.

Every function scales the (p, p) matrix to a unit diagonal first.
"""

import numpy as np

from evercal.typing import Array


def _units(normal: Array) -> Array:
    """(p,) units of the unknowns in which the diagonal is 1."""
    return 1 / np.sqrt(normal.diagonal() + 1e-300)


def normal_inverse(normal: Array, ridge: float) -> Array:
    """Invert a positive semi-definite matrix (p, p) plus `ridge` on its scaled diagonal.

    An unknown that is not constrained gets a huge variance.
    """
    unit = _units(normal)
    units = unit * unit[:, None]
    scaled = normal * units
    scaled.flat[:: len(unit) + 1] += ridge
    return np.linalg.inv(scaled) * units


def normal_pseudo_inverse(normal: Array, rcond: float) -> Array:
    """Pseudo-inverse (p, p); scaled singular values below `rcond` of the largest count as 0."""
    unit = _units(normal)
    units = unit * unit[:, None]
    return np.linalg.pinv(normal * units, rcond) * units


def normal_solution(normal: Array, right: Array) -> Array:
    """Solution (p,) with the smallest scaled norm of `normal @ x = right`."""
    unit = _units(normal)
    scaled = normal * (unit * unit[:, None])
    return unit * np.linalg.lstsq(scaled, unit * right, rcond=1e-13)[0]
