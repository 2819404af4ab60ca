"""Priors on the intrinsics of a query image.

A stated focal length is a prior and not a fact. The landmarks of an image measure the intrinsics
together with the pose, to a thousandth. Where they contradict the prior, the prior gives way.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from evercal.errors import InputError
from evercal.geometry import Camera, UncertainPose, in_parent_axes
from evercal.localization.pose_refinement import (
    INTRINSICS,
    Minimum,
    Observed,
    cells_of,
    minimise,
)
from evercal.typing import Array

if TYPE_CHECKING:
    from evercal.localization.learned import LearnedScene


CONTRADICTED = 15.1
"""Squared deviation of all five, above which no prior holds: the 99 % quantile (chi-squared)."""
DOUBT = 3.0
"""Squared deviations from the prior, in standard deviations, from which it gives way."""

_REFINE_STEPS = 10
"""Gauss-Newton steps of pose and intrinsics, at most."""
_ROUGH = 0.7
"""Ratio of variances, to either side, at which a linear step to other intrinsics is rough."""
_REACHED = 0.05 * 7.815
"""Probability of another camera at which the 95 % ellipsoid (chi-squared) reaches its pose."""


@dataclass(frozen=True, eq=False)
class IntrinsicsPrior:
    """Standard deviations of a camera's intrinsics about their stated values."""

    focal: float
    """Of both focal lengths, as a share."""
    centre: float
    """Of the principal point, as a share of the longer image side."""
    k1: float
    """Of the first radial distortion coefficient."""
    k2: float
    """Of the second one."""
    other_camera: float = 0.0
    """Probability that the image is of another camera of the same model, see `SAME_MODEL`."""

    def variances(self, camera: Camera) -> Array:
        """(5,) variances of a change of intrinsics, see `Camera.changed`."""
        centre = self.centre * max(camera.width, camera.height)
        return np.square([self.focal, centre, centre, self.k1, self.k2])

    def tested(self, camera: Camera, change: Array, measured: Array) -> Array:
        """(5,) variances: those of the prior, wider where an estimate contradicts it.

        The change (5,) and its covariance (5, 5) were estimated without a prior. Before a flat
        scene no parameter contradicts the prior alone, but all together may.
        """
        tight = self.variances(camera)
        excess = change**2 - DOUBT * (np.diag(measured) + tight)
        variances = tight + np.maximum(excess, 0)
        squares = change @ np.linalg.solve(measured + np.diag(variances), change)
        return FREE.variances(camera) if squares > CONTRADICTED else variances

    def doubt(self, camera: Camera, change: Array, measured: Array) -> float:
        """Probability that an image is of another camera of the model, by estimated intrinsics.

        See `tested`. Each hypothesis is a Gaussian about the intrinsics of the recording.
        """
        own, other = (
            _log_density(change, measured + np.diag(sigma.variances(camera)))
            for sigma in (self, SAME_MODEL)
        )
        before = self.other_camera
        odds = before / (1 - before) * math.exp(min(max(other - own, -700.0), 700.0))
        return odds / (1 + odds)

    def decided(
        self, camera: Camera, change: Array, measured: Array
    ) -> tuple[float, Array | None]:
        """Probability of another camera, and variances (5,) that an estimate asks for.

        The variances are None where the prior holds; the estimate is as for `tested`.
        """
        if not self.other_camera:
            variances = self.tested(camera, change, measured)
            holds = np.allclose(variances, self.variances(camera))
            return 0.0, None if holds else variances
        doubt = self.doubt(camera, change, measured)
        if doubt <= 0.5:
            return doubt, None
        return doubt, UNKNOWN.tested(camera, change, measured)


OWN = IntrinsicsPrior(focal=2e-4, centre=3e-4, k1=1e-3, k2=1e-3, other_camera=0.4)
"""The camera that recorded the scene: its error is in the landmarks, too, and cancels. It may
be another one of the model, also where it is stated: people state it. Where an image shows no
difference, the covariance reaches the other camera (`_REACHED`), and the pose is the own one's."""
NOT_STATED = replace(OWN)
"""No camera is stated, and the image has the size of the recording."""
SAME_MODEL = IntrinsicsPrior(focal=0.007, centre=0.007, k1=0.01, k2=0.01)
"""Another camera of the same model and image size."""
STATED = IntrinsicsPrior(focal=2e-3, centre=2e-3, k1=5e-3, k2=5e-3)
"""Intrinsics that the user states."""
UNKNOWN = IntrinsicsPrior(focal=0.3, centre=0.05, k1=0.1, k2=0.05)
"""Any camera; the image may be cropped."""
FREE = IntrinsicsPrior(focal=1.0, centre=0.3, k1=0.3, k2=0.3)
"""Wide enough to test the other priors."""
FOCAL_FACTORS = (0.58, 0.7, 0.84, 1.2, 1.44)
"""Focal lengths that are tried where nothing is known, relative to a guess, beside it."""


def zoomed(factor: float) -> Array:
    """(5,) change of the intrinsics to `factor` times the focal length."""
    return np.log(factor) * np.eye(INTRINSICS)[0]


def _log_density(change: Array, covariance: Array) -> float:
    squares = change @ np.linalg.solve(covariance, change)
    return float(-(squares + np.linalg.slogdet(covariance)[1]) / 2)


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """A pose, intrinsics and the residuals of the observations."""

    pose: UncertainPose
    """points_from_camera; the uncertainty of the intrinsics is part of its covariance."""
    observed: Observed
    """What the pose was refined by."""
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
    start: tuple[Array, Array],
    change: Array,
    prior: IntrinsicsPrior,
) -> RefinedPose:
    """Pose and intrinsics; the prior gives way where the image contradicts it.

    The start is rotation and position of points_from_camera. Other priors than the stated one are
    a linear step away, unless the image contradicts it.
    """
    tight = prior.variances(camera)
    free = FREE.variances(camera)
    own = minimise(observed, camera, start, _REFINE_STEPS, tight, change)
    cells = cells_of(observed.pixels, camera)
    step, _ = own.moved(own.against(free))
    moved = own.after(step)
    measured = _measured(moved, free, cells)
    doubt, variances = prior.decided(camera, own.change + step[6:], measured)
    rough = not _ROUGH < moved.variance / own.variance < 1 / _ROUGH
    if variances is not None or doubt > prior.other_camera or rough:
        start = own.rotation, own.position
        best = minimise(observed, camera, start, _REFINE_STEPS, free, own.change)
        if best.variance < moved.variance:
            measured = _measured(best, free, cells)
            doubt, variances = prior.decided(camera, best.change, measured)
        if variances is not None:
            start = best.rotation, best.position
            own = minimise(
                observed, camera, start, _REFINE_STEPS, variances, best.change
            )
    limits = tight if variances is None else variances
    covariance, lens = _covariances(own, limits, cells)
    if variances is None and doubt:
        # A covariance whose deviation reaches to the pose of another camera of the model.
        other = SAME_MODEL.variances(camera)
        off = (own.moved(own.against(other))[0] - own.moved(own.against(limits))[0])[:6]
        wider = _covariances(own, other, cells)[1] - lens + np.outer(off, off)
        more = min(1.0, doubt / _REACHED) * wider
        covariance = covariance + more
        lens = lens + more
    more = own.bent / own.variance * lens
    by_lens = in_parent_axes(own.rotation, lens + more)
    pose = own.pose(covariance + more)
    return RefinedPose(pose, observed, own.residual_px, own.camera, own.change, by_lens)


def _measured(minimum: Minimum, free: Array, cells: Array) -> Array:
    """(5, 5) covariance of intrinsics without a prior."""
    formal = minimum.covariance(minimum.against(free), cells)[6:, 6:]
    return (1 + minimum.bent / minimum.variance) * formal


def _covariances(
    minimum: Minimum, variances: Array, cells: Array
) -> tuple[Array, Array]:
    """(6, 6) covariance of a pose in camera axes, and the share of the intrinsics in it."""
    whole = minimum.covariance(minimum.against(variances), cells)[:6, :6]
    values, axes = np.linalg.eigh(whole - minimum.covariance(np.zeros(0), cells))
    return whole, (axes * np.maximum(values, 0)) @ axes.T


def cameras_in_scenes(
    camera: Camera | None, image: np.ndarray, scenes: "Sequence[LearnedScene]"
) -> list[Camera]:
    """Intrinsics of an image in each scene; a guess where none are given and no aspect ratio fits.

    The recording's intrinsics are replaced by the adjusted ones.
    """
    height, width = image.shape[:2]
    if camera is not None and not camera.fits(width, height):
        raise InputError(
            f"camera {camera.width}x{camera.height} does not fit the image {width}x{height}:"
            " give intrinsics of the same aspect ratio"
        )
    return [
        _own(scene.adjusted_camera, width, height)
        if camera is None or _is_own(camera, scene)
        else camera.resized(width, height)
        for scene in scenes
    ]


def _own(recorded: Camera, width: int, height: int) -> Camera:
    if recorded.fits(width, height):
        return recorded.resized(width, height)
    scale = max(width, height) / max(recorded.width, recorded.height)
    middle = (width - 1) / 2, (height - 1) / 2
    return Camera(width, height, scale * recorded.fx, scale * recorded.fy, *middle)


def _is_own(camera: Camera, scene: "LearnedScene") -> bool:
    return camera in (scene.camera, scene.adjusted_camera)


def prior_of(
    camera: Camera | None, image: np.ndarray, scene: "LearnedScene"
) -> IntrinsicsPrior:
    """Prior of the intrinsics of an image: stated, the recording's, or unknown."""
    if camera is not None:
        return OWN if _is_own(camera, scene) else STATED
    recorded = scene.camera
    height, width = image.shape[:2]
    if (width, height) == (recorded.width, recorded.height):
        return NOT_STATED
    larger = max(width, recorded.width)
    smaller = min(width, recorded.width)
    whole = larger % smaller == 0 and recorded.width * height == recorded.height * width
    # An image of half the size is probably resized; other sizes may be cropped.
    return STATED if whole else UNKNOWN
