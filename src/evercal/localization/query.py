"""What travels through localization: options, the image, scenes to try and the poses found."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from evercal.features.views import working_image
from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.localization.alignment import AlignmentOptions
from evercal.localization.pnp import PnpOptions
from evercal.mapping.patches import image_pyramid

FULL_SUPPORT = 4.0
"""From here on the residuals alone tell the covariance (docs/experiments/map.md)."""


@dataclass(frozen=True)
class Attempt:
    """How much work an image gets."""

    retrieved: int
    """Keyframes that the global descriptor proposes."""
    match_stride: int
    """Every so many-th row and column of patches is matched to the keyframes."""


@dataclass(frozen=True)
class LocalizeOptions:
    """How an image is located."""

    candidates: int = 3
    """At most this many scenes are tried for an image."""
    attempts: tuple[Attempt, ...] = (Attempt(12, 2), Attempt(48, 1), Attempt(200, 1))
    """Where no pose is accepted, the next attempt follows."""
    sure: float = 2.0
    """After the first attempt a pose is taken at once where its support is so many times what is
    needed; else the second attempt follows, and the better pose is taken."""
    clear: float = 1.5
    """Poses with less support are looked for again by guided matching: alignment may have settled
    beside the true pose, so patches are matched only to points that they would show near
    themselves from the pose found so far; PnP and alignment follow,"""
    gain: float = 1.1
    """as long as the support rises by this factor."""
    guided_px: float = 32.0
    """How near: pixels at the encoder's working size."""
    keyframes: int = 6
    """Keyframes of a scene that an image is matched to and aligned with."""
    retrieval_stride: int = 16
    """Every so many-th patch of the image votes for the proposed keyframes."""
    votes: float = 0.2
    """Scenes with a smaller share of the best scene's votes are not tried."""
    margin: float = 0.15
    """Without keyframes: scenes whose best prototype is less similar than the best scene's by more
    are not tried."""
    pnp: PnpOptions = field(default_factory=PnpOptions)
    """RANSAC settings of the first pose."""
    align: bool = True
    """Refine the first pose by the landmarks of the map; else it is the answer."""
    alignment: AlignmentOptions = field(default_factory=AlignmentOptions)
    """How landmarks are looked for."""
    patches_short_side: int = 480
    """Landmarks are looked for in the image at this short side at most, pixels."""
    loaded_keyframes: int = 256
    """Keyframes that stay decoded in memory."""


@dataclass(frozen=True, eq=False)
class Query:
    """An image on its way."""

    image: np.ndarray
    """(h, w, 3) or (h, w) uint8."""
    features: Tensor
    """(channels, rows, columns) on the encoder's device."""
    short_side: int
    """Of `grey` at most, pixels."""

    @cached_property
    def grey(self) -> np.ndarray:
        """The image that landmarks are looked for in."""
        height, width = self.image.shape[:2]
        plain = Camera(width, height, 1, 1, 0, 0)
        return working_image(self.image, plain, min(self.short_side, height, width))[0]

    @cached_property
    def pyramid(self) -> list[np.ndarray]:
        """Its image pyramid."""
        return image_pyramid(self.grey, 2)


@dataclass(frozen=True)
class Candidate:
    """A scene to try, with its keyframes that look like the image, best first."""

    scene: int
    keyframes: NDArray[np.int64]
    match_stride: int = 1


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A pose for one image under the assumption that it shows one scene."""

    scene: int
    pose: SE3 | None = None
    """base_from_camera, as the map has it."""
    covariance: np.ndarray | None = None
    inliers: int = 0
    ratio: float = 0.0
    pixels: np.ndarray | None = None
    points_m: np.ndarray | None = None
    aligned: bool = False
    matched: int = 0
    planned: int = 0

    @property
    def support(self) -> float:
        """What the scene's threshold is compared with, see `localization.acceptance`."""
        if not self.aligned:
            return self.ratio * self.inliers**0.5
        exact = self.inliers / max(1, self.matched)
        return self.ratio * exact**2 * (self.ratio * self.planned) ** 0.5

    @property
    def doubt(self) -> float:
        """Factor on the covariance of an aligned pose.

        The fewer landmarks support it, the more their errors go together: they lie on few surfaces,
        seen from afar.
        """
        return max(1.0, FULL_SUPPORT / self.support) if self.aligned and self.inliers else 1.0
