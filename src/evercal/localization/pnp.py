"""Pose from 2D-3D matches by OpenCV's RANSAC, and the covariance of the pose."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from evercal.classes import frozen
from evercal.errors import require_numbers
from evercal.geometry import SE3, Camera, UncertainPose, in_parent_axes
from evercal.localization.pose_refinement import Pose, linearise
from evercal.typing import Array, BoolArray

MIN_INLIERS = 6
"""Inliers of a pose by PnP, at least."""
_MISS_PROBABILITY = 1e-3
"""Probability that RANSAC misses a pose with `PnpOptions.sought_inliers`."""
_STEPS = 4
"""Gauss-Newton steps that refine a pose."""
_NEAR = 1.5
"""Factor on the threshold for matches that refine a pose: a pose of three matches is rough."""
_RIDGE = 1e-6
"""Ridge of the information, pixels squared: without matches there is no step."""


@frozen
class PnpOptions:
    """RANSAC settings."""

    threshold_px: float = 5.0
    """Reprojection error below which a match is an inlier, pixels at working size."""
    max_iterations: int = 700
    """Maximum number of iterations, for images without any consistent sample."""
    sought_inliers: int = 12
    """RANSAC finds a pose with this many inliers with a probability of 99.9 %."""
    progressive_sampling: bool = False
    """Sample the first matches first, which are then the most reliable (PROSAC; Chum and Matas,
    2005)."""

    def __post_init__(self) -> None:
        counts = ("max_iterations", "sought_inliers")
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
    if len(pixels) < MIN_INLIERS:
        return None
    # Samples of three until one is of inliers only: few matches need few.
    share = min(options.sought_inliers / len(pixels), 0.9)
    needed = math.log(_MISS_PROBABILITY) / math.log1p(-(share**3))
    parameters = cv2.UsacParams()
    parameters.confidence = 1 - _MISS_PROBABILITY
    parameters.maxIterations = math.ceil(min(needed, options.max_iterations))
    parameters.threshold = options.threshold_px
    parameters.score = cv2.SCORE_METHOD_RANSAC
    if options.progressive_sampling:
        parameters.sampler = cv2.SAMPLING_PROSAC
    # OpenCV's own refinement takes several times as long as that of `_refined`.
    parameters.loMethod = cv2.LOCAL_OPTIM_NULL
    focal = np.diag([camera.fx, camera.fy, 1.0])
    focal[:2, 2] = camera.cx, camera.cy
    solved, _, turn, shift, inliers = cv2.solvePnPRansac(
        points_m, pixels, focal, None, params=parameters
    )
    if not solved or inliers is None or len(inliers) < MIN_INLIERS:
        return None
    rotation = np.asarray(cv2.Rodrigues(turn)[0], float).T
    start = rotation, -rotation @ np.asarray(shift, float).ravel()
    return _refined(pixels, points_m, camera.pinhole, start, options.threshold_px)


def _refined(
    pixels: Array, points_m: Array, pinhole: Camera, start: Pose, threshold_px: float
) -> PnpResult | None:
    """The pose after Gauss-Newton steps with the matches near it; None for few inliers."""
    rotation, position = start
    for _ in range(_STEPS):
        error, slope = linearise(pixels, points_m, rotation, position, pinhole)
        near = (error**2).sum(0) < (_NEAR * threshold_px) ** 2
        rows = (slope * near).reshape(6, -1)
        information = rows @ rows.T + _RIDGE * np.eye(6)
        step = -np.linalg.solve(information, rows @ error.ravel())
        position = position + rotation @ step[:3]
        rotation = rotation @ cv2.Rodrigues(step[3:])[0]
    error, _ = linearise(pixels, points_m, rotation, position, pinhole)
    inliers = (error**2).sum(0) < threshold_px**2
    matrix = np.column_stack([rotation, position])
    if inliers.sum() < MIN_INLIERS or not np.isfinite(matrix).all():
        return None
    return PnpResult(SE3.from_matrix(matrix), inliers)


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
        if result and result.inlier_count > most:
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
