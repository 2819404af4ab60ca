"""Options of one stage (learning one scene), and its events."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from evercal.classes import frozen
from evercal.continual.networks.buffer import EncodePlan
from evercal.continual.networks.head import HeadOptions
from evercal.continual.networks.trainer import FitOptions, Progress
from evercal.errors import InputError, require_numbers
from evercal.mapping.memory_budget import MemoryBudget
from evercal.typing import Triple


@frozen
class StageOptions:
    """Options of one stage."""

    head: HeadOptions = field(default_factory=HeadOptions)
    """Shape of a new head; later stages keep it."""
    fit: FitOptions = field(default_factory=FitOptions)
    """Training of the head."""
    encode: EncodePlan = field(default_factory=EncodePlan)
    """Views of the new scene's frames."""
    replay_views_per_frame: int = 4
    """Views of every remembered frame."""
    memory: MemoryBudget = field(default_factory=MemoryBudget)
    """Keyframes of a scene (N_b); what a method keeps beside them is not counted."""
    fixed_centres_m: tuple[Triple, ...] = ()
    """Atlas coordinates of all centres, for HeadOptions.centres `fixed`."""
    grid_scenes: int = 0
    """Scenes of the paper's layout, see `Atlas`; 0 gives each scene the next free cell."""
    seed: int = 0
    """Seed of weights, rows and selected keyframes."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        require_numbers(self, ("replay_views_per_frame",), 1)
        require_numbers(self, ("grid_scenes",), 0)
        if self.memory.auto:
            raise InputError(
                "memory auto: only a map selects its keyframes; give a share or bytes"
            )

    def with_memory(self, memory: str | None) -> "StageOptions":
        """The same options with a memory budget, see `MemoryBudget.parse`."""
        return replace(self, memory=MemoryBudget.parse(memory))


@dataclass
class Part:
    """Work of a stage beside its training."""

    name: str
    """What is done: depths of frames, encoding of views, or locating test images."""
    done: int
    """Frames, views or images that are done."""
    total: int
    """All of them."""


OnEvent = Callable[[Part | Progress], object]
"""Observer of a stage, for progress bars."""


class Watched:
    """Observes a training for another observer, and keeps its last step."""

    last: Progress

    def __init__(self, on_event: OnEvent):
        self._on_event = on_event

    def __call__(self, event: Part | Progress) -> None:
        """Keep a step, and pass the event on."""
        if isinstance(event, Progress):
            self.last = event
        self._on_event(event)


def unobserved(event: Part | Progress) -> None:
    """Ignore an event."""
