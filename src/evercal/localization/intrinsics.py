"""Priors on the intrinsics of a query image.

A stated focal length is a prior and not a fact. The landmarks of an image measure the intrinsics
together with the pose, to a thousandth. Where they contradict the prior, the prior gives way.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from evercal.errors import InputError
from evercal.geometry import SE3, Camera, UncertainPose
from evercal.localization.pose_refinement import (
    MeasuredIntrinsics,
    Observed,
    RefinedPose,
    refine_pose,
)
from evercal.mapping.scene_map import SHARED_PX

if TYPE_CHECKING:
    from evercal.localization.learned import LearnedScene

Array = NDArray[np.floating]

CONTRADICTED = 15.1
"""Squared deviation of all five, above which no prior holds: the 99 % quantile (chi-squared)."""
DOUBT = 3.0
"""Squared deviations from the prior, in standard deviations, from which it gives way."""

_REFINE_STEPS = 10
"""Gauss-Newton steps of pose and intrinsics, at most."""
_REACHED = 0.05 * 7.815
"""Probability of another camera at which the 95 % ellipsoid (chi-squared) reaches its pose."""


@dataclass(frozen=True)
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
        """(5,) variances of a change of intrinsics, see `pose_refinement.changed_camera`."""
        centre = self.centre * max(camera.width, camera.height)
        return np.square([self.focal, centre, centre, self.k1, self.k2])


OWN = IntrinsicsPrior(focal=2e-4, centre=3e-4, k1=1e-3, k2=1e-3, other_camera=0.01)
"""The camera that recorded the scene: its error is in the landmarks, too, and cancels."""
NOT_STATED = replace(OWN, other_camera=0.3)
"""No camera is stated, and the image has the size of the recording."""
SAME_MODEL = IntrinsicsPrior(focal=0.007, centre=0.007, k1=0.01, k2=0.01)
"""Another camera of the same model and image size."""
STATED = IntrinsicsPrior(focal=2e-3, centre=2e-3, k1=5e-3, k2=5e-3)
"""Intrinsics that the user states."""
UNKNOWN = IntrinsicsPrior(focal=0.3, centre=0.05, k1=0.1, k2=0.05)
"""Any camera; the image may be cropped."""
FREE = IntrinsicsPrior(focal=1.0, centre=0.3, k1=0.3, k2=0.3)
"""Wide enough to test the other priors."""
FOCAL_FACTORS = (0.7, 0.84, 1.0, 1.2, 1.44)
"""Focal lengths that are tried where nothing is known, relative to a guess."""


@dataclass(frozen=True)
class Prior:
    """The prior of one image."""

    sigma: IntrinsicsPrior = NOT_STATED
    scale: float = 1.0
    """Factor on the covariance of landmarks."""
    shared_px: float = SHARED_PX
    """See `SceneMap.shared_px`."""

    def free(self, camera: Camera) -> Array:
        """(5,) variances that hardly bind."""
        return FREE.variances(camera) / self.scale

    def tight(self, camera: Camera) -> Array:
        """(5,) variances of the prior itself."""
        return self.sigma.variances(camera) / self.scale

    def tested(self, camera: Camera, change: Array, covariance: Array) -> Array:
        """(5,) variances: those of the prior, wider where an estimate contradicts it.

        The change (5,) and its covariance (5, 5) were estimated without a prior. Before a flat
        scene no parameter contradicts the prior alone, but all together may.
        """
        tight, measured = self.sigma.variances(camera), self.scale * covariance
        excess = change**2 - DOUBT * (np.diag(measured) + tight)
        variances = tight + np.maximum(excess, 0)
        squares = change @ np.linalg.solve(measured + np.diag(variances), change)
        return self.free(camera) if squares > CONTRADICTED else variances / self.scale

    def other_camera(self, camera: Camera, change: Array, covariance: Array) -> float:
        """Probability that an image is of another camera of the model, by estimated intrinsics.

        See `tested`. Each hypothesis is a Gaussian about the intrinsics of the recording.
        """
        own, other = (
            _log_density(change, self.scale * covariance + np.diag(sigma.variances(camera)))
            for sigma in (self.sigma, SAME_MODEL)
        )
        return float(expit(logit(self.sigma.other_camera) + other - own))


def _log_density(change: Array, covariance: Array) -> float:
    squares = change @ np.linalg.solve(covariance, change)
    return float(-(squares + np.linalg.slogdet(covariance)[1]) / 2)


def self_calibrated(
    observed: Observed, camera: Camera, pose: SE3, change: Array, prior: Prior
) -> RefinedPose:
    """Pose and intrinsics; the prior gives way where the image contradicts it."""
    free = refine_pose(observed, camera, pose, _REFINE_STEPS, prior.free(camera), change)
    # Errors that neighbouring landmarks share do not average out.
    by_shared = float((observed.whitening**2).sum()) / (2 * free.variance)
    shared = 1 + prior.shared_px**2 * by_shared
    prior = replace(prior, scale=shared * prior.scale)
    if prior.sigma.other_camera:
        refined = _own_or_other(observed, camera, pose, free, prior)
    else:
        refined = _contradictable(observed, camera, free, prior)
    squares = free.change @ np.linalg.solve(free.change_covariance, free.change)
    wider = refined.pose.covariance + (shared - 1) * refined.by_intrinsics
    return replace(
        refined,
        pose=UncertainPose(refined.pose.pose, wider),
        by_intrinsics=shared * refined.by_intrinsics,
        measured=MeasuredIntrinsics(float(squares), by_shared),
    )


def _contradictable(
    observed: Observed, camera: Camera, free: RefinedPose, prior: Prior
) -> RefinedPose:
    variances = prior.tested(camera, free.change, free.change_covariance)
    return refine_pose(observed, camera, free.pose.pose, _REFINE_STEPS, variances, free.change)


def _own_or_other(
    observed: Observed, camera: Camera, pose: SE3, free: RefinedPose, prior: Prior
) -> RefinedPose:
    """Pose for the recording's camera, or any; a less probable one widens it, see `_REACHED`."""
    doubt = prior.other_camera(camera, free.change, free.change_covariance)
    if doubt > 0.5:
        return _contradictable(observed, camera, free, replace(prior, sigma=UNKNOWN))
    own = refine_pose(observed, camera, pose, _REFINE_STEPS, prior.tight(camera))
    other = _contradictable(observed, camera, free, replace(prior, sigma=SAME_MODEL))
    # A covariance whose deviation reaches from one pose to the other. Covariances are scaled by the
    # caller, distances are not.
    turn = (own.pose.pose.inverse() @ other.pose.pose).log()[3:]
    off = np.r_[other.pose.pose.translation_m - own.pose.pose.translation_m, turn]
    apart = np.outer(off, off) / prior.scale
    more = min(1.0, doubt / _REACHED) * (other.by_intrinsics - own.by_intrinsics + apart)
    return replace(
        own,
        pose=UncertainPose(own.pose.pose, own.pose.covariance + more),
        by_intrinsics=own.by_intrinsics + more,
    )


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


def prior_of(camera: Camera | None, image: np.ndarray, scene: "LearnedScene") -> IntrinsicsPrior:
    """Prior of the intrinsics of an image: stated, the recording's, or unknown."""
    if camera is not None:
        return OWN if _is_own(camera, scene) else STATED
    recorded = scene.camera
    height, width = image.shape[:2]
    if (width, height) == (recorded.width, recorded.height):
        return NOT_STATED
    larger, smaller = max(width, recorded.width), min(width, recorded.width)
    whole = larger % smaller == 0 and recorded.width * height == recorded.height * width
    # An image of half the size is probably resized; other sizes may be cropped.
    return STATED if whole else UNKNOWN
