"""Pose from 2D-3D matches: PoseLib's LO-RANSAC, capped, and the covariance of what it found."""

from dataclasses import dataclass

import numpy as np

from evercal.geometry.se3 import SE3


@dataclass(frozen=True)
class PnpOptions:
    """RANSAC settings."""

    threshold_px: float = 5.0
    """Reprojection error up to which a match is an inlier, pixels at working size."""
    max_iterations: int = 1000
    """Cap: on a forgotten scene no sample ever fits, and an uncapped search would crawl."""
    min_iterations: int = 100
    """RANSAC iterations made in any case."""


@dataclass(frozen=True, eq=False)
class PnpResult:
    """A pose and what supports it."""

    world_from_camera: SE3
    """In the frame of the points."""
    inliers: np.ndarray
    """(n,) bool."""
    covariance: np.ndarray
    """(6, 6), see `pose_covariance`."""


def solve_pnp(
    pixels: np.ndarray, points_m: np.ndarray, intrinsics: np.ndarray, options: PnpOptions
) -> PnpResult | None:
    """Robust pose of a pinhole camera.

    Args:
        pixels: (n, 2) in the ideal pinhole.
        points_m: (n, 3) matching points.
        intrinsics: (4,) fx, fy, cx, cy.
        options: RANSAC settings.

    Returns:
        The pose, or None when no pose has at least 6 inliers.
    """
    import poselib

    fx, fy, cx, cy = (float(value) for value in intrinsics)
    # The image size plays no part in PINHOLE; PoseLib only wants it there.
    camera = {"model": "PINHOLE", "width": 0, "height": 0, "params": [fx, fy, cx, cy]}
    ransac = {
        "max_reproj_error": options.threshold_px,
        "max_iterations": options.max_iterations,
        "min_iterations": options.min_iterations,
        # The library would try three times as often as its own bound asks for.
        "dyn_num_trials_mult": 1.0,
    }
    pose, info = poselib.estimate_absolute_pose(pixels, points_m, camera, ransac, {})
    inliers = np.asarray(info["inliers"], bool)
    if len(inliers) != len(pixels) or inliers.sum() < 6 or not np.isfinite(pose.t).all():
        return None
    camera_from_world = SE3(np.asarray(pose.q, float), np.asarray(pose.t, float))
    world_from_camera = camera_from_world.inverse()
    covariance = pose_covariance(pixels[inliers], points_m[inliers], intrinsics, world_from_camera)
    return PnpResult(world_from_camera, inliers, covariance)


def pose_covariance(
    pixels: np.ndarray, points_m: np.ndarray, intrinsics: np.ndarray, world_from_camera: SE3
) -> np.ndarray:
    """First-order covariance from the reprojection Jacobian, sigma^2 (J^T J)^-1.

    Perturbations: translation t + dt in the world frame, rotation R Exp(dr) in the camera frame.
    sigma^2 is the mean squared residual per coordinate.

    Returns:
        (6, 6) of (dt in metres, dr in radians).
    """
    camera_from_world = world_from_camera.inverse()
    x, y, z = camera_from_world.apply(points_m).T
    z = np.maximum(z, 1e-6)
    fx, fy, cx, cy = intrinsics
    residual = np.stack([fx * x / z + cx, fy * y / z + cy], -1) - pixels
    zero = np.zeros_like(x)
    projection = np.stack(
        [
            np.stack([fx / z, zero, -fx * x / z**2], -1),
            np.stack([zero, fy / z, -fy * y / z**2], -1),
        ],
        1,
    )
    # Exp(-dr) X = X - dr x X = X + [X]x dr
    cross = np.stack(
        [
            np.stack([zero, -z, y], -1),
            np.stack([z, zero, -x], -1),
            np.stack([-y, x, zero], -1),
        ],
        1,
    )
    move = np.broadcast_to(-camera_from_world.rotation_matrix(), cross.shape)
    jacobian = projection @ np.concatenate([move, cross], -1)
    information = np.einsum("nij,nik->jk", jacobian, jacobian)
    variance = float((residual**2).mean()) + 1e-6
    return variance * np.linalg.pinv(information, hermitian=True)
