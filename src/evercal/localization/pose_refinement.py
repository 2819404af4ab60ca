"""Robust Gauss-Newton refinement of a camera pose, and the covariance of what it found."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from evercal.geometry.pose_covariance import with_translation_by
from evercal.geometry.se3 import SE3

Array = NDArray[np.floating]

_SMALL = 1e-5


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """A pose and how well the observations agree with it."""

    base_from_camera: SE3
    """In the frame of the points."""
    residual_px: Array
    """(n,) distances of the observations from the projected points, pixels of the image."""
    covariance: Array
    """(6, 6) of (translation in the base frame, metres; rotation about camera axes, radians)."""


def refine_pose(
    pixels: Array,
    points_m: Array,
    whitening: Array,
    intrinsics: Array,
    start: SE3,
    iterations: int = 10,
    lens: Array | None = None,
) -> RefinedPose:
    """Moves a pose to where whitened reprojection errors are smallest, with Cauchy's weights.

    Args:
        pixels: (n, 2) in the ideal pinhole.
        points_m: (n, 3).
        whitening: (n, 2, 2) matrices that give errors in the image unit variance.
        intrinsics: (4,) fx, fy, cx, cy.
        start: base_from_camera, roughly.
        iterations: Gauss-Newton steps, at most.
        lens: (n, 2, 2) how pixels of the image move with those of the ideal pinhole; None where
            they are the same.
    """
    whitening = whitening if lens is None else whitening @ lens
    turn, place = start.rotation_matrix(), start.translation_m
    white = np.ascontiguousarray(whitening.transpose(1, 2, 0))
    variance, information = 1.0, np.eye(6)
    for _ in range(max(iterations, 1)):
        raw, slope = linearised(pixels, points_m, turn, place, intrinsics)
        residual = white[:, 0] * raw[0] + white[:, 1] * raw[1]
        slope = white[:, 0, None] * slope[0] + white[:, 1, None] * slope[1]
        squares = (residual**2).sum(0)
        # The scale follows the data: half of the errors lie below 1.18 standard deviations.
        variance = max(float(np.median(squares)) / 1.386, 0.05)
        root = 1 / np.sqrt(1 + squares / variance)
        rows = (slope * root).transpose(1, 0, 2).reshape(6, -1)
        information = rows @ rows.T + 1e-9 * np.eye(6)
        step = -np.linalg.solve(information, rows @ (residual * root).ravel())
        place = place + turn @ step[:3]
        turn = turn @ cv2.Rodrigues(step[3:])[0]
        if np.abs(step).max() < _SMALL:
            break
    raw, _ = linearised(pixels, points_m, turn, place, intrinsics)
    raw = raw if lens is None else np.einsum("nij,jn->in", lens, raw)
    covariance = with_translation_by(turn, variance * np.linalg.inv(information))
    quaternion = Rotation.from_matrix(turn).as_quat(scalar_first=True)
    return RefinedPose(SE3(quaternion, place), np.hypot(*raw), covariance)


def linearised(
    pixels: Array, points_m: Array, turn: Array, place: Array, intrinsics: Array
) -> tuple[Array, Array]:
    """How far points are projected from where they were seen, and how that changes.

    Args:
        pixels: (n, 2) in the ideal pinhole.
        points_m: (n, 3).
        turn: (3, 3) rotation of base_from_camera.
        place: (3,) its translation.
        intrinsics: (4,) fx, fy, cx, cy.

    Returns:
        Residuals (2, n) and their derivatives (2, 6, n) by a motion (translation, rotation) in the
        camera frame.
    """
    fx, fy, cx, cy = intrinsics
    local = turn.T @ (points_m - place).T
    inverse = 1 / np.maximum(local[2], 1e-3)
    x, y = local[0] * inverse, local[1] * inverse
    residual = np.stack([x * fx + (cx - pixels[:, 0]), y * fy + (cy - pixels[:, 1])])
    slope = np.empty((2, 6, len(x)))
    slope[0, 0], slope[0, 1], slope[0, 2] = -inverse, 0, x * inverse
    slope[0, 3], slope[0, 4], slope[0, 5] = x * y, -1 - x * x, y
    slope[1, 0], slope[1, 1], slope[1, 2] = 0, -inverse, y * inverse
    slope[1, 3], slope[1, 4], slope[1, 5] = 1 + y * y, -slope[0, 3], -x
    slope *= np.array([fx, fy])[:, None, None]
    return residual, slope
