"""The three small rooms that come with the package; nothing is rendered to use them.

Made by `evercal simulate sim-mini --out src/evercal/simulation/sim_mini`.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evercal.datasets import Frame, Scene, load_scene
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.simulation.cell import SUITES
from evercal.simulation.furnished.materials import plain
from evercal.simulation.furnished.panda import HOME_RAD, Panda
from evercal.simulation.furnished.renderer import Renderer, RenderOptions
from evercal.simulation.furnished.rooms import room

FOLDER = Path(__file__).parent / "sim_mini"


@dataclass(frozen=True, eq=False)
class CellRoom:
    """A recorded robot cell."""

    scene: Scene
    """From a moving camera: frames to learn from and frames to be judged on."""
    fixed: Scene | None = None
    """From a camera that stands still while the arm moves; all frames are test frames."""
    model: tuple[str, int] | None = None
    """Kind and seed of the simulator's room that was recorded."""
    bumped: Scene | None = None
    """Like `fixed`, after a bump moved the camera a little; all frames are test frames."""
    changed: Scene | None = None
    """From a moving camera after small things were moved or taken away and lamps switched; all
    frames are test frames."""


def mini_rooms() -> tuple[CellRoom, ...]:
    """The bedroom, the kitchen and the living room, in this order."""
    return tuple(
        CellRoom(
            load_scene(FOLDER / name),
            load_scene(FOLDER / name / "calibration" / "fixed"),
            (kind, seed),
            load_scene(FOLDER / name / "calibration" / "bumped"),
            load_scene(FOLDER / name / "changed"),
        )
        for name, kind, seed in SUITES["sim-mini"].rooms
    )


def untextured_renders(
    model: tuple[str, int], frames: list[Frame], poses: list[SE3]
) -> list[np.ndarray]:
    """What the room's bare shapes look like to the cameras of `frames` at `poses`.

    Args:
        model: kind and seed of the room.
        frames: their cameras and joint angles are used.
        poses: base_from_camera, one for each frame.

    Returns:
        (H, W, 3) uint8 images; none at all where the extra `sim` is not installed.
    """
    try:
        panda = Panda()
        grey = plain("grey", (0.7, 0.7, 0.7))
        arms = [panda.meshes(np.array(f.joints_rad or HOME_RAD)) for f in frames]
        place = [(mesh, m if m.emission else grey) for mesh, m in room(*model).meshes()]
        renderer = Renderer(place + [(mesh, grey) for mesh, _ in arms[0]])
    except InputError:
        return []
    images = []
    for i, (frame, arm, pose) in enumerate(zip(frames, arms, poses, strict=True)):
        renderer.move({mesh.name: mesh for mesh, _ in arm})
        images.append(renderer.render(frame.camera, pose, RenderOptions(8), i))
    return images
