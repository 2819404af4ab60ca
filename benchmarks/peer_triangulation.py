"""Points of a frame's features from where other frames see them, with the stated poses."""

from dataclasses import dataclass, replace

import numpy as np

from evercal.geometry.se3 import SE3

GAUSS_NEWTON_STEPS = 5


@dataclass(frozen=True)
class TriangulationOptions:
    """What a point has to stand up to."""

    partners: int = 12
    """Other training frames that a frame is matched to."""
    baseline_m: float = 0.05
    """They stand at least so far from it and from one another, metres."""
    reprojection_px: float = 4.0
    """A partner agrees up to this error, pixels at working size."""
    agreeing: int = 2
    """Partners that have to agree."""
    angle_deg: float = 1.5
    """The widest angle between the frame's ray and one of theirs, at least."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """The features of one frame in it and in its partners; the frame itself is view 0."""

    pixels: np.ndarray
    """(v, n, 2) in ideal pinholes; NaN where a partner has no match."""
    intrinsics: np.ndarray
    """(v, 4) fx, fy, cx, cy, pixels."""
    world_from_camera: SE3
    """(v,) stated poses."""

    def rays(self) -> np.ndarray:
        """(v, n, 3) unit viewing rays in the world frame."""
        plane = (self.pixels - self.intrinsics[:, None, 2:]) / self.intrinsics[:, None, :2]
        rays = np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], -1)
        rays = rays @ np.swapaxes(self.world_from_camera.rotation_matrix(), -1, -2)
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def in_cameras(self, points_m: np.ndarray) -> np.ndarray:
        """(v, n, 3) camera coordinates of (n, 3) points, metres."""
        inverse = self.world_from_camera.inverse()
        turned = points_m @ np.swapaxes(inverse.rotation_matrix(), -1, -2)
        return turned + inverse.translation_m[:, None]

    def residuals(self, local: np.ndarray) -> np.ndarray:
        """(v, n, 2) pixels from (v, n, 3) camera coordinates; NaN behind a camera."""
        depth = np.where(local[..., 2:] > 1e-3, local[..., 2:], np.nan)
        plane = local[..., :2] / depth
        return plane * self.intrinsics[:, None, :2] + self.intrinsics[:, None, 2:] - self.pixels

    def errors(self, points_m: np.ndarray) -> np.ndarray:
        """(v, n) reprojection errors in pixels, infinite where there is nothing to compare."""
        error = np.linalg.norm(self.residuals(self.in_cameras(points_m)), axis=-1)
        return np.where(np.isfinite(error), error, np.inf)


def triangulate(tracks: Tracks, options: TriangulationOptions) -> np.ndarray:
    """Points of the features of view 0.

    Every partner proposes the point of the frame's ray that is closest to its own ray; the
    proposal with the smallest truncated squared error over all partners wins (MSAC, Torr and
    Zisserman, CVIU 2000) and is refined by Gauss-Newton over the views that agree.

    Returns:
        (n, 3) metres, NaN where too few partners agree or their rays are too close to parallel.
    """
    everywhere = np.full((tracks.pixels.shape[1], 3), np.nan)
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
    everywhere[enough] = np.where(good[:, None], points, np.nan)
    return everywhere


def _best_proposal(tracks: Tracks, rays: np.ndarray, bound: float) -> np.ndarray:
    """(n, 3) points on the rays of view 0; NaN where no partner has a match."""
    origins = tracks.world_from_camera.translation_m
    best = np.full(rays.shape[1:], np.nan)
    cost = np.full(len(best), np.inf)
    for partner in range(1, len(rays)):
        way = origins[partner] - origins[0]
        cosine = (rays[0] * rays[partner]).sum(-1)
        sine_squared = np.maximum(1.0 - cosine**2, 1e-12)
        distance = (rays[0] @ way - cosine * (rays[partner] @ way)) / sine_squared
        proposal = origins[0] + np.where(distance > 0, distance, np.nan)[:, None] * rays[0]
        error = np.minimum(tracks.errors(proposal), bound)
        total = np.where(np.isfinite(distance) & (distance > 0), (error**2).sum(0), np.inf)
        better = total < cost
        best[better], cost[better] = proposal[better], total[better]
    return best


def _step(tracks: Tracks, points_m: np.ndarray, use: np.ndarray) -> np.ndarray:
    """(n, 3) Gauss-Newton step in metres over the views of (v, n) `use`; 0 where it is open."""
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
