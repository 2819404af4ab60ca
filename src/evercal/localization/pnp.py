"""Pose from 2D-3D matches: PoseLib's LO-RANSAC with a cap, and the covariance of the pose."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from evercal.errors import require_numbers
from evercal.geometry import SE3, Camera, UncertainPose, in_parent_axes
from evercal.localization.pose_refinement import linearise
from evercal.typing import Array, BoolArray

MIN_INLIERS = 6
"""Inliers of a pose by PnP, at least."""
_MISS_PROBABILITY = 1e-3
"""Probability that RANSAC misses a pose with `PnpOptions.sought_inliers`."""


@dataclass(frozen=True)
class PnpOptions:
    """RANSAC settings."""

    threshold_px: float = 5.0
    """Reprojection error below which a match is an inlier, pixels at working size."""
    max_iterations: int = 1000
    """Maximum number of iterations, for images without any consistent sample."""
    min_iterations: int = 100
    """Iterations that always run."""
    sought_inliers: int = 12
    """RANSAC finds a pose with this many inliers with a probability of 99.9 %."""
    progressive_sampling: bool = False
    """Sample the first matches first, which are then the most reliable (PROSAC; Chum and Matas,
    2005)."""

    def __post_init__(self) -> None:
        counts = ("max_iterations", "min_iterations", "sought_inliers")
        require_numbers(self, counts, 1)
        require_numbers(self, ("threshold_px",), 0)


class PnpResult(NamedTuple):
    """A pose and its inliers."""

    pose: SE3
    """points_from_camera."""
    inliers: BoolArray
    """(n,)."""

    @property
    def inlier_count(self) -> int:
        """Number of matches that agree with the pose."""
        return int(np.count_nonzero(self.inliers))


def solve_pnp(
    pixels: Array, points_m: Array, camera: Camera, options: PnpOptions
) -> PnpResult | None:
    """The pose of a camera from 2D-3D matches, None for fewer than 6 inliers.

    Pixels (n, 2) lie in the ideal pinhole of the camera, whose distortion is ignored.
    """
    import poselib

    # PoseLib does not use the image size of a PINHOLE camera.
    parameters = [camera.fx, camera.fy, camera.cx, camera.cy]
    pinhole = {"model": "PINHOLE", "width": 0, "height": 0, "params": parameters}
    # Samples of three until one is of inliers only: few matches need few.
    share = min(options.sought_inliers / max(len(pixels), 1), 0.9)
    needed = math.log(_MISS_PROBABILITY) / math.log1p(-(share**3))
    needed = max(needed, options.min_iterations)
    ransac = {
        "max_reproj_error": options.threshold_px,
        "max_iterations": int(min(needed, options.max_iterations)),
        "min_iterations": options.min_iterations,
        # The default multiplies the number of iterations that the inlier ratio asks for by three.
        "dyn_num_trials_mult": 1.0,
        "progressive_sampling": options.progressive_sampling,
    }
    pose, info = poselib.estimate_absolute_pose(pixels, points_m, pinhole, ransac, {})
    inliers = np.asarray(info["inliers"], bool)
    enough = len(inliers) == len(pixels) and inliers.sum() >= MIN_INLIERS
    if not enough or not np.isfinite(pose.t).all():
        return None
    camera_from_points = SE3(np.asarray(pose.q, float), np.asarray(pose.t, float))
    return PnpResult(camera_from_points.inverse(), inliers)


def most_inliers(
    pixels: Array,
    points_m: Array,
    cameras: Sequence[Camera],
    options: PnpOptions,
) -> tuple[int, PnpResult | None]:
    """Index and pose of the camera with the most inliers, see `solve_pnp`; None without a pose."""
    best = None
    index = 0
    most = 0
    for number, camera in enumerate(cameras):
        result = solve_pnp(pixels, points_m, camera, options)
        if result is not None and result.inlier_count > most:
            best = result
            index = number
            most = result.inlier_count
    return index, best


def uncertain(
    pixels: Array, points_m: Array, camera: Camera, points_from_camera: SE3
) -> UncertainPose:
    """The pose with its first-order covariance: mean squared residual times (J^T J)^-1."""
    rotation = points_from_camera.rotation_matrix()
    position = points_from_camera.translation_m
    residual, slope = linearise(pixels, points_m, rotation, position, camera.pinhole)
    rows = slope.reshape(6, -1)
    variance = float((residual**2).mean()) + 1e-6
    covariance = variance * np.linalg.pinv(rows @ rows.T, hermitian=True)
    return UncertainPose(points_from_camera, in_parent_axes(rotation, covariance))
