"""Pose of a board from its corners, with covariance.

Depth and tilt of a small board are far less certain than its direction, so hand-eye calibration
weights each pose by this covariance.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from evercal.geometry import SE3, Camera, cross_matrix

Array = NDArray[np.floating]

_LEAST_PX = 0.02
"""Minimum standard deviation of a corner, due to errors of lens model and board."""


@dataclass(frozen=True, eq=False)
class BoardView:
    """Four or more corners of a board in one image."""

    points_m: Array
    """(k, 3) in the board frame, metres."""
    pixels: Array
    """(k, 2) x, y."""

    def __post_init__(self) -> None:
        points = np.asarray(self.points_m, dtype=np.float64)
        pixels = np.asarray(self.pixels, dtype=np.float64)
        if points.shape[1:] != (3,) or pixels.shape != (len(points), 2) or len(points) < 4:
            raise ValueError(
                f"a view takes four corners or more, points (k, 3) and pixels (k, 2), got shapes"
                f" {points.shape} and {pixels.shape}"
            )
        object.__setattr__(self, "points_m", points)
        object.__setattr__(self, "pixels", pixels)


@dataclass(frozen=True, eq=False)
class BoardPose:
    """Least-squares pose of the board in one image."""

    camera_from_board: SE3
    unit_covariance: Array
    """(6, 6) covariance for a corner noise of one pixel: (translation in the camera frame, metres;
    rotation about the board's axes, radians)."""
    squared_px: float
    """Sum of squared residuals of all coordinates."""
    corners: int
    lens_slope: Array
    """(6, q) derivative of the pose by fx, fy, cx, cy and the distortion coefficients."""
    lens_normal: Array
    """(q, q) information on the intrinsics for a corner noise of one pixel, the pose unknown."""
    lens_gradient: Array
    """(q,) `lens_normal` times the change of the intrinsics that fits the corners best."""

    @property
    def rms_px(self) -> float:
        """Root mean square reprojection error."""
        return float(np.sqrt(self.squared_px / self.corners))


def board_pose(view: BoardView, camera: Camera, start: SE3 | None = None) -> BoardPose:
    """Fit the pose of a board to its corners, from a start or from the better of its candidates."""
    import cv2

    if start is None:
        starts = board_pose_candidates(view, camera)
        return min((board_pose(view, camera, s) for s in starts), key=lambda pose: pose.squared_px)
    coefficients = np.zeros(max(len(camera.distortion), 5))
    coefficients[: len(camera.distortion)] = camera.distortion
    lens = camera.matrix(), coefficients
    rotvec = Rotation.from_quat(start.rotation_wxyz, scalar_first=True).as_rotvec()
    translation = start.translation_m.reshape(3, 1).copy()
    rotvec, translation = cv2.solvePnPRefineLM(
        view.points_m, view.pixels, *lens, rotvec.reshape(3, 1).copy(), translation
    )
    projected, slopes, *_ = cv2.projectPoints(view.points_m, rotvec, translation, *lens)
    slopes = np.asarray(slopes, dtype=np.float64)
    rotation = Rotation.from_rotvec(np.ravel(rotvec))
    by_point = slopes[:, 3:6].reshape(-1, 2, 3)
    by_rotation = by_point @ (-rotation.as_matrix() @ cross_matrix(view.points_m))
    jacobian = np.concatenate([by_point, by_rotation], 2).reshape(-1, 6)
    error = (view.pixels - projected.reshape(-1, 2)).ravel()
    normal = jacobian.T @ jacobian
    unit = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    covariance = np.outer(unit, unit) * np.linalg.pinv(normal * np.outer(unit, unit), 1e-12)
    by_lens = slopes[:, 6 : 10 + max(len(camera.distortion), 5)]
    lens_slope = -covariance @ (jacobian.T @ by_lens)
    unexplained = by_lens + jacobian @ lens_slope
    quaternion = rotation.as_quat(canonical=True, scalar_first=True)
    return BoardPose(
        camera_from_board=SE3(quaternion, np.asarray(translation, dtype=np.float64).ravel()),
        unit_covariance=(covariance + covariance.T) / 2,
        squared_px=float((error**2).sum()),
        corners=len(view.points_m),
        lens_slope=lens_slope,
        lens_normal=unexplained.T @ unexplained,
        lens_gradient=unexplained.T @ error,
    )


def board_pose_candidates(view: BoardView, camera: Camera) -> list[SE3]:
    """Return the possible poses of the board: up to two for a flat board, mostly one otherwise."""
    import cv2

    thickness = np.linalg.svd(view.points_m - view.points_m.mean(0), compute_uv=False)
    flat = thickness[2] < 1e-6 * thickness[0]
    flags = cv2.SOLVEPNP_IPPE if flat else cv2.SOLVEPNP_SQPNP
    lens = camera.matrix(), np.array(camera.distortion)
    found = cv2.solvePnPGeneric(view.points_m, view.pixels, *lens, flags=flags)
    poses = []
    for rotvec, translation in zip(*found[1:3], strict=True):
        if np.isfinite(rotvec).all() and np.isfinite(translation).all() and translation[2] > 0:
            quaternion = Rotation.from_rotvec(np.ravel(rotvec)).as_quat(scalar_first=True)
            poses.append(SE3(quaternion, np.asarray(translation, dtype=np.float64).ravel()))
    return poses


def pixel_sigma(poses: Sequence[BoardPose]) -> float:
    """Return the standard deviation of a corner coordinate in pixels, over images that fit well."""
    squared = np.array([pose.squared_px for pose in poses])
    freedom = np.array([max(2 * pose.corners - 6, 1) for pose in poses])
    inliers = squared / freedom <= 4 * np.median(squared / freedom) + 1e-12
    return max(float(np.sqrt(squared[inliers].sum() / freedom[inliers].sum())), _LEAST_PX)
