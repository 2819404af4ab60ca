"""Pose from 2D-3D matches: PoseLib's LO-RANSAC, capped, and the covariance of what it found."""

from dataclasses import dataclass

import numpy as np

from evercal.geometry.pose_covariance import with_translation_by
from evercal.geometry.se3 import SE3
from evercal.localization.pose_refinement import linearised


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
    turn = world_from_camera.rotation_matrix()
    place = world_from_camera.translation_m
    residual, slope = linearised(pixels, points_m, turn, place, intrinsics)
    rows = slope.transpose(1, 0, 2).reshape(6, -1)
    variance = float((residual**2).mean()) + 1e-6
    covariance = variance * np.linalg.pinv(rows @ rows.T, hermitian=True)
    return with_translation_by(turn, covariance)
