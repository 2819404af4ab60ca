"""Options of localization, the prepared image, candidate scenes and pose hypotheses."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from evercal.features.views import working_grey
from evercal.geometry import SE3, Camera, UncertainPose
from evercal.localization.alignment import AlignmentOptions
from evercal.localization.intrinsics import IntrinsicsPrior, RefinedPose
from evercal.localization.pnp import PnpOptions
from evercal.mapping.patches import image_pyramid
from evercal.typing import Float32Array, IntArray


class Attempt(NamedTuple):
    """Effort of one attempt to locate an image."""

    retrieved: int
    """Keyframes that the global descriptor proposes."""
    stride: int
    """Matches every n-th row and column of patches."""
    scale: float = 1.0
    """Of the encoded image, relative to the encoder's working size."""


@dataclass(frozen=True)
class LocalizeOptions:
    """How an image is located."""

    candidates: int = 2
    """Scenes that are tried per image, at most."""
    attempts: tuple[Attempt, ...] = (
        Attempt(12, 4),
        Attempt(12, 2),
        Attempt(48, 1),
        Attempt(12, 3, 1.6),
    )
    """Until a pose is final. The third is for images with enough inliers after the second, the
    magnified one for the others: the scene may be farther away than in the keyframes."""
    middle_px: int = 144
    """Side of the middle of an image that its quarter turn is judged by, at working size."""
    clear_turn: float = 0.015
    """Gain in similarity of a turned image; less may be noise where something covers the middle."""
    aligned_inliers: int = 12
    """Poses with fewer PnP inliers are not aligned."""
    immediate: float = 4.0
    """A pose with this many times the required support is final. Others are aligned again to the
    keyframes that see most of their view."""
    reselect_gain: float = 1.1
    """Factor by which that must raise the support to be repeated."""
    rival_px: float = 16.0
    """A second pose is sought among matches that the first one misses by more than this, pixels."""
    climbs: int = 5
    """Poses whose rivals are tried, at most."""
    clear_strength: float = 0.8
    """Relative strength of a rival, see `Localizer`, from which the image is ambiguous."""
    keyframes: int = 6
    """Keyframes of a scene that an image is matched and aligned to."""
    retrieval_stride: int = 4
    """Patches of every n-th row and column vote for the proposed keyframes."""
    votes: float = 0.5
    """Scenes with a smaller share of the best scene's votes are not tried."""
    pnp: PnpOptions = field(default_factory=lambda: PnpOptions(ranked=True))
    """RANSAC settings of the first pose."""
    align: bool = True
    """Refine the first pose by alignment of landmarks. False returns the PnP pose."""
    alignment: AlignmentOptions = field(default_factory=AlignmentOptions)
    """Alignment of landmarks."""
    patches_short_side: int = 480
    """Short side of the image that landmarks are aligned in, pixels, at most."""
    loaded_keyframes: int = 256
    """Keyframes that stay decoded in memory."""


@dataclass(frozen=True, eq=False)
class Query:
    """An image to be located."""

    image: np.ndarray
    """(h, w, 3) or (h, w) uint8."""
    features: Float32Array
    """(rows, columns, channels)."""
    short_side: int
    """Short side of `grey`, pixels, at most."""
    priors: Sequence[IntrinsicsPrior] = ()
    """Of the intrinsics in each scene."""
    similar: dict[tuple[int, int], tuple[IntArray, Float32Array]] = field(
        default_factory=dict
    )
    """Most similar cells of keyframes, see `Matcher`."""
    descriptor: list[Float32Array] = field(default_factory=list)
    """Similarity (keyframes,) of the whole image, once it is known."""
    scale: float = 1.0
    """Of the encoded image, relative to the encoder's working size."""
    turns: int = 0
    """Quarter turns clockwise of the image before it was encoded."""

    @cached_property
    def grey(self) -> np.ndarray:
        """The image that landmarks are aligned in."""
        return working_grey(self.image, min(self.short_side, *self.image.shape[:2]))

    @cached_property
    def pyramid(self) -> list[np.ndarray]:
        """Its image pyramid."""
        return image_pyramid(self.grey, 2)


class Candidate(NamedTuple):
    """A scene to try."""

    scene: int
    keyframes: IntArray
    """Its keyframes in the bank, most similar first."""
    stride: int = 1
    """Matches every n-th row and column of patches."""


class Matches(NamedTuple):
    """2D-3D matches of an image in one scene."""

    pixels: np.ndarray
    """(m, 2) in the ideal pinhole, at the encoder's working size."""
    points_m: np.ndarray
    """(m, 3) in the scene's frame."""

    def beside(self, camera: Camera, pose: SE3, px: float) -> "Matches":
        """Matches farther than `px` from where a pose map_from_camera projects their points."""
        projected = camera.pinhole.project(pose.inverse().apply(self.points_m))
        off = np.linalg.norm(projected - self.pixels, axis=1)
        rest = ~(off < px)  # points behind the camera have no projection
        return Matches(self.pixels[rest], self.points_m[rest])


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A pose of the image, assuming that it shows one scene."""

    scene: int
    pose: UncertainPose | None = None
    """map_from_camera; None where PnP failed."""
    refined: RefinedPose | None = None
    """Pose and intrinsics at the size of `Query.grey`; None where alignment failed."""
    pixels: np.ndarray | None = None
    """(n, 2) inliers, pixels at the encoder's working size."""
    points_m: np.ndarray | None = None
    """(n, 3) their landmarks in the map's frame."""
    expected: int = 0
    """Landmarks that should be visible and were searched."""
    matched: int = 0
    """Landmarks whose patch was found near the expected position."""
    pnp_inliers: int = 0
    """Matches that agree with the pose before alignment."""
    candidate: Candidate | None = None
    """Keyframes that it was found with; None where alignment failed."""
    matches: Matches | None = None
    """All matches; None where alignment failed."""

    @property
    def inliers(self) -> int:
        """Landmarks that agree with the pose."""
        return 0 if self.pixels is None else len(self.pixels)

    @property
    def inlier_ratio(self) -> float:
        """Inliers as a share of the landmarks that should be visible."""
        return self.inliers / max(self.expected, 1)
