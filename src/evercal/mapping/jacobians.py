"""Derivatives of reprojection errors by poses, inverse depths and the lens."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from evercal.geometry.camera import Camera

Array = NDArray[np.floating]

COMMON, SHIFT, LENS = 6, 1, 5
GLOBALS = COMMON + SHIFT + LENS
"""Shared parameters: common transform, time shift, and lens (log focal length, principal point in
pixels, k1, k2)."""


@dataclass(frozen=True, eq=False)
class Linearised:
    """Whitened residuals (m, 2) and their derivatives by host pose, pose, depth and lens."""

    residual: Array
    host: Array
    own: Array
    depth: Array
    lens: Array


def ray_slopes(ray: Array, camera: Camera) -> Array:
    """(n, 2, 5) how rays (n, 3) with z = 1 move in x and y with the lens that sees them at a pixel.

    The columns are those of `Camera.slopes`.
    """
    by_plane, lens = camera.slopes(ray[:, :2])
    return -np.linalg.solve(by_plane, lens)


def camera_jacobian(
    lin: Linearised, host: NDArray[np.int64], frame: NDArray[np.int64], n: int
) -> sparse.csr_array:
    """(2 m, 6 n + 12) derivatives of the residuals by poses and shared parameters."""
    m, six = len(frame), np.arange(6)
    start = 6 * n + COMMON + SHIFT
    columns = np.concatenate(
        [
            6 * host[:, None] + six,
            6 * frame[:, None] + six,
            np.broadcast_to(start + np.arange(LENS), (m, LENS)),
        ],
        1,
    )
    values = np.concatenate([lin.host, lin.own, lin.lens], 2)
    rows = np.repeat(np.arange(2 * m), columns.shape[1])
    where = np.repeat(columns[:, None], 2, 1).ravel()
    return sparse.csr_array((values.ravel(), (rows, where)), shape=(2 * m, 6 * n + GLOBALS))
