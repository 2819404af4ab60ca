"""Options of one stage (learning one scene), and its events."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from evercal.classes import frozen
from evercal.continual.networks.buffer import EncodePlan
from evercal.continual.networks.head import HeadOptions
from evercal.continual.networks.trainer import FitOptions, Progress
from evercal.errors import require_numbers
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

    def with_memory(self, memory: str | int) -> "StageOptions":
        """The same options with a memory budget such as `10%` or `5MB`."""
        return replace(self, memory=MemoryBudget.parse(memory))


@dataclass
class Encoding:
    """Images are being encoded."""

    done: int
    """Encoded views."""
    total: int
    """Views of all frames."""


OnEvent = Callable[[Encoding | Progress], object]
"""Observer of a stage, for progress bars."""


def unobserved(event: Encoding | Progress) -> None:
    """Ignore an event."""
