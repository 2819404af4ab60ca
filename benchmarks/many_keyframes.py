"""Localization in a store with thousands of keyframes of other rooms.

The added keyframes are views of procedural box rooms with their images, features and descriptors.
Their depths are constant: retrieval, choice of scenes and memory do not depend on them, and a pose
in an added room is always wrong.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from tabulate import tabulate
from tqdm import tqdm

from benchmarks.accuracy import accuracy_row
from benchmarks.peak_memory import peak_gb
from evercal.errors import InputError
from evercal.evaluation import evaluate
from evercal.features.encode import encode_features
from evercal.features.views import ViewOptions, plain_view
from evercal.features.vlad import vlad_for
from evercal.geometry import SE3
from evercal.localization.localizer import Localizer
from evercal.mapping.keyframes import Keyframes, jpeg
from evercal.mapping.landmarks import Landmarks, detect
from evercal.mapping.map_frame import MapFrame
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.recordings import Recording, load_recording
from evercal.simulation.box_room import BoxRoom, default_camera

FIRST_SEED = 5_000
DEPTH_M = 2.0


def run(
    store: Path,
    scenes: tuple[Path, ...],
    keyframes: int = 10_000,
    rooms: int = 10,
    out: Path = Path("runs/many_keyframes.json"),
) -> None:
    """Localize test frames of a store's scenes among thousands of keyframes of other rooms.

    Args:
        store: Store with the scenes.
        scenes: Folders of the scenes, NAME=FOLDER if the store has another name.
        keyframes: Keyframes to add.
        rooms: Rooms to divide them over.
        out: File for row and settings, JSON; must not exist.
    """
    if not 0 < rooms <= keyframes:
        raise InputError(f"--rooms {rooms}: give 1 to {keyframes}, the number of keyframes")
    if out.exists():
        raise InputError(f"{out}: exists; remove it or give another --out")
    localizer = Localizer.open(store)
    recordings, maps = _recordings(scenes), localizer.contents
    for number in tqdm(range(rooms), "adding", unit="room"):
        add_room(maps, FIRST_SEED + number, keyframes // rooms)
    localizer = Localizer(maps)
    results = evaluate(localizer, {scene.name: scene for scene in recordings})
    row = accuracy_row(f"{len(recordings)} scenes", results)
    row |= {"keyframes": keyframes // rooms * rooms, "rooms": rooms}
    row["ms_90"] = float(np.percentile([result.milliseconds for result in results], 90))
    row["peak_gb"] = peak_gb(maps.device)
    print(tabulate(row.items(), floatfmt=".4g"))
    out.parent.mkdir(parents=True, exist_ok=True)
    settings = {"localize": asdict(localizer.options)}
    out.write_text(json.dumps({"rows": [row], "settings": settings}, indent=1))


def _recordings(folders: Sequence[Path]) -> list[Recording]:
    recordings = []
    for folder in folders:
        name, _, path = str(folder).rpartition("=")
        recordings.append(load_recording(path, name=name or None))
    return recordings


def add_room(maps: MapContents, seed: int, count: int) -> None:
    """Add a box room with `count` keyframes to maps."""
    room, camera = BoxRoom(seed, texture_px=192), default_camera(320, 240)
    rng, vlad = np.random.default_rng(seed), vlad_for(maps.encoder)
    images, poses, depths, landmarks, descriptors = [], [], [], [], []
    for _ in range(count):
        pose = room.random_view(rng)
        grey = room.render(camera, pose).mean(-1).astype(np.uint8)
        view = plain_view(grey, camera, maps.encoder.stride, ViewOptions())
        feature_map = encode_features([view], maps.encoder)[0]
        features = feature_map.flatten(1).T
        grid = (feature_map.shape[1], feature_map.shape[2])
        pixels, _ = detect(grey, grid, float(maps.encoder.stride))
        n = len(pixels)
        images.append(jpeg(grey))
        poses.append(pose)
        depths.append(torch.full((len(features),), 1 / DEPTH_M).half())
        landmarks.append(Landmarks(pixels, np.full(n, 0.5), np.zeros((n, 2)), np.full(n, 0.01)))
        descriptors.append(vlad(features))
    keyframes = Keyframes(
        tuple(images),
        (camera,) * count,
        SE3.stack(poses),
        tuple(depths),
        tuple(landmarks),
        torch.stack(descriptors).half(),
    )
    scene = SceneMap(f"added-{seed}", camera, camera, keyframes, MapFrame(), count)
    maps.scenes.append(replace(scene, min_support=maps.scenes[0].min_support))
