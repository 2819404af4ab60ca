"""Robust Gauss-Newton refinement of a camera's pose and intrinsics, with their covariance."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from evercal.geometry import SE3, Camera, UncertainPose

Array = NDArray[np.floating]

INTRINSICS = 5
"""Parameters of a change: logarithm of the focal lengths, principal point in pixels, k1, k2."""
_SMALL = 1e-5
_DIVERGED = 10.0
"""Growth of the variance of residuals at which the step before is kept."""
_FOCAL_CHANGE = 1.0
"""Largest change of the logarithm of the focal lengths."""
_OPEN = 1e-12
"""Damping of the scaled information: an open direction gets a huge variance."""


@dataclass(frozen=True, eq=False)
class Observed:
    """Landmarks observed in an image."""

    pixels: Array
    """(n, 2) of the image."""
    points_m: Array
    """(n, 3) in the map's frame."""
    whitening: Array
    """(n, 2, 2) that gives errors in the image unit variance."""


@dataclass(frozen=True, eq=False)
class MeasuredIntrinsics:
    """Intrinsics that landmarks measure without a prior."""

    squares: float
    """Squared change from the stated intrinsics in standard deviations of landmarks' errors."""
    by_shared: float
    """Factor on the variance is 1 + `by_shared` s^2, if landmarks share errors of s pixels."""


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """A pose, intrinsics and the residuals of the observations."""

    pose: UncertainPose
    """points_from_camera; the uncertainty of the intrinsics is part of its covariance."""
    residual_px: Array
    """(n,) reprojection errors, pixels of the image."""
    camera: Camera
    """Refined intrinsics; the given ones without a prior."""
    change: Array
    """(5,) change of the intrinsics."""
    change_covariance: Array
    """(5, 5)."""
    variance: float
    """Robust variance of the whitened errors."""
    by_intrinsics: Array
    """(6, 6) share of the pose's covariance that is due to the intrinsics."""
    measured: MeasuredIntrinsics | None = None
    """Intrinsics without a prior, where they were estimated."""


@dataclass(frozen=True, eq=False)
class _Iterate:
    """Pose and intrinsics of an iteration, and the normal equations that led to them."""

    rotation: NDArray[np.float64]
    position: NDArray[np.float64]
    change: Array
    camera: Camera
    """With the change of the intrinsics."""
    variance: float
    """Robust variance of the whitened errors; infinite before the first iteration."""
    information: Array
    """(6, 6) or (11, 11), with the prior."""
    data: Array
    """The same without the prior."""


def refine_pose(
    observed: Observed,
    camera: Camera,
    start: SE3,
    iterations: int = 10,
    variances: Array | None = None,
    change: Array | None = None,
) -> RefinedPose:
    """Minimise whitened reprojection errors with Cauchy weights.

    The start is points_from_camera, roughly, with a change (5,) of the intrinsics. These have
    variances (5,) about those of `camera`; None holds them fixed.
    """
    count = 6 if variances is None else 6 + INTRINSICS
    moved: Array = np.zeros(INTRINSICS) if change is None else change
    current = camera if variances is None else changed_camera(camera, moved)
    seen = observed.pixels, observed.points_m
    white = np.ascontiguousarray(observed.whitening.transpose(1, 2, 0))
    nothing = np.inf, np.eye(count), np.eye(count)
    best = at = _Iterate(start.rotation_matrix(), start.translation_m, moved, current, *nothing)
    for _ in range(max(iterations, 1)):
        raw, slope = linearise(*seen, at.rotation, at.position, at.camera, variances is not None)
        residual = _whitened(white, raw)
        slope = white[:, 0, None] * slope[0] + white[:, 1, None] * slope[1]
        squares = (residual**2).sum(0)
        variance = _robust_variance(squares)
        if variance > _DIVERGED * best.variance:
            at = best
            break
        root = 1 / np.sqrt(1 + squares / variance)
        rows = (slope * root).transpose(1, 0, 2).reshape(count, -1)
        data = rows @ rows.T + 1e-9 * np.eye(count)
        gradient = rows @ (residual * root).ravel()
        information = data
        if variances is not None:
            prior = np.r_[np.zeros(6), variance / variances]
            information = data + np.diag(prior)
            gradient[6:] += prior[6:] * at.change
        at = replace(at, variance=variance, information=information, data=data)
        if variance <= best.variance:
            best = at
        step = -_inverse(information) @ gradient
        if variances is not None:
            moved = at.change + step[6:]
            moved[0] = np.clip(moved[0], -_FOCAL_CHANGE, _FOCAL_CHANGE)
            at = replace(at, change=moved, camera=changed_camera(camera, moved))
        position = at.position + at.rotation @ step[:3]
        at = replace(at, rotation=at.rotation @ cv2.Rodrigues(step[3:6])[0], position=position)
        if np.abs(step[:6]).max() < _SMALL:
            break
    raw, _ = linearise(*seen, at.rotation, at.position, at.camera)
    if _robust_variance((_whitened(white, raw) ** 2).sum(0)) > _DIVERGED * best.variance:
        at = best
        raw, _ = linearise(*seen, at.rotation, at.position, at.camera)
    quaternion = Rotation.from_matrix(at.rotation).as_quat(scalar_first=True)
    covariance = at.variance * _inverse(at.information)
    fixed = at.variance * _inverse(at.data[:6, :6])
    own = np.asarray(in_parent_axes(at.rotation, covariance[:6, :6]), np.float64)
    pose = UncertainPose(SE3(quaternion, at.position), own)
    by_intrinsics = np.asarray(in_parent_axes(at.rotation, covariance[:6, :6] - fixed), np.float64)
    return RefinedPose(
        pose, np.hypot(*raw), at.camera, at.change, covariance[6:, 6:], at.variance, by_intrinsics
    )


def _median(values: Array) -> float:
    """Median of (n,) values; np.median takes three times as long for some hundred of them."""
    half = len(values) // 2
    middle = np.partition(values, (half - 1, half))[half - 1 : half + 1]
    return float(middle[1] if len(values) % 2 else middle.mean())


def changed_camera(camera: Camera, change: Array) -> Camera:
    """A camera with changed intrinsics."""
    factor, (k1, k2, *others) = float(np.exp(change[0])), camera.coefficients
    return replace(
        camera,
        fx=factor * camera.fx,
        fy=factor * camera.fy,
        cx=camera.cx + float(change[1]),
        cy=camera.cy + float(change[2]),
        distortion=(k1 + float(change[3]), k2 + float(change[4]), *others),
    )


def _whitened(white: Array, raw: Array) -> Array:
    return white[:, 0] * raw[0] + white[:, 1] * raw[1]


def _robust_variance(squares: Array) -> float:
    # The median of a 2-D Gaussian's squared norm is 1.386 variances.
    return max(_median(squares) / 1.386, 0.05)


def _inverse(information: Array) -> Array:
    """Inverse of a positive semi-definite matrix whose units differ by orders of magnitude."""
    scale = np.sqrt(np.diag(information))
    scaled = information / np.outer(scale, scale) + _OPEN * np.eye(len(scale))
    return np.linalg.inv(scaled) / np.outer(scale, scale)


def linearise(
    pixels: Array,
    points_m: Array,
    rotation: Array,
    position: Array,
    camera: Camera,
    intrinsics: bool = False,
) -> tuple[Array, Array]:
    """Reprojection errors and their derivatives by the pose, and by intrinsics if wanted.

    Rotation and position are those of points_from_camera. Residuals are (2, n) pixels, derivatives
    (2, 6 or 11, n) by a motion (translation, rotation) in the camera frame and by a change of the
    intrinsics.
    """
    local = rotation.T @ (points_m - position).T
    inverse = 1 / np.maximum(local[2], 1e-3)
    x, y = local[0] * inverse, local[1] * inverse
    slope = np.empty((2, 6 + INTRINSICS * intrinsics, len(x)))
    slope[0, 0], slope[0, 1], slope[0, 2] = -inverse, 0, x * inverse
    slope[0, 3], slope[0, 4], slope[0, 5] = x * y, -1 - x * x, y
    slope[1, 0], slope[1, 1], slope[1, 2] = 0, -inverse, y * inverse
    slope[1, 3], slope[1, 4], slope[1, 5] = 1 + y * y, -slope[0, 3], -x
    if not (camera.distortion or intrinsics):
        focal = np.array([camera.fx, camera.fy])
        projected = np.stack([x * camera.fx + camera.cx, y * camera.fy + camera.cy])
        slope *= focal[:, None, None]
        return projected - pixels.T, slope
    plane = np.stack([x, y], -1)
    by_plane, by_intrinsics = camera.slopes(plane)
    # Written out: einsum takes four times as long for products of this shape.
    chain = np.ascontiguousarray(by_plane.transpose(1, 2, 0))
    by_pose = [chain[i, 0] * slope[0, :6] + chain[i, 1] * slope[1, :6] for i in (0, 1)]
    slope[0, :6], slope[1, :6] = by_pose
    if intrinsics:
        slope[:, 6:] = by_intrinsics.transpose(1, 2, 0)
    # The derivative by the logarithm of the focal length is the pixel beside the principal point.
    projected = by_intrinsics[..., 0] + [camera.cx, camera.cy]
    return (projected - pixels).T, slope


def in_parent_axes(rotation: Array, covariance: Array) -> Array:
    """Covariance (6, 6) with its translation part rotated from camera axes to the parent's."""
    slope = np.eye(6)
    slope[:3, :3] = rotation
    return slope @ covariance @ slope.T
