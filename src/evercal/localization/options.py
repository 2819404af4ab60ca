"""Options of localization."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, get_args

from evercal.errors import InputError, require_numbers
from evercal.localization.alignment import AlignmentOptions
from evercal.localization.pnp import PnpOptions

When = Literal["always", "many inliers", "few inliers"]


class Attempt(NamedTuple):
    """Effort of one attempt to locate an image."""

    retrieved: int
    """Keyframes that the global descriptor proposes."""
    stride: int
    """Every n-th row and column of patches is matched."""
    scale: float = 1.0
    """Scale of the encoded image, relative to the encoder's working size."""
    tolerance: float = 1.0
    """Factor on the threshold of RANSAC: from nearby, a patch of a keyframe covers several."""
    when: When = "always"
    """After earlier attempts with few or many PnP inliers, see `LocalizeOptions.aligned_inliers`.
    The first attempt always runs."""


@dataclass(frozen=True)
class LocalizeOptions:
    """How an image is located."""

    candidates: int = 2
    """Maximum number of scenes that are tried per image."""
    attempts: tuple[Attempt, ...] = (
        Attempt(12, 4),
        Attempt(12, 2),
        Attempt(48, 1, tolerance=2.5, when="many inliers"),
        Attempt(12, 3, 1.6, when="few inliers"),
    )
    """Attempts in order, until a pose is final. An image with few inliers is magnified: the scene
    may be farther away than in the keyframes."""
    middle_px: int = 144
    """Side of the central crop by which a rotated image is detected, pixels at working size."""
    clear_turn: float = 0.015
    """Minimum gain in similarity of a rotated image. Occlusion causes smaller ones."""
    aligned_inliers: int = 12
    """Number of PnP inliers that are many; with fewer, other orientations and sizes are tried."""
    immediate: float = 3.0
    """A pose with this many times the required support is final. Others are aligned again to the
    keyframes that see most of their view."""
    reselect_gain: float = 1.1
    """Reselection of keyframes repeats while the support grows by this factor."""
    rival_px: float = 16.0
    """A second pose is sought among matches with a larger reprojection error, pixels."""
    climbs: int = 5
    """Maximum number of moves to a better rival."""
    clear_strength: float = 0.8
    """An image is ambiguous if a rival is at least this strong, see `rivals._strength`."""
    keyframes: int = 6
    """Keyframes of a scene that an image is matched and aligned to."""
    retrieval_stride: int = 4
    """Patches of every n-th row and column vote for the proposed keyframes."""
    votes: float = 0.5
    """Scenes with a smaller share of the best scene's votes are not tried."""
    pnp: PnpOptions = field(
        default_factory=lambda: PnpOptions(progressive_sampling=True)
    )
    """RANSAC settings of the first pose."""
    align: bool = True
    """Whether the first pose is refined by alignment of landmarks."""
    alignment: AlignmentOptions = field(default_factory=AlignmentOptions)
    """Alignment of landmarks."""
    patches_short_side: int = 480
    """Maximum short side of the image that landmarks are aligned in, pixels."""
    loaded_keyframes: int = 256
    """Keyframes that stay decoded in memory."""

    def __post_init__(self) -> None:
        counts = ("candidates", "keyframes", "retrieval_stride", "loaded_keyframes")
        require_numbers(self, counts, 1)
        require_numbers(self, ("middle_px", "patches_short_side"), 16)
        require_numbers(self, ("immediate", "reselect_gain"), 1)
        require_numbers(self, ("aligned_inliers", "rival_px", "climbs"), 0)
        require_numbers(self, ("clear_turn", "clear_strength", "votes"), 0, 1)
        _require_attempts(self.attempts)


def _require_attempts(attempts: Sequence[Attempt]) -> None:
    if not attempts:
        raise InputError("LocalizeOptions.attempts is empty; it has one or more")
    for attempt in attempts:
        require_numbers(attempt, ("retrieved", "stride"), 1)
        require_numbers(attempt, ("scale", "tolerance"), 0.1, 10)
        if attempt.when not in get_args(When):
            allowed = ", ".join(get_args(When))
            raise InputError(
                f"Attempt.when is {attempt.when!r}; it is one of {allowed}"
            )
