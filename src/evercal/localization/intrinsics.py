"""Priors on the intrinsics of a query image.

A stated focal length is a prior and not a fact. The landmarks of an image measure the intrinsics
together with the pose, to a thousandth. Where they contradict the prior, the prior gives way.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, Protocol

import numpy as np

from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.typing import Array, Image, Triple

Kind = Literal["own", "not stated", "same model", "stated", "unknown", "free"]

INTRINSICS = 5
"""Parameters of a change: logarithm of the focal lengths, principal point in pixels, k1, k2."""
CONTRADICTED = 15.1
"""Squared Mahalanobis distance of all five, above which no prior holds: 99 % of chi-squared."""
SURE = 0.6
"""Probability of another camera above which the image is taken to be of one."""
DOUBT = 3.0
"""Squared deviation, in variances, above which the prior is widened."""


@frozen_arrays
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
    kind: Kind = "stated"
    """What is known about the camera."""
    scatter: Triple = (0.0, 0.0, 0.0)
    """How far intrinsics move from image to image, see `SceneMap.intrinsics_sigma`."""

    def variances(self, camera: Camera) -> Array:
        """(5,) variances of a change of intrinsics, see `Camera.changed`."""
        centre = self.centre * max(camera.size)
        return np.square([self.focal, centre, centre, self.k1, self.k2])

    def scattered(self, camera: Camera) -> Array:
        """(5,) variances of intrinsics from image to image."""
        focal, share, distortion = self.scatter
        centre = share * max(camera.size)
        return np.square([focal, centre, centre, distortion, distortion])

    def tested(self, camera: Camera, change: Array, measured: Array) -> Array:
        """(5,) variances: those of the prior, wider where an estimate contradicts it.

        The change (5,) and its covariance (5, 5) were estimated without a prior. Before a flat
        scene no parameter contradicts the prior alone, but all together may.
        """
        tight = self.variances(camera)
        excess = change**2 - DOUBT * (np.diag(measured) + tight)
        variances = tight + np.maximum(excess, 0)
        squares = change @ np.linalg.solve(measured + np.diag(variances), change)
        if squares > CONTRADICTED:
            return FREE.variances(camera)
        return variances

    def doubt(self, camera: Camera, change: Array, measured: Array) -> float:
        """Probability that an image is of another camera of the model, by estimated intrinsics.

        See `tested`. Each hypothesis is a Gaussian about the intrinsics of the recording.
        """
        of_this = measured + np.diag(self.variances(camera))
        of_other = measured + np.diag(SAME_MODEL.variances(camera))
        log_ratio = _log_density(change, of_other) - _log_density(change, of_this)
        prior_odds = self.other_camera / (1 - self.other_camera)
        odds = prior_odds * math.exp(min(max(log_ratio, -700.0), 700.0))
        return odds / (1 + odds)

    def decided(
        self, camera: Camera, change: Array, measured: Array
    ) -> tuple[float, Array | None]:
        """Probability of another camera, and variances (5,) that an estimate asks for.

        The variances are None where the prior holds; the estimate is as for `tested`.
        """
        if not self.other_camera:
            variances = self.tested(camera, change, measured)
            if np.allclose(variances, self.variances(camera)):
                return 0.0, None
            return 0.0, variances
        doubt = self.doubt(camera, change, measured)
        if doubt <= SURE:
            return doubt, None
        return doubt, UNKNOWN.tested(camera, change, measured)


OWN = IntrinsicsPrior(
    focal=2e-4,
    centre=3e-4,
    k1=1e-3,
    k2=1e-3,
    other_camera=0.4,
    kind="own",
)
"""The camera that recorded the scene: its error is in the landmarks, too, and cancels. People also
state it for other cameras of the model, hence `other_camera`. Where an image shows no difference,
the covariance includes the pose of another camera."""
NOT_STATED = replace(OWN, kind="not stated")
"""No camera is stated, and the image has the size of the recording."""
CERTAINLY_OWN = replace(OWN, other_camera=1e-200)
"""The camera that recorded the scene, for frames of the recording."""
SAME_MODEL = IntrinsicsPrior(
    focal=0.007,
    centre=0.007,
    k1=0.01,
    k2=0.01,
    kind="same model",
)
"""Another camera of the same model and image size."""
STATED = IntrinsicsPrior(
    focal=2e-3,
    centre=2e-3,
    k1=5e-3,
    k2=5e-3,
    kind="stated",
)
"""Intrinsics that the user states."""
UNKNOWN = IntrinsicsPrior(
    focal=0.3,
    centre=0.05,
    k1=0.1,
    k2=0.05,
    kind="unknown",
)
"""Any camera; the image may be cropped."""
FREE = IntrinsicsPrior(
    focal=1.0,
    centre=0.3,
    k1=0.3,
    k2=0.3,
    kind="free",
)
"""Wide enough to test the other priors."""
FOCAL_FACTORS = (0.58, 0.7, 0.84, 1.2, 1.44)
"""Other focal lengths that are tried where none is known, relative to a first guess."""


def zoomed(factor: float) -> Array:
    """(5,) change of the intrinsics to `factor` times the focal length."""
    return np.log(factor) * np.eye(INTRINSICS)[0]


def _log_density(change: Array, covariance: Array) -> float:
    squares = change @ np.linalg.solve(covariance, change)
    return float(-(squares + np.linalg.slogdet(covariance)[1]) / 2)


class RecordedScene(Protocol):
    """A scene with the camera that recorded it."""

    @property
    def camera(self) -> Camera:
        """Intrinsics that its recording states."""
        ...

    @property
    def adjusted_camera(self) -> Camera:
        """The same camera after learning."""
        ...


class MovingScene(RecordedScene, Protocol):
    """A scene that states how far the intrinsics of its camera move."""

    @property
    def intrinsics_sigma(self) -> Triple:
        """From image to image, see `SceneMap.intrinsics_sigma`."""
        ...


def cameras_in_scenes(
    camera: Camera | None, image: Image, scenes: Sequence[RecordedScene]
) -> list[Camera]:
    """Intrinsics of an image in each scene; a guess where none are given and no aspect ratio fits.

    The recording's intrinsics are replaced by the adjusted ones.
    """
    height, width = image.shape[:2]
    if camera and not camera.fits(width, height):
        raise InputError(
            f"camera {camera.width}x{camera.height} does not fit the image {width}x{height}:"
            " give intrinsics of the same aspect ratio"
        )
    cameras = []
    for scene in scenes:
        if not camera or _is_own(camera, scene):
            cameras.append(_own(scene.adjusted_camera, width, height))
        else:
            cameras.append(camera.resized(width, height))
    return cameras


def _own(recorded: Camera, width: int, height: int) -> Camera:
    if recorded.fits(width, height):
        return recorded.resized(width, height)
    scale = max(width, height) / max(recorded.size)
    middle = (width - 1) / 2, (height - 1) / 2
    return Camera(width, height, scale * recorded.fx, scale * recorded.fy, *middle)


def _is_own(camera: Camera, scene: RecordedScene) -> bool:
    return camera in (scene.camera, scene.adjusted_camera)


def prior_of(
    camera: Camera | None, image: Image, scene: MovingScene
) -> IntrinsicsPrior:
    """Prior of the intrinsics of an image: stated, the recording's, or unknown."""
    prior = _stated_prior(camera, image, scene)
    return replace(prior, scatter=scene.intrinsics_sigma)


def _stated_prior(
    camera: Camera | None, image: Image, scene: RecordedScene
) -> IntrinsicsPrior:
    if camera:
        if _is_own(camera, scene):
            return OWN
        return STATED
    recorded = scene.camera
    height, width = image.shape[:2]
    if (width, height) == recorded.size:
        return NOT_STATED
    larger = max(width, recorded.width)
    smaller = min(width, recorded.width)
    whole = larger % smaller == 0 and recorded.width * height == recorded.height * width
    # An image of half the size is probably resized; other sizes may be cropped.
    if whole:
        return STATED
    return UNKNOWN
