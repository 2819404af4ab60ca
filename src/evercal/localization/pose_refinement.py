"""Robust Gauss-Newton refinement of a camera pose, with its covariance."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from evercal.geometry import SE3, Camera, UncertainPose

Array = NDArray[np.floating]

_SMALL = 1e-5


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """A pose and the residuals of its observations."""

    pose: UncertainPose
    """points_from_camera."""
    residual_px: Array
    """(n,) reprojection errors, pixels of the image."""


def refine_pose(
    pixels: Array,
    points_m: Array,
    whitening: Array,
    camera: Camera,
    start: SE3,
    iterations: int = 10,
    distortion: Array | None = None,
) -> RefinedPose:
    """Minimise whitened reprojection errors with Cauchy weights.

    Pixels (n, 2) lie in the ideal pinhole, and the start is points_from_camera. The whitening (n,
    2, 2) gives errors in the image unit variance. The distortion (n, 2, 2) holds derivatives of
    image pixels by those of the ideal pinhole.
    """
    whitening = whitening if distortion is None else whitening @ distortion
    rotation, position = start.rotation_matrix(), start.translation_m
    white = np.ascontiguousarray(whitening.transpose(1, 2, 0))
    variance, information = 1.0, np.eye(6)
    for _ in range(max(iterations, 1)):
        raw, slope = linearise(pixels, points_m, rotation, position, camera)
        residual = white[:, 0] * raw[0] + white[:, 1] * raw[1]
        slope = white[:, 0, None] * slope[0] + white[:, 1, None] * slope[1]
        squares = (residual**2).sum(0)
        # Robust scale: the median of a 2-D Gaussian's squared norm is 1.386 variances.
        variance = max(float(np.median(squares)) / 1.386, 0.05)
        root = 1 / np.sqrt(1 + squares / variance)
        rows = (slope * root).transpose(1, 0, 2).reshape(6, -1)
        information = rows @ rows.T + 1e-9 * np.eye(6)
        step = -np.linalg.solve(information, rows @ (residual * root).ravel())
        position = position + rotation @ step[:3]
        rotation = rotation @ cv2.Rodrigues(step[3:])[0]
        if np.abs(step).max() < _SMALL:
            break
    raw, _ = linearise(pixels, points_m, rotation, position, camera)
    raw = raw if distortion is None else np.einsum("nij,jn->in", distortion, raw)
    covariance = in_parent_axes(rotation, variance * np.linalg.inv(information))
    quaternion = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
    pose = UncertainPose(SE3(quaternion, position), np.asarray(covariance, np.float64))
    return RefinedPose(pose, np.hypot(*raw))


def linearise(
    pixels: Array, points_m: Array, rotation: Array, position: Array, camera: Camera
) -> tuple[Array, Array]:
    """Reprojection errors and their derivatives by the pose.

    Pixels (n, 2) lie in the ideal pinhole; rotation and position are those of points_from_camera.

    Returns:
        Residuals (2, n), and derivatives (2, 6, n) by a motion (translation, rotation) in the
        camera frame.
    """
    local = rotation.T @ (points_m - position).T
    inverse = 1 / np.maximum(local[2], 1e-3)
    x, y = local[0] * inverse, local[1] * inverse
    fx, fy = camera.fx, camera.fy
    residual = np.stack([x * fx + (camera.cx - pixels[:, 0]), y * fy + (camera.cy - pixels[:, 1])])
    slope = np.empty((2, 6, len(x)))
    slope[0, 0], slope[0, 1], slope[0, 2] = -inverse, 0, x * inverse
    slope[0, 3], slope[0, 4], slope[0, 5] = x * y, -1 - x * x, y
    slope[1, 0], slope[1, 1], slope[1, 2] = 0, -inverse, y * inverse
    slope[1, 3], slope[1, 4], slope[1, 5] = 1 + y * y, -slope[0, 3], -x
    slope *= np.array([fx, fy])[:, None, None]
    return residual, slope


def in_parent_axes(rotation: Array, covariance: Array) -> Array:
    """Covariance (6, 6) with its translation part rotated from camera axes to the parent's."""
    slope = np.eye(6)
    slope[:3, :3] = rotation
    return slope @ covariance @ slope.T
