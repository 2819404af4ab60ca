"""The three small rooms that come with the package; nothing is rendered to use them.

Made by `evercal simulate sim-mini --out src/evercal/simulation/sim_mini`.
"""

from dataclasses import dataclass
from pathlib import Path

from evercal.datasets import Scene, load_scene

FOLDER = Path(__file__).parent / "sim_mini"
ROOMS = ("bedroom", "kitchen", "living")


@dataclass(frozen=True, eq=False)
class CellRoom:
    """A recorded robot cell."""

    scene: Scene
    """From a moving camera: frames to learn from and frames to be judged on."""
    fixed: Scene | None = None
    """From a camera that stands still while the arm moves; all frames are test frames."""


def mini_rooms() -> tuple[CellRoom, ...]:
    """The bedroom, the kitchen and the living room, in this order."""
    return tuple(
        CellRoom(load_scene(FOLDER / name), load_scene(FOLDER / name / "calibration" / "fixed"))
        for name in ROOMS
    )
