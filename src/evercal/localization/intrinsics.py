"""What is known of a camera's intrinsics before an image is located, and how far that is believed.

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
from evercal.geometry import Camera
from evercal.mapping.scene_map import SHARED_PX

if TYPE_CHECKING:
    from evercal.localization.learned import LearnedScene

Array = NDArray[np.floating]

CONTRADICTED = 15.1
"""Squared deviation of all five, above which no prior holds: the 99 % quantile (chi-squared)."""
DOUBT = 3.0
"""Squared deviations from the prior, in standard deviations, from which it gives way."""


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

        The change (5,) and its covariance (5, 5) were estimated without a prior. Each hypothesis
        is a Gaussian about the intrinsics of the recording.
        """
        own, other = (
            _log_density(change, self.scale * covariance + np.diag(sigma.variances(camera)))
            for sigma in (self.sigma, SAME_MODEL)
        )
        return float(expit(logit(self.sigma.other_camera) + other - own))


def _log_density(change: Array, covariance: Array) -> float:
    """Logarithm of a Gaussian density about zero, without its constant."""
    squares = change @ np.linalg.solve(covariance, change)
    return float(-(squares + np.linalg.slogdet(covariance)[1]) / 2)


def cameras_in_scenes(
    camera: Camera | None, image: np.ndarray, scenes: "Sequence[LearnedScene]"
) -> list[Camera]:
    """Intrinsics of an image in each scene; a guess where none are given and no aspect ratio fits.

    The recording's intrinsics are replaced by the adjusted ones.

    Raises:
        InputError: A camera with another aspect ratio than the image's.
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
    """The camera of a recording for an image of another size."""
    if recorded.fits(width, height):
        return recorded.resized(width, height)
    scale = max(width, height) / max(recorded.width, recorded.height)
    middle = (width - 1) / 2, (height - 1) / 2
    return Camera(width, height, scale * recorded.fx, scale * recorded.fy, *middle)


def _is_own(camera: Camera, scene: "LearnedScene") -> bool:
    """Whether a stated camera is that of a recording, as stated there or as adjusted."""
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
