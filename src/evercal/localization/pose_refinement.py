"""Robust Gauss-Newton refinement of a camera's pose and intrinsics, with their covariance."""

from dataclasses import replace

import cv2
import numpy as np

from evercal.classes import frozen_arrays
from evercal.geometry import SE3, Camera, UncertainPose, in_parent_axes
from evercal.geometry.normal_equations import normal_inverse
from evercal.localization.intrinsics import INTRINSICS
from evercal.typing import Array, ArrayPair

Pose = ArrayPair
"""Rotation (3, 3) and position (3,) of points_from_camera."""

_CONVERGED = 1e-2
"""Squared length of the last step, in variances."""
_DIVERGED = 10.0
"""If the residual variance grows by this factor, the last step is rejected."""
_FOCAL_CHANGE = 1.0
"""Maximum change of the logarithm of the focal lengths."""
SHARED = 0.05
"""Observations in one cell share an error of this variance, times the square of their own variance.
The noise of patches has variance 1, so larger errors are shared more (research/map.md)."""
SHARED_CELLS = 4
"""Number of cells along the shorter side of an image."""
_FIXED = np.zeros(0)
"""No variances: the intrinsics are fixed."""
_UNCHANGED = np.zeros(INTRINSICS)
"""No change of the intrinsics."""
_BENT_PX = 0.01
"""Errors of a map that all landmarks may share, pixels. They bound how well many landmarks measure
intrinsics: a flat wall seen from the front would otherwise seem to measure the focal length."""
_RIDGE = 1e-12
"""Ridge of the scaled information: an unconstrained direction gets a huge variance."""


@frozen_arrays
class Observed:
    """Landmarks observed in an image."""

    pixels: Array
    """(n, 2) of the image."""
    points_m: Array
    """(n, 3) in the map's frame."""
    whitening: Array
    """(2, 2, n) that gives errors in the image unit variance."""
    expected: int = 0
    """Landmarks that should be visible and were searched."""


@frozen_arrays
class Minimum:
    """Pose and intrinsics with the least errors, and the equations there."""

    rotation: Array
    """(3, 3) and `position` (3,) are those of points_from_camera."""
    position: Array
    camera: Camera
    """With `change`."""
    change: Array
    """(5,) of the intrinsics."""
    variance: float
    """Robust variance of the whitened errors."""
    bent: float
    """Variance that the share of all landmarks adds where they measure intrinsics."""
    data: Array
    """(6, 6) or (11, 11) information of the observations: of translation and rotation in camera
    axes, and of the intrinsics. Divided by `variance` it is that of the errors."""
    gradient: Array
    """(6,) or (11,) of the observations."""
    residual: Array
    """(2, n) whitened errors."""
    slope: Array
    """(6 or 11, 2, n) their derivatives."""
    residual_px: Array
    """(n,) errors, pixels of the image."""

    def against(self, variances: Array) -> Array:
        """Information (5,) of a prior with variances (5,), as `moved` weighs it."""
        return (self.variance + self.bent) / variances

    def moved(self, prior: Array) -> ArrayPair:
        """Step (k,) to the minimum with another prior, and its covariance (k, k).

        The prior is the information (5,) about unchanged intrinsics, see `against`; empty where
        they are fixed. The errors are linear in steps of this size.
        """
        data = self.data.copy()
        gradient = self.gradient.copy()
        count = len(data)
        data.flat[6 * count + 6 :: count + 1] += prior
        gradient[6:] += prior * self.change[: len(prior)]
        inverse = normal_inverse(data, _RIDGE)
        return -inverse @ gradient, inverse

    def covariance(self, prior: Array, cells: Array) -> Array:
        """Covariance (k, k) at the minimum with a prior, see `moved`.

        That of an M-estimator with Cauchy weights (Huber, Robust Statistics, 1981). Observations of
        a cell, see `cells_of`, share a part of their errors, which does not average out.
        """
        count = 6 + len(prior)
        squares = (self.residual**2).sum(0)
        weight = 1 / (1 + squares / self.variance)
        squared_weight = weight**2
        degrees = 2 * squared_weight.sum()
        noise = float((squared_weight @ squares) / degrees)
        slope = self.slope[:count] * weight
        rows = slope.reshape(count, -1)
        hessian = rows @ rows.T
        sums = (slope @ cells).reshape(count, -1)
        shared = SHARED * self.variance**2
        scores = noise * hessian
        scores += shared * sums @ sums.T
        diagonal = slice(6 * count + 6, None, count + 1)
        hessian.flat[diagonal] += prior
        scores.flat[diagonal] += prior * (self.variance + self.bent)
        inverse = normal_inverse(hessian, _RIDGE)
        return inverse @ scores @ inverse

    def by_intrinsics(self) -> Array:
        """(6, 5) derivative of the pose, in camera axes, by intrinsics that are held."""
        information = self.data[:6, :6]
        return -normal_inverse(information, _RIDGE) @ self.data[:6, 6:]

    def pose(self, covariance: Array) -> UncertainPose:
        """points_from_camera with a covariance (6, 6) in camera axes."""
        matrix = np.column_stack([self.rotation, self.position])
        pose = SE3.from_matrix(matrix)
        return UncertainPose(pose, in_parent_axes(self.rotation, covariance))


def minimise(
    observed: Observed,
    camera: Camera,
    start: Pose,
    iterations: int = 10,
    variances: Array = _FIXED,
    change: Array = _UNCHANGED,
) -> Minimum:
    """Minimise whitened reprojection errors with Cauchy weights.

    `change` (5,) of the intrinsics is that of the start; `variances` (5,) are about `camera`, none
    hold it fixed. Errors are linear in the change: the caller repeats it after a large one.
    """
    rotation, position = start
    best = None
    gradient = np.zeros(0)
    now = camera.changed(change)
    moved = change.copy()
    free = len(variances)
    bent = _BENT_PX**2 * float((observed.whitening**2).sum()) / 2
    for _ in range(max(iterations, 1)):
        raw, slope = linearise(
            observed.pixels, observed.points_m, rotation, position, now, free > 0
        )
        raw += (moved - change)[:free] @ slope[6:].transpose(1, 0, 2)
        residual, slope = whitened(observed.whitening, raw, slope)
        squares = residual[0] * residual[0] + residual[1] * residual[1]
        variance = robust_variance(squares)
        if best and variance > _DIVERGED * best.variance:
            return _with_camera(best)
        root = 1 / np.sqrt(1 + squares / variance)
        rows = (slope * root).reshape(len(slope), -1)
        data = rows @ rows.T
        gradient = rows @ (residual * root).ravel()
        best = Minimum(
            rotation=rotation,
            position=position,
            camera=camera,
            change=moved,
            variance=variance,
            bent=bent,
            data=data,
            gradient=gradient,
            residual=residual,
            slope=slope,
            residual_px=np.hypot(*raw),
        )
        prior = best.against(variances)
        step, _ = best.moved(prior)
        moved = _stepped(moved, step[6:])
        position = position + rotation @ step[:3]
        rotation = rotation @ cv2.Rodrigues(step[3:6])[0]
        gradient = gradient + data @ step
        if step @ data @ step + prior @ step[6:] ** 2 < _CONVERGED * variance:
            break
    assert best, "at least one iteration"
    ahead = replace(
        best, rotation=rotation, position=position, change=moved, gradient=gradient
    )
    return _with_camera(ahead)


def _stepped(change: Array, step: Array) -> Array:
    """The change (5,) of the intrinsics after a step, with a bounded focal length."""
    stepped = change.copy()
    stepped[: len(step)] += step
    stepped[0] = np.clip(stepped[0], -_FOCAL_CHANGE, _FOCAL_CHANGE)
    return stepped


def whitened(white: Array, errors: Array, slope: Array) -> ArrayPair:
    """Errors (2, n) and their derivatives (k, 2, n), whitened by (2, 2, n)."""
    residual = white[:, 0] * errors[0] + white[:, 1] * errors[1]
    by_x = white[None, :, 0] * slope[:, 0, None]
    by_y = white[None, :, 1] * slope[:, 1, None]
    return residual, by_x + by_y


def _with_camera(minimum: Minimum) -> Minimum:
    """The minimum with its change applied to the camera."""
    if not minimum.change.any():
        return minimum
    return replace(minimum, camera=minimum.camera.changed(minimum.change))


def robust_variance(squares: Array) -> float:
    """Variance of 2-D errors from their squared norms (n,), at least 0.05."""
    # The median of a 2-D Gaussian's squared norm is 1.386 variances.
    half = len(squares) // 2
    # np.median takes three times as long for some hundred values.
    median = float(np.partition(squares, half)[half])
    return max(median / 1.386, 0.05)


def cells_of(pixels: Array, camera: Camera) -> Array:
    """(n, cells) 1 where a pixel (n, 2) lies in a cell of the image."""
    side = min(camera.size) / SHARED_CELLS
    cell = (pixels // side).astype(np.int64) @ [1, 1000]
    return (cell[:, None] == np.unique(cell)).astype(float)


def linearise(
    pixels: Array,
    points_m: Array,
    rotation: Array,
    position: Array,
    camera: Camera,
    intrinsics: bool = False,
) -> ArrayPair:
    """Reprojection errors and their derivatives by the pose, and by intrinsics if wanted.

    Rotation and position are those of points_from_camera. Residuals are (2, n) pixels, derivatives
    (6 or 11, 2, n) by a motion (translation, rotation) in the camera frame and by a change of the
    intrinsics.
    """
    x, y, depth = rotation.T @ (points_m - position).T
    inverse = 1 / np.maximum(depth, 1e-3)
    x = x * inverse
    y = y * inverse
    slope = np.zeros((6 + INTRINSICS * intrinsics, 2, len(x)))
    slope[0, 0] = -inverse
    slope[2, 0] = x * inverse
    slope[3, 0] = x * y
    slope[4, 0] = -1 - x * x
    slope[5, 0] = y
    slope[1, 1] = -inverse
    slope[2, 1] = y * inverse
    slope[3, 1] = 1 + y * y
    slope[4, 1] = -slope[3, 0]
    slope[5, 1] = -x
    if camera.distortion:
        # Written out: products of small matrices take four times as long.
        by_plane, lens = camera.slopes(np.stack([x, y], -1))
        chain = np.ascontiguousarray(by_plane.transpose(1, 2, 0))
        by_x = chain[None, :, 0] * slope[:6, 0, None]
        by_y = chain[None, :, 1] * slope[:6, 1, None]
        slope[:6] = by_x + by_y
        if intrinsics:
            slope[6:] = lens.transpose(2, 1, 0)
        # The derivative by the logarithm of the focal length is the pixel beside the centre.
        u = lens[:, 0, 0]
        v = lens[:, 1, 0]
    else:
        u = camera.fx * x
        v = camera.fy * y
        slope[:6] *= np.array([camera.fx, camera.fy])[:, None]
        if intrinsics:
            r2 = x * x + y * y
            slope[6, 0] = u
            slope[6, 1] = v
            slope[7, 0] = 1
            slope[8, 1] = 1
            slope[9] = slope[6] * r2
            slope[10] = slope[9] * r2
    u = u + camera.cx - pixels[:, 0]
    v = v + camera.cy - pixels[:, 1]
    return np.stack([u, v]), slope
