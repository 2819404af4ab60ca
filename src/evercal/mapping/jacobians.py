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


def _radial(camera: Camera) -> tuple[float, float]:
    k1, k2 = (*camera.distortion[:2], 0.0, 0.0)[:2]
    return k1, k2


def projection_slopes(plane: Array, camera: Camera) -> tuple[Array, Array]:
    """Derivatives of pixels by points of the plane z = 1 (n, 2, 2) and by the lens (n, 2, 5)."""
    (k1, k2), focal = _radial(camera), np.array([camera.fx, camera.fy])
    r2 = (plane**2).sum(1)
    radial = 1 + r2 * (k1 + r2 * k2)
    outer = plane[:, :, None] * plane[:, None, :] * (2 * k1 + 4 * k2 * r2)[:, None, None]
    by_plane = (np.eye(2) * radial[:, None, None] + outer) * focal[:, None]
    lens = np.zeros((len(plane), 2, LENS))
    lens[:, :, 0] = plane * radial[:, None] * focal
    lens[:, 0, 1] = lens[:, 1, 2] = 1
    lens[:, :, 3] = plane * r2[:, None] * focal
    lens[:, :, 4] = plane * (r2**2)[:, None] * focal
    return by_plane, lens


def ray_slopes(by_ray: Array, ray: Array, camera: Camera) -> Array:
    """(n, 2, 5) derivatives of pixels by the lens through the ray of the host, to first order."""
    plane, focal = ray[:, :2], np.array([camera.fx, camera.fy])
    r2 = (plane**2).sum(1)[:, None]
    slopes = np.zeros((len(ray), 2, LENS))
    slopes[:, :, 0] = -np.einsum("nij,nj->ni", by_ray, plane)
    slopes[:, :, 1:3] = -by_ray / focal
    slopes[:, :, 3] = -np.einsum("nij,nj->ni", by_ray, plane * r2)
    slopes[:, :, 4] = -np.einsum("nij,nj->ni", by_ray, plane * r2**2)
    return slopes


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
