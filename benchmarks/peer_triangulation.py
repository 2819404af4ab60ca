"""Triangulation of a frame's features from matches in other frames, with the stated poses."""

from dataclasses import dataclass, replace

import numpy as np

from evercal.geometry.se3 import SE3

GAUSS_NEWTON_STEPS = 5


@dataclass(frozen=True)
class TriangulationOptions:
    """Options of triangulation."""

    partners: int = 12
    """Training frames that a frame is matched to."""
    baseline_m: float = 0.05
    """Least distance of these frames from it and from each other, metres."""
    reprojection_px: float = 4.0
    """Reprojection error below which a partner agrees, pixels at working size."""
    agreeing: int = 2
    """Least number of agreeing partners."""
    angle_deg: float = 1.5
    """Least angle between the ray of the frame and that of some agreeing partner."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """Features of a frame in itself (view 0) and in its partners."""

    pixels: np.ndarray
    """Undistorted pixels, NaN without a match, shape (v, n, 2)."""
    intrinsics: np.ndarray
    """fx, fy, cx, cy in pixels, shape (v, 4)."""
    world_from_camera: SE3
    """Stated poses, shape (v,)."""

    def rays(self) -> np.ndarray:
        """Return unit viewing rays in the world frame, shape (v, n, 3)."""
        plane = (self.pixels - self.intrinsics[:, None, 2:]) / self.intrinsics[:, None, :2]
        rays = np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], -1)
        rays = rays @ np.swapaxes(self.world_from_camera.rotation_matrix(), -1, -2)
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def in_cameras(self, points_m: np.ndarray) -> np.ndarray:
        """Return camera coordinates (v, n, 3) of points (n, 3), metres."""
        inverse = self.world_from_camera.inverse()
        rotated = points_m @ np.swapaxes(inverse.rotation_matrix(), -1, -2)
        return rotated + inverse.translation_m[:, None]

    def residuals(self, local: np.ndarray) -> np.ndarray:
        """Return residuals (v, n, 2) in pixels of camera coordinates (v, n, 3); NaN behind."""
        depth = np.where(local[..., 2:] > 1e-3, local[..., 2:], np.nan)
        plane = local[..., :2] / depth
        return plane * self.intrinsics[:, None, :2] + self.intrinsics[:, None, 2:] - self.pixels

    def errors(self, points_m: np.ndarray) -> np.ndarray:
        """Return reprojection errors in pixels, infinite without a match, shape (v, n)."""
        error = np.linalg.norm(self.residuals(self.in_cameras(points_m)), axis=-1)
        return np.where(np.isfinite(error), error, np.inf)


def triangulate(tracks: Tracks, options: TriangulationOptions) -> np.ndarray:
    """Triangulate the features of view 0.

    Every partner proposes the point on the frame's ray that is closest to its own ray. The proposal
    with the smallest truncated squared error over all partners (MSAC, Torr and Zisserman, CVIU
    2000) is refined by Gauss-Newton over the agreeing views.

    Returns:
        Points in metres, shape (n, 3). NaN if too few partners agree or rays are nearly parallel.
    """
    triangulated = np.full((tracks.pixels.shape[1], 3), np.nan)
    enough = np.isfinite(tracks.pixels[1:, :, 0]).sum(0) >= options.agreeing
    tracks = replace(tracks, pixels=tracks.pixels[:, enough])
    rays, bound = tracks.rays(), options.reprojection_px
    points = _best_proposal(tracks, rays, bound)
    for _ in range(GAUSS_NEWTON_STEPS):
        points = points + _step(tracks, points, tracks.errors(points) <= bound)
    agrees = tracks.errors(points) <= bound
    cosine = np.where(agrees[1:], (rays[1:] * rays[0]).sum(-1), 1.0).min(0, initial=1.0)
    good = agrees[0] & (agrees[1:].sum(0) >= options.agreeing)
    good &= cosine <= np.cos(np.deg2rad(options.angle_deg))
    triangulated[enough] = np.where(good[:, None], points, np.nan)
    return triangulated


def _best_proposal(tracks: Tracks, rays: np.ndarray, bound: float) -> np.ndarray:
    """Return points on the rays of view 0, NaN without a match, shape (n, 3)."""
    origins = tracks.world_from_camera.translation_m
    best = np.full(rays.shape[1:], np.nan)
    cost = np.full(len(best), np.inf)
    for partner in range(1, len(rays)):
        baseline = origins[partner] - origins[0]
        cosine = (rays[0] * rays[partner]).sum(-1)
        sine_squared = np.maximum(1.0 - cosine**2, 1e-12)
        distance = (rays[0] @ baseline - cosine * (rays[partner] @ baseline)) / sine_squared
        proposal = origins[0] + np.where(distance > 0, distance, np.nan)[:, None] * rays[0]
        error = np.minimum(tracks.errors(proposal), bound)
        total = np.where(np.isfinite(distance) & (distance > 0), (error**2).sum(0), np.inf)
        better = total < cost
        best[better], cost[better] = proposal[better], total[better]
    return best


def _step(tracks: Tracks, points_m: np.ndarray, use: np.ndarray) -> np.ndarray:
    """Return the Gauss-Newton step (n, 3) over the views of (v, n) `use`; 0 for fewer than two."""
    local = tracks.in_cameras(points_m)
    residual = np.where(use[..., None], tracks.residuals(local), 0.0)
    x, y, z = np.moveaxis(local, -1, 0)
    z = np.where(use, z, 1.0)
    zero = np.zeros_like(z)
    fx, fy = tracks.intrinsics[:, 0, None], tracks.intrinsics[:, 1, None]
    rows = [[fx / z, zero, -fx * x / z**2], [zero, fy / z, -fy * y / z**2]]
    projection = np.stack([np.stack(row, -1) for row in rows], -2)
    rotation = tracks.world_from_camera.inverse().rotation_matrix()
    jacobian = projection @ rotation[:, None]
    jacobian = np.where(use[..., None, None], jacobian, 0.0)
    jacobian = np.moveaxis(jacobian, 1, 0).reshape(len(points_m), -1, 3)
    transposed = np.swapaxes(jacobian, 1, 2)
    normal = transposed @ jacobian
    right = transposed @ np.moveaxis(residual, 1, 0).reshape(len(points_m), -1, 1)
    damping = 1e-9 * np.trace(normal, axis1=1, axis2=2) + 1e-12
    step = -np.linalg.solve(normal + damping[:, None, None] * np.eye(3), right)[..., 0]
    return np.where((use.sum(0) >= 2)[:, None], step, 0.0)
