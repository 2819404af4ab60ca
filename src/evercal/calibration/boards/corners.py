"""What the corners of a board say about its pose: the pose, and how sure it is along every axis.

In the joint adjustment of corners, robot and both transforms each image has a camera pose of its
own, and eliminating it leaves what is computed here: the pose that fits the corners best and its
covariance. Depth and tilt of a small board are far less sure than its direction.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from evercal.geometry import SE3, Camera, cross_matrix

Array = NDArray[np.floating]

_LEAST_PX = 0.02
"""Corners are never taken to be better than this: lens model and board are not."""


@dataclass(frozen=True, eq=False)
class BoardView:
    """The corners of a board that one image shows.

    Raises:
        ValueError: fewer than four corners, or numbers of points and pixels that differ.
    """

    points_m: Array
    """(k, 3) in the board's frame, metres, k >= 4."""
    pixels: Array
    """(k, 2) in the image, x then y."""

    def __post_init__(self) -> None:
        points = np.asarray(self.points_m, dtype=np.float64)
        pixels = np.asarray(self.pixels, dtype=np.float64)
        if points.shape[1:] != (3,) or pixels.shape != (len(points), 2) or len(points) < 4:
            raise ValueError(
                f"a view has four corners or more, points (k, 3) and pixels (k, 2), got"
                f" {points.shape} and {pixels.shape}"
            )
        object.__setattr__(self, "points_m", points)
        object.__setattr__(self, "pixels", pixels)


@dataclass(frozen=True, eq=False)
class BoardPose:
    """The pose that fits the corners of one image best."""

    camera_from_board: SE3
    """Single."""
    unit_covariance: Array
    """(6, 6) for corners that are off by one pixel: (translation in the camera's axes, metres;
    rotation about the board's axes, radians)."""
    squared_px: float
    """Sum of squared residuals of both coordinates of all corners."""
    corners: int
    """Their number."""

    @property
    def rms_px(self) -> float:
        """Root mean square distance of a corner from where the pose puts it."""
        return float(np.sqrt(self.squared_px / self.corners))


def board_pose(view: BoardView, camera: Camera, start: SE3 | None = None) -> BoardPose:
    """Fits the pose of a board to its corners.

    A flat board has two poses that look alike when it is small or seen from the front; without a
    start, the better one is taken.

    Args:
        view: the corners.
        camera: intrinsics.
        start: single camera_from_board near the answer.
    """
    import cv2

    matrix, lens = camera.matrix(), np.array(camera.distortion)
    if start is None:
        starts = board_pose_candidates(view, camera)
        return min((board_pose(view, camera, s) for s in starts), key=lambda pose: pose.squared_px)
    rotvec = Rotation.from_quat(start.rotation_wxyz, scalar_first=True).as_rotvec()
    rotvec, translation = cv2.solvePnPRefineLM(
        view.points_m,
        view.pixels,
        matrix,
        lens,
        rotvec.reshape(3, 1).copy(),
        start.translation_m.reshape(3, 1).copy(),
    )
    projected, slopes = cv2.projectPoints(view.points_m, rotvec, translation, matrix, lens)[:2]
    by_point = np.asarray(slopes[:, 3:6], dtype=np.float64).reshape(-1, 2, 3)
    rotation = Rotation.from_rotvec(np.ravel(rotvec))
    turned = -rotation.as_matrix() @ cross_matrix(view.points_m)
    jacobian = np.concatenate([by_point, by_point @ turned], 2).reshape(-1, 6)
    squared = float(((projected.reshape(-1, 2) - view.pixels) ** 2).sum())
    normal = jacobian.T @ jacobian
    unit = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    covariance = np.outer(unit, unit) * np.linalg.pinv(normal * np.outer(unit, unit), 1e-12)
    quaternion = rotation.as_quat(canonical=True, scalar_first=True)
    pose = SE3(quaternion, np.asarray(translation, dtype=np.float64).ravel())
    return BoardPose(pose, (covariance + covariance.T) / 2, squared, len(view.points_m))


def board_pose_candidates(view: BoardView, camera: Camera) -> list[SE3]:
    """The poses that the corners allow: of a flat board one or two, of a solid one mostly one."""
    import cv2

    matrix, lens = camera.matrix(), np.array(camera.distortion)
    centred = view.points_m - view.points_m.mean(0)
    thickness = np.linalg.svd(centred, compute_uv=False)
    flat = thickness[2] < 1e-6 * thickness[0]
    way = cv2.SOLVEPNP_IPPE if flat else cv2.SOLVEPNP_SQPNP
    found = cv2.solvePnPGeneric(view.points_m, view.pixels, matrix, lens, flags=way)
    poses = []
    for rotvec, translation in zip(found[1], found[2], strict=True):
        if np.isfinite(rotvec).all() and np.isfinite(translation).all() and translation[2] > 0:
            quaternion = Rotation.from_rotvec(np.ravel(rotvec)).as_quat(scalar_first=True)
            poses.append(SE3(quaternion, np.asarray(translation, dtype=np.float64).ravel()))
    return poses


def pixel_sigma(poses: Sequence[BoardPose]) -> float:
    """Standard deviation of a corner coordinate in pixels, from all images together.

    Images that fit far worse than the others are passed over.
    """
    squared = np.array([pose.squared_px for pose in poses])
    freedom = np.array([max(2 * pose.corners - 6, 1) for pose in poses])
    usual = squared / freedom <= 4 * np.median(squared / freedom) + 1e-12
    return max(float(np.sqrt(squared[usual].sum() / freedom[usual].sum())), _LEAST_PX)
