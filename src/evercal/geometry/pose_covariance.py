"""Covariances (6, 6) of poses.

Of translation in the parent frame, metres, and rotation about the axes of the child, radians.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evercal.geometry.se3 import SE3

Array = NDArray[np.float64]


def cross_matrix(v: ArrayLike) -> Array:
    """(..., 3, 3) matrices that multiply like the cross product with vectors (..., 3)."""
    v = np.asarray(v, dtype=np.float64)
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return matrix - np.swapaxes(matrix, -1, -2)


def axis_deviation(covariance: Array) -> tuple[float, float]:
    """Standard deviation per axis, millimetres and degrees: root mean squares of three axes."""
    metres, radians = (np.sqrt(np.trace(covariance[a:b, a:b]) / 3) for a, b in ((0, 3), (3, 6)))
    return 1000 * float(metres), float(np.rad2deg(radians))


def with_translation_by(matrix: ArrayLike, covariance: ArrayLike) -> Array:
    """(6, 6) covariance after the translation alone was multiplied by a matrix (3, 3).

    A rotation matrix gives it in the axes of another parent frame.
    """
    whole = np.eye(6)
    whole[:3, :3] = matrix
    return whole @ np.asarray(covariance, dtype=np.float64) @ whole.T


def squared_mahalanobis(found: SE3, covariance: ArrayLike, truth: SE3) -> float:
    """Squared error of a pose in units of its own covariance.

    If the covariance is right, it has a chi-squared distribution of six degrees of freedom.

    Args:
        found: base_from_camera.
        covariance: (6, 6) of (translation in the base frame, metres; rotation about camera axes,
            radians).
        truth: base_from_camera.
    """
    shift = truth.translation_m - found.translation_m
    turn = (found.inverse() @ truth).log()[3:]
    error = np.concatenate([shift, turn])
    # A pose from few points may be certain in some direction: the pseudo-inverse leaves that out.
    return float(error @ np.linalg.pinv(np.asarray(covariance, dtype=np.float64)) @ error)
