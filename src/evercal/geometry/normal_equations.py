"""Normal equations whose unknowns have units that differ by orders of magnitude.

Every function but `gram` scales the (p, p) matrix to a unit diagonal first.
"""

import numpy as np

from evercal.typing import Array

_TINY = 1e-300
"""Added to the diagonal, so that an unknown without information has a finite unit."""


def gram(rows: Array) -> Array:
    """Inner products (..., n, n) of rows (..., n, k), which may be float32.

    OpenBLAS 0.3.31 multiplies float32 matrices wrongly by their own transpose on processors with
    SME (issue 5873 of OpenBLAS). A copy of the transpose is another matrix.
    """
    transposed = np.swapaxes(rows, -1, -2)
    return rows @ transposed.copy()


def normal_inverse(normal: Array, ridge: float) -> Array:
    """Invert a positive semi-definite matrix (p, p) plus `ridge` on its scaled diagonal.

    An unknown that is not constrained gets a huge variance.
    """
    unit = 1 / np.sqrt(normal.diagonal() + _TINY)
    units = unit * unit[:, None]
    scaled = normal * units
    scaled.flat[:: len(unit) + 1] += ridge
    return np.linalg.inv(scaled) * units


def normal_pseudo_inverse(normal: Array, rcond: float) -> Array:
    """Pseudo-inverse (p, p); scaled singular values below `rcond` of the largest count as 0."""
    unit = 1 / np.sqrt(normal.diagonal() + _TINY)
    units = unit * unit[:, None]
    return np.linalg.pinv(normal * units, rcond) * units


def normal_solution(normal: Array, right: Array) -> Array:
    """Solution (p,) with the smallest scaled norm of `normal @ x = right`."""
    unit = 1 / np.sqrt(normal.diagonal() + _TINY)
    scaled = normal * (unit * unit[:, None])
    return unit * np.linalg.lstsq(scaled, unit * right, rcond=1e-13)[0]
