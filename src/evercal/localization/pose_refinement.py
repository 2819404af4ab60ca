"""Robust Gauss-Newton refinement of a camera's pose and intrinsics, with their covariance.

`minimise` refines them with a prior of the intrinsics. `self_calibrated` widens that prior where
the image contradicts it.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from evercal.geometry import SE3, Camera, UncertainPose, in_parent_axes
from evercal.geometry.normal_equations import normal_inverse
from evercal.localization.intrinsics import (
    FREE,
    INTRINSICS,
    SAME_MODEL,
    IntrinsicsPrior,
)
from evercal.typing import Array

Pose = tuple[Array, Array]
"""Rotation (3, 3) and position (3,) of points_from_camera."""

_CONVERGED = 1e-2
"""Squared length of the last step, in variances."""
_DIVERGED = 10.0
"""If the residual variance grows by this factor, the last step is rejected."""
_FOCAL_CHANGE = 1.0
"""Maximum change of the logarithm of the focal lengths."""
SHARED = 0.05
"""Variance of the error that all observations of a cell share, over the square of their variance:
errors beyond the noise of patches, whose variance is 1, are shared more (research/map.md)."""
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
_MAX_ITERATIONS = 10
"""Gauss-Newton iterations of pose and intrinsics."""
_ROUGH = 0.7
"""If the residual variance changes by more than this ratio, the pose is estimated again."""
_REACHED = 0.05 * 7.815
"""Probability of another camera above which the covariance includes its pose: at 5 %, its squared
distance is the 95 % quantile of chi-squared with three degrees of freedom."""


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
        slope = self.slope[:count] * weight
        rows = slope.reshape(count, -1)
        sums = (slope @ cells).reshape(count, -1)
        hessian = rows @ rows.T
        squared_weight = weight**2
        noise = float((squared_weight @ squares) / (2 * squared_weight.sum()))
        shared = SHARED * self.variance**2
        scores = noise * hessian + shared * sums @ sums.T
        diagonal = slice(6 * count + 6, None, count + 1)
        hessian.flat[diagonal] += prior
        scores.flat[diagonal] += prior * (self.variance + self.bent)
        inverse = normal_inverse(hessian, _RIDGE)
        return inverse @ scores @ inverse

    def after(self, step: Array) -> "Minimum":
        """The same with the residuals after a step (k,), to first order."""
        residual = self.residual + np.tensordot(step, self.slope, 1)
        variance = robust_variance((residual**2).sum(0))
        return replace(self, residual=residual, variance=variance)

    def pose(self, covariance: Array) -> UncertainPose:
        """points_from_camera with a covariance (6, 6) in camera axes."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.position
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

    The start is rotation and position of points_from_camera, roughly, with a change (5,) of the
    intrinsics. These have variances (5,) about those of `camera`; none hold them fixed. Errors are
    linear in them: the caller repeats it after a large change.
    """
    rotation, position = start
    best = None
    gradient = np.zeros(0)
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
        first = white[None, :, 0] * slope[:, 0, None]
        slope = first + white[None, :, 1] * slope[:, 1, None]
        squares = residual[0] * residual[0] + residual[1] * residual[1]
        variance = robust_variance(squares)
        if best is not None and variance > _DIVERGED * best.variance:
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
        moved = moved.copy()
        moved[:free] += step[6:]
        moved[0] = np.clip(moved[0], -_FOCAL_CHANGE, _FOCAL_CHANGE)
        position = position + rotation @ step[:3]
        rotation = rotation @ cv2.Rodrigues(step[3:6])[0]
        gradient = gradient + data @ step
        if step @ data @ step + prior @ step[6:] ** 2 < _CONVERGED * variance:
            break
    assert best is not None, "at least one iteration"
    ahead = replace(
        best, rotation=rotation, position=position, change=moved, gradient=gradient
    )
    return _with_camera(ahead)


def _with_camera(minimum: Minimum) -> Minimum:
    """The minimum with its change applied to the camera."""
    if not minimum.change.any():
        return minimum
    return replace(minimum, camera=minimum.camera.changed(minimum.change))


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """A pose, intrinsics and the residuals of the observations."""

    pose: UncertainPose
    """points_from_camera; the uncertainty of the intrinsics is part of its covariance."""
    observed: Observed
    """Landmarks that the pose was refined by."""
    residual_px: Array
    """(n,) reprojection errors, pixels of the image."""
    camera: Camera
    """Refined intrinsics."""
    change: Array
    """(5,) change of the intrinsics."""
    by_intrinsics: Array
    """(6, 6) share of the pose's covariance that is due to the intrinsics."""


def self_calibrated(
    observed: Observed,
    camera: Camera,
    start: Pose,
    change: Array,
    prior: IntrinsicsPrior,
) -> RefinedPose:
    """Pose and intrinsics; the prior gives way where the image contradicts it.

    The start is that of `minimise`. Other priors than the stated one are a linear step away, unless
    the image contradicts it.
    """
    stated = prior.variances(camera)
    free = FREE.variances(camera)
    best = minimise(observed, camera, start, _MAX_ITERATIONS, stated, change)
    cells = cells_of(observed.pixels, camera)
    step, _ = best.moved(best.against(free))
    relaxed = best.after(step)
    measured = _measured(relaxed, free, cells)
    doubt, variances = prior.decided(camera, best.change + step[6:], measured)
    rough = not _ROUGH < relaxed.variance / best.variance < 1 / _ROUGH
    if variances is not None or doubt > prior.other_camera or rough:
        start = best.rotation, best.position
        freed = minimise(observed, camera, start, _MAX_ITERATIONS, free, best.change)
        if freed.variance < relaxed.variance:
            measured = _measured(freed, free, cells)
            doubt, variances = prior.decided(camera, freed.change, measured)
        if variances is not None:
            start = freed.rotation, freed.position
            best = minimise(
                observed, camera, start, _MAX_ITERATIONS, variances, freed.change
            )
    if variances is not None:
        covariance, lens = _covariances(best, variances, cells)
    else:
        covariance, lens = _covariances(best, stated, cells)
        if doubt:
            wider = _reaching_other_camera(best, stated, lens, cells)
            more = min(1.0, doubt / _REACHED) * wider
            covariance = covariance + more
            lens = lens + more
    more = best.bent / best.variance * lens
    by_lens = in_parent_axes(best.rotation, lens + more)
    pose = best.pose(covariance + more)
    return RefinedPose(
        pose, observed, best.residual_px, best.camera, best.change, by_lens
    )


def _reaching_other_camera(
    minimum: Minimum, stated: Array, lens: Array, cells: Array
) -> Array:
    """(6, 6) covariance whose deviation reaches to the pose of another camera of the model."""
    other = SAME_MODEL.variances(minimum.camera)
    to_other, _ = minimum.moved(minimum.against(other))
    to_stated, _ = minimum.moved(minimum.against(stated))
    offset = (to_other - to_stated)[:6]
    return _covariances(minimum, other, cells)[1] - lens + np.outer(offset, offset)


def _measured(minimum: Minimum, free: Array, cells: Array) -> Array:
    """(5, 5) covariance of intrinsics without a prior."""
    formal = minimum.covariance(minimum.against(free), cells)[6:, 6:]
    return (1 + minimum.bent / minimum.variance) * formal


def _covariances(
    minimum: Minimum, variances: Array, cells: Array
) -> tuple[Array, Array]:
    """(6, 6) covariance of a pose in camera axes, and the share of the intrinsics in it."""
    whole = minimum.covariance(minimum.against(variances), cells)[:6, :6]
    share = whole - minimum.covariance(np.zeros(0), cells)
    values, axes = np.linalg.eigh(share)
    return whole, (axes * np.maximum(values, 0)) @ axes.T


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
