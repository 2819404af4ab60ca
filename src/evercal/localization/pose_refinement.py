"""Robust Gauss-Newton refinement of a camera's pose and intrinsics, with their covariance."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from evercal.geometry import SE3, Camera, UncertainPose, in_parent_axes
from evercal.geometry.normal_equations import normal_inverse
from evercal.typing import Array

INTRINSICS = 5
"""Parameters of a change: logarithm of the focal lengths, principal point in pixels, k1, k2."""
_CONVERGED = 1e-2
"""Squared length of the last step, in standard deviations."""
_DIVERGED = 10.0
"""Growth of the variance of residuals at which the step before is kept."""
_FOCAL_CHANGE = 1.0
"""Largest change of the logarithm of the focal lengths."""
SHARED = 0.05
"""Variance of the error that all observations of a cell share, over the square of their variance:
errors beyond the noise of patches, whose variance is 1, are shared more (research/map.md)."""
SHARED_CELLS = 4
"""Such cells along the shorter side of an image."""
_FIXED = np.zeros(0)
_UNCHANGED = np.zeros(INTRINSICS)
_BENT_PX = 0.01
"""Errors of a map that all landmarks may share, pixels. They bound how well many landmarks measure
intrinsics: a flat wall seen from the front would otherwise seem to measure the focal length."""
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
    """(2, 2, n) that gives errors in the image unit variance."""
    expected: int = 0
    """Landmarks that should be visible and were searched."""


@dataclass(frozen=True, eq=False)
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

    def moved(self, prior: Array) -> tuple[Array, Array]:
        """Step (k,) to the minimum with another prior, and its covariance (k, k).

        The prior is the information (5,) about unchanged intrinsics, see `against`; empty where
        they are fixed. The errors are linear in steps of this size.
        """
        count = len(prior)
        data = self.data.copy()
        gradient = self.gradient.copy()
        data.flat[6 * len(data) + 6 :: len(data) + 1] += prior
        gradient[6:] += prior * self.change[:count]
        inverse = normal_inverse(data, _OPEN)
        return -inverse @ gradient, inverse

    def covariance(self, prior: Array, cells: Array) -> Array:
        """Covariance (k, k) at the minimum with a prior, see `moved`.

        That of an M-estimator with Cauchy weights (Huber, Robust Statistics, 1981). Observations of
        a cell, see `cells_of`, share a part of their errors, which does not average out.
        """
        count = 6 + len(prior)
        squares = (self.residual**2).sum(0)
        weight = 1 / (1 + squares / self.variance)
        slope = self.slope[:count] * weight
        rows = slope.reshape(count, -1)
        sums = (slope @ cells).reshape(count, -1)
        hessian = rows @ rows.T
        noise = float((weight**2 @ squares) / (2 * (weight**2).sum()))
        scores = noise * hessian + SHARED * self.variance**2 * sums @ sums.T
        diagonal = slice(6 * count + 6, None, count + 1)
        hessian.flat[diagonal] += prior
        scores.flat[diagonal] += prior * (self.variance + self.bent)
        inverse = normal_inverse(hessian, _OPEN)
        return inverse @ scores @ inverse

    def after(self, step: Array) -> "Minimum":
        """The same with the residuals after a step (k,), to first order."""
        residual = self.residual + np.tensordot(step, self.slope, 1)
        return replace(
            self, residual=residual, variance=robust_variance((residual**2).sum(0))
        )

    def pose(self, covariance: Array) -> UncertainPose:
        """points_from_camera with a covariance (6, 6) in camera axes."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.position
        return UncertainPose(
            SE3.from_matrix(matrix), in_parent_axes(self.rotation, covariance)
        )


def minimise(
    observed: Observed,
    camera: Camera,
    start: tuple[Array, Array],
    iterations: int = 10,
    variances: Array = _FIXED,
    change: Array = _UNCHANGED,
) -> Minimum:
    """Minimise whitened reprojection errors with Cauchy weights.

    The start is rotation and position of points_from_camera, roughly, with a change (5,) of the
    intrinsics. These have variances (5,) about those of `camera`; none hold them fixed. Errors are
    linear in them: the caller repeats it after a large change.
    """
    (rotation, position), best, ahead = start, None, {}
    now = camera.changed(change)
    moved = change.copy()
    white = observed.whitening
    free = len(variances)
    bent = _BENT_PX**2 * float((white**2).sum()) / 2
    for _ in range(max(iterations, 1)):
        raw, slope = linearise(
            observed.pixels, observed.points_m, rotation, position, now, free > 0
        )
        raw += (moved - change)[:free] @ slope[6:].transpose(1, 0, 2)
        residual = white[:, 0] * raw[0] + white[:, 1] * raw[1]
        slope = (
            white[None, :, 0] * slope[:, 0, None]
            + white[None, :, 1] * slope[:, 1, None]
        )
        squares = residual[0] * residual[0] + residual[1] * residual[1]
        variance = robust_variance(squares)
        if best is not None and variance > _DIVERGED * best.variance:
            ahead = {}
            break
        root = 1 / np.sqrt(1 + squares / variance)
        rows = (slope * root).reshape(len(slope), -1)
        data = rows @ rows.T
        gradient = rows @ (residual * root).ravel()
        best = Minimum(
            rotation, position, camera, moved, variance, bent, data, gradient, residual, slope,
            np.hypot(*raw),
        )  # fmt: skip
        prior = best.against(variances)
        step, _ = best.moved(prior)
        moved = moved.copy()
        moved[:free] += step[6:]
        moved[0] = np.clip(moved[0], -_FOCAL_CHANGE, _FOCAL_CHANGE)
        position = position + rotation @ step[:3]
        rotation = rotation @ cv2.Rodrigues(step[3:6])[0]
        ahead = {"rotation": rotation, "position": position, "change": moved}
        ahead["gradient"] = gradient + data @ step
        if step @ data @ step + prior @ step[6:] ** 2 < _CONVERGED * variance:
            break
    assert best is not None, "at least one iteration"
    best = replace(best, **ahead)
    return replace(
        best, camera=camera.changed(best.change) if best.change.any() else camera
    )


def robust_variance(squares: Array) -> float:
    """Variance of 2-D errors from their squared norms (n,), at least 0.05."""
    # The median of a 2-D Gaussian's squared norm is 1.386 variances.
    half = len(squares) // 2
    # np.median takes three times as long for some hundred values.
    return max(float(np.partition(squares, half)[half]) / 1.386, 0.05)


def cells_of(pixels: Array, camera: Camera) -> Array:
    """(n, cells) 1 where a pixel (n, 2) lies in a cell of the image."""
    side = min(camera.width, camera.height) / SHARED_CELLS
    cell = (pixels // side).astype(np.int64) @ [1, 1000]
    return (cell[:, None] == np.unique(cell)).astype(np.float64)


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
    (6 or 11, 2, n) by a motion (translation, rotation) in the camera frame and by a change of the
    intrinsics.
    """
    local = rotation.T @ (points_m - position).T
    inverse = 1 / np.maximum(local[2], 1e-3)
    x = local[0] * inverse
    y = local[1] * inverse
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
        slope[:6] = (
            chain[None, :, 0] * slope[:6, 0, None]
            + chain[None, :, 1] * slope[:6, 1, None]
        )
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
    return np.stack([u + camera.cx - pixels[:, 0], v + camera.cy - pixels[:, 1]]), slope
