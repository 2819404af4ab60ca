"""A rendered room that changes in rounds: a third of the small objects, lamps, light, furniture.

OUT/round-00 ... round-10       recordings: training frames of each round, and test frames
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from evercal.recordings import Frame, generic
from evercal.simulation.box_room import default_camera
from evercal.simulation.cell import write_jpeg
from evercal.simulation.cell_paths import sweep_shots
from evercal.simulation.changed_room import moved_item, rearranged, relit
from evercal.simulation.furnished.panda import Panda
from evercal.simulation.furnished.renderer import Renderer, RenderOptions
from evercal.simulation.furnished.rooms import Room, room

FURNITURE_ROUND = 5
MOVABLE = ("armchair", "floor lamp", "side table", "chair", "stool")
"""Furniture that moves in that round."""


def states(kind: str, seed: int, rounds: int) -> list[Room]:
    """Return the room before the first and after every round of change."""
    arranged = room(kind, seed)
    result = [arranged]
    for number in range(1, rounds + 1):
        arranged = rearranged(arranged, number)
        if number == FURNITURE_ROUND:
            arranged = _refurnished(arranged, number)
        result.append(relit(arranged, number))
    return result


def _refurnished(before: Room, seed: int) -> Room:
    """Move furniture that carries nothing; what has no other place is removed."""
    rng, items = np.random.default_rng(seed), list(before.items)
    for item in [i for i in before.items if i.kind in MOVABLE and not i.tops]:
        rest = [other for other in items if other is not item]
        moved = moved_item(item, before, rest, rng)
        items = rest if moved is None else [*rest, moved]
    return replace(before, items=items)


def render(
    out: Path = Path("runs/changing-room"),
    kind: str = "bedroom",
    seed: int = 3101,
    rounds: int = 10,
    first: int = 60,
    frames: int = 24,
    samples: int = 8,
) -> None:
    """Render the recordings; an interrupted run continues.

    Args:
        out: Folder of the recordings.
        kind: Kind of room.
        seed: Seed of the room.
        rounds: Rounds of change.
        first: Frames before the first change, 70 % of them for training.
        frames: Frames of each round, 70 % of them for training.
        samples: Light paths per pixel.
    """
    camera, panda, done = default_camera(320, 240), Panda(), []
    plans = [(state, sweep_shots(state, frames if i else first, 20 + i))
             for i, state in enumerate(states(kind, seed, rounds))]  # fmt: skip
    with tqdm(total=sum(len(shots) for _, shots in plans), unit="frame") as bar:
        for number, (state, shots) in enumerate(plans):
            root, renderer = out / f"round-{number:02d}", None
            light = float(np.random.default_rng([seed, number, 3]).uniform(-0.7, 0.7))
            options = RenderOptions(samples=samples, exposure_ev=light if number else 0.0)
            done = []
            for i, shot in enumerate(shots):
                file = root / f"images/{i:06d}.jpg"
                if not file.exists():
                    arm = panda.meshes(shot.joints_rad)
                    if renderer is None:
                        renderer = Renderer(state.meshes() + arm)
                    renderer.move({mesh.name: mesh for mesh, _ in arm})
                    origin = np.random.default_rng([seed, number, i])
                    noise = int(origin.integers(2**31))
                    image = renderer.render(camera, shot.base_from_camera, options, noise)
                    write_jpeg(file, image, 90)
                done.append((Frame(shot.name, file, camera, shot.base_from_camera), shot.split))
                bar.update()
            if not (root / generic.FILE).exists():
                with generic.SceneWriter(root, f"round-{number:02d}") as writer:
                    for frame, split in done:
                        writer.add(frame, split)
