"""Retrieval in a map of many scenes: the right scene, milliseconds and bytes.

Scenes are box rooms with 50 keyframes each. Queries are images between the keyframes of the first
rooms, and test images of the packaged rooms among all of them.
"""

from pathlib import Path

import numpy as np
from tqdm import tqdm

from evercal.features.encoder import Encoder, load_encoder
from evercal.simulation.box_room import BoxRoom, default_camera

FIRST_SEED = 30_000
KEYFRAMES, QUERIES, QUERIED = 50, 5, 100
"""Keyframes of a scene; queries of each of the first scenes."""
TEXTURE_PX = 192
SIDE = 240
AT_ONCE = 25
"""Scenes in a file."""


def descriptors(out: Path, scenes: int) -> list[Path]:
    """Draw rooms and describe their keyframes; complete files are not repeated."""
    encoder, files = load_encoder(), []
    for first in tqdm(range(0, scenes, AT_ONCE), unit="file"):
        file = out / f"rooms-{first:06d}.npz"
        files.append(file)
        if not file.exists():
            drawn = [_room(encoder, first + i) for i in range(AT_ONCE)]
            out.mkdir(parents=True, exist_ok=True)
            part = file.with_suffix(".part.npz")
            keys, queries = zip(*drawn, strict=True)
            np.savez(part, keyframes=np.stack(keys), queries=np.stack(queries))
            part.rename(file)
    return files


def _room(encoder: Encoder, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Descriptors (50, width) of the keyframes of a room, and (0 or 5, width) of queries."""
    room, camera = BoxRoom(FIRST_SEED + number, texture_px=TEXTURE_PX), default_camera()
    path, vlad = room.path(2 * KEYFRAMES, number), encoder.vlad()
    queries = QUERIES if number < QUERIED else 0
    numbers = [*range(0, 2 * KEYFRAMES, 2), *range(1, 2 * KEYFRAMES, 2 * KEYFRAMES // QUERIES)]
    vectors = []
    for i in numbers[: KEYFRAMES + queries]:
        image = room.render(camera, path[i])
        vectors.append(vlad(encoder.encode(image, SIDE).reshape(-1, encoder.width)))
    both = np.array(vectors, np.float16)
    return both[:KEYFRAMES], both[KEYFRAMES:]
