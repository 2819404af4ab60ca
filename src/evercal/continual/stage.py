"""How one scene is learned, and what happens meanwhile."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from evercal.continual.networks.buffer import EncodePlan
from evercal.continual.networks.head import HeadOptions
from evercal.continual.networks.trainer import FitOptions, Progress
from evercal.mapping.build import MapOptions, Mapping, SceneMap
from evercal.mapping.keyframes import store_keyframes
from evercal.mapping.scene_maps import SceneMaps
from evercal.mapping.store import Checkpoint
from evercal.recordings.frame import Frame

SAMPLED_FRAMES = 8
"""Frames whose size as keyframes is measured, where memory is given in bytes."""


@dataclass(frozen=True)
class StageOptions:
    """How one scene is learned."""

    head: HeadOptions = field(default_factory=HeadOptions)
    """Shape of a new head; a later stage keeps the head it finds."""
    fit: FitOptions = field(default_factory=FitOptions)
    """Training."""
    encode: EncodePlan = field(default_factory=EncodePlan)
    """Views of the new scene's frames."""
    replay_views_per_frame: int = 4
    """Views of every remembered frame."""
    memory_share: float = 0.10
    """N_b as a share of the scene's training frames."""
    memory_auto: bool = False
    """Keep the fewest keyframes with which other frames are located well; maps only."""
    memory_bytes: int | None = None
    """Size of a scene's keyframes instead; what a method keeps beside them is not counted."""
    fixed_centres_m: tuple[tuple[float, float, float], ...] = ()
    """Atlas coordinates of all centres, known in advance (HeadOptions.centres `fixed`)."""
    grid_scenes: int = 0
    """Scenes of the combined grid (`Atlas` layout `paper`), if they are known in advance; 0 gives
    each the next free place."""
    map: MapOptions = field(default_factory=MapOptions)
    """Building of the map, where the strategy builds one."""
    seed: int = 0
    """Random seed."""

    def capacity(self, frames: Sequence[Frame], short_side: int) -> int:
        """N_b in frames, at least 1, for a scene of these training frames.

        Where memory is given in bytes, as many frames as fit by the images alone, from a sample.
        """
        if self.memory_bytes is None:
            return max(1, int(self.memory_share * len(frames) + 1e-9))
        sample = frames[:: -(-len(frames) // SAMPLED_FRAMES)]
        one = store_keyframes(sample, short_side).bytes / len(sample)
        return min(len(frames), max(1, int(self.memory_bytes / one)))


@dataclass
class Encoding:
    """The encoder is at work."""

    done: int
    """Views encoded."""
    total: int
    """Views to encode."""


@dataclass
class Stage:
    """A finished stage."""

    maps: SceneMaps
    """What is known now; thresholds are not fitted yet."""
    iterations: int
    """Optimiser steps."""
    frames_kept: int
    """Frames of this scene that stay in memory."""
    scene_map: SceneMap | None = None
    """The map that was built, if the strategy builds one."""


Event = Encoding | Mapping | Progress | Checkpoint | Stage
