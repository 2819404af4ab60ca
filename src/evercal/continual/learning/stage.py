"""Options of one stage (learning one scene), and its events."""

from dataclasses import dataclass, field, replace

from evercal.continual.networks.buffer import EncodePlan
from evercal.continual.networks.head import HeadOptions
from evercal.continual.networks.trainer import FitOptions, Progress
from evercal.continual.scenes import LearnedScenes
from evercal.continual.store import Checkpoint
from evercal.mapping.build import BuiltMap, MapOptions
from evercal.mapping.memory_budget import MemoryBudget


@dataclass(frozen=True)
class StageOptions:
    """Options of one stage."""

    head: HeadOptions = field(default_factory=HeadOptions)
    """Shape of a new head; later stages keep it."""
    fit: FitOptions = field(default_factory=FitOptions)
    """Training."""
    encode: EncodePlan = field(default_factory=EncodePlan)
    """Views of the new scene's frames."""
    replay_views_per_frame: int = 4
    """Views of every remembered frame."""
    memory: MemoryBudget = field(default_factory=MemoryBudget)
    """Keyframes of a scene (N_b); what a method keeps beside them is not counted."""
    fixed_centres_m: tuple[tuple[float, float, float], ...] = ()
    """Atlas coordinates of all centres, for HeadOptions.centres `fixed`."""
    grid_scenes: int = 0
    """Scenes of the combined grid (`Atlas` layout `paper`); 0 gives each scene the next free
    cell."""
    map: MapOptions = field(default_factory=MapOptions)
    """Options of the map, for strategies that build one."""
    seed: int = 0
    """Random seed."""

    def with_memory(self, memory: str | int) -> "StageOptions":
        """The same options with a memory budget such as `10%` or `5MB`."""
        return replace(self, memory=MemoryBudget.parse(memory))

    def map_options(self, short_side: int) -> MapOptions:
        """Options of the map at the working size of a store."""
        size = replace(self.map.size, cells=short_side)
        return replace(self.map, memory=self.memory, size=size)


@dataclass
class Encoding:
    """Images are being encoded."""

    done: int
    """Views encoded."""
    total: int
    """Views to encode."""


@dataclass
class Stage:
    """A finished stage."""

    scenes: LearnedScenes
    """Everything learned so far; thresholds are not fitted yet."""
    iterations: int
    """Optimiser steps."""
    frames_kept: int
    """Keyframes of this scene."""
    built: BuiltMap | None = None
    """The map of the scene, for strategies that build one."""


Event = Encoding | Progress | Checkpoint | Stage
