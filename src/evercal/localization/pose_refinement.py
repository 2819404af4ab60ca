"""Robust Gauss-Newton refinement of a camera pose, and the covariance of what it found."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from evercal.geometry.se3 import SE3

Array = NDArray[np.floating]

_SMALL = 1e-5


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """A pose and how well the observations agree with it."""

    base_from_camera: SE3
    """In the frame of the points."""
    residual_px: Array
    """(n,) distances of the observations from the projected points, pixels."""
    covariance: Array
    """(6, 6) of (translation in the base frame, metres; rotation about camera axes, radians)."""


def refine_pose(
    pixels: Array,
    points_m: Array,
    whitening: Array,
    intrinsics: Array,
    start: SE3,
    iterations: int = 10,
) -> RefinedPose:
    """Moves a pose to where whitened reprojection errors are smallest, with Cauchy's weights.

    Args:
        pixels: (n, 2) in the ideal pinhole.
        points_m: (n, 3).
        whitening: (n, 2, 2) matrices that give the errors of the pixels unit variance.
        intrinsics: (4,) fx, fy, cx, cy.
        start: base_from_camera, roughly.
        iterations: Gauss-Newton steps, at most.
    """
    turn, place = start.rotation_matrix(), start.translation_m
    focal, centre = intrinsics[:2], intrinsics[2:]
    variance, information = 1.0, np.eye(6)
    for _ in range(max(iterations, 1)):
        raw, jacobian = _linearised(pixels, points_m, turn, place, focal, centre)
        residual = (whitening @ raw[..., None])[..., 0]
        jacobian = whitening @ jacobian
        squares = (residual**2).sum(1)
        # The scale follows the data: half of the errors lie below 1.18 standard deviations.
        variance = max(float(np.median(squares)) / 1.386, 0.05)
        weight = 1 / (1 + squares / variance)
        weighted = (jacobian * weight[:, None, None]).reshape(-1, 6)
        information = weighted.T @ jacobian.reshape(-1, 6) + 1e-9 * np.eye(6)
        step = -np.linalg.solve(information, weighted.T @ residual.ravel())
        place = place + turn @ step[:3]
        turn = turn @ Rotation.from_rotvec(step[3:]).as_matrix()
        if np.abs(step).max() < _SMALL:
            break
    raw, _ = _linearised(pixels, points_m, turn, place, focal, centre)
    rotation = np.eye(6)
    rotation[:3, :3] = turn
    covariance = rotation @ (variance * np.linalg.inv(information)) @ rotation.T
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, place
    return RefinedPose(SE3.from_matrix(matrix), np.linalg.norm(raw, axis=1), covariance)


def _linearised(
    pixels: Array, points_m: Array, turn: Array, place: Array, focal: Array, centre: Array
) -> tuple[Array, Array]:
    """Residuals (n, 2) and derivatives (n, 2, 6) by a motion in the camera frame."""
    local = (points_m - place) @ turn
    depth = np.maximum(local[:, 2], 1e-3)
    x, y = (local[:, :2] / depth[:, None]).T
    (fx, fy), zero = focal, np.zeros_like(x)
    residual = np.stack([x * fx, y * fy], -1) + centre - pixels
    jacobian = np.empty((len(x), 2, 6))
    for row, values in enumerate(
        (
            (-fx / depth, zero, fx * x / depth, fx * x * y, -fx * (1 + x * x), fx * y),
            (zero, -fy / depth, fy * y / depth, fy * (1 + y * y), -fy * x * y, -fy * x),
        )
    ):
        for column, value in enumerate(values):
            jacobian[:, row, column] = value
    return residual, jacobian
