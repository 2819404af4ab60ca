"""A store among thousands of keyframes of other places: is the right scene still tried, and when?

The crowd are views of procedural box rooms with their real images, features and descriptors. Their
depths are made up: what is measured is retrieval, the choice of scenes and memory, none of which
looks at a depth; poses of crowd scenes are never right, so they can only do harm.
"""

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from tabulate import tabulate
from tqdm import tqdm

from benchmarks.peak_memory import peak_gb
from evercal.errors import InputError
from evercal.evaluation.metrics import FINE
from evercal.features.encode import encode_features
from evercal.features.views import ViewOptions, plain_view
from evercal.features.vlad import vlad_for
from evercal.geometry import SE3, pose_distance
from evercal.localization.localizer import Localizer
from evercal.localization.matching import Matcher
from evercal.localization.query import Query
from evercal.mapping.keyframes import Keyframes, jpeg
from evercal.mapping.landmarks import Landmarks, detect
from evercal.mapping.scene_maps import SceneMaps, SceneRecord
from evercal.recordings import Frame, load_recording, posed_frames
from evercal.simulation.box_room import BoxRoom, default_camera

FIRST_SEED = 5_000
DEPTH_M = 2.0


def run(store: Path, scenes: Sequence[Path], keyframes: int, rooms: int, out: Path) -> None:
    """Prints what locating the scenes' test frames takes in the crowd, and writes it as a row.

    Args:
        store: that knows the scenes.
        scenes: folders of recorded scenes of the store, NAME=FOLDER where it has another name.
        keyframes: of the crowd.
        rooms: that they are shared out over.
        out: the row and the settings, JSON.

    Raises:
        InputError: no scene, one that the store does not know, one without posed test frames, no
            room, fewer keyframes than rooms, or `out` is there already.
    """
    if not 0 < rooms <= keyframes:
        raise InputError(f"--rooms {rooms}: give 1 to {keyframes}, the number of keyframes")
    if out.exists():
        raise InputError(f"{out}: exists; remove it or give another --out")
    localizer = Localizer.open(store)
    tests = _tests(scenes, localizer.scenes)
    maps = localizer.maps
    for number in tqdm(range(rooms), "crowd", unit="room"):
        add_room(maps, FIRST_SEED + number, keyframes // rooms)
    row: dict[str, object] = {"keyframes": keyframes // rooms * rooms, "rooms": rooms}
    localizer = Localizer(maps)
    row |= located(localizer, tests) | {"peak_gb": peak_gb(maps.device)}
    print(tabulate(row.items(), floatfmt=".4g"))
    out.parent.mkdir(parents=True, exist_ok=True)
    settings = {"localize": asdict(localizer.options)}
    out.write_text(json.dumps({"rows": [row], "settings": settings}, indent=1))


def _tests(folders: Sequence[Path], known: Sequence[str]) -> dict[str, Sequence[Frame]]:
    """Posed test frames by the name of their scene."""
    tests: dict[str, Sequence[Frame]] = {}
    for folder in folders:
        name, _, path = str(folder).rpartition("=")
        scene = load_recording(path, name=name or None)
        if scene.name not in known:
            raise InputError(f"{folder}: {scene.name!r} is not in the store: {', '.join(known)}")
        tests[scene.name] = posed_frames(scene.test)
        if not tests[scene.name]:
            raise InputError(f"{folder}: has no test frames with a known pose")
    if not tests:
        raise InputError("crowd: give scenes with --scenes DIR...")
    return tests


def located(localizer: Localizer, tests: Mapping[str, Sequence[Frame]]) -> dict[str, object]:
    """What becomes of test frames, given by the name of their scene."""
    right, wrong, refused, ms = 0, 0, 0, []
    for name, frame in tqdm(_each(tests), "locating", unit="frame"):
        image, truth = frame.read_image(), frame.base_from_camera
        assert truth is not None
        began = time.perf_counter()
        found = localizer.localize(image, frame.camera)
        ms.append(1000 * (time.perf_counter() - began))
        refused += found.base_from_camera is None
        if found.base_from_camera is not None:
            metres, radians = pose_distance(found.base_from_camera, truth)
            right += bool(found.scene == name and metres < FINE[0] and radians < FINE[1])
            wrong += found.scene != name
    # After all times were taken: it loads keyframes that locating would have had to load.
    tried, ranking = _tried(localizer, tests)
    return {
        "scenes": len(tests),
        "frames": len(ms),
        "tried": 100 * tried / len(ms),
        "1 cm/1 deg": 100 * right / len(ms),
        "refused": refused,
        "wrong_scene": wrong,
        "ranking_ms": ranking,
        "ms": float(np.median(ms)),
        "ms_90": float(np.percentile(ms, 90)),
    }


def _tried(localizer: Localizer, tests: Mapping[str, Sequence[Frame]]) -> tuple[int, float]:
    """Frames for which the right scene is tried, and median milliseconds of ranking keyframes."""
    maps, tried, ms = localizer.maps, 0, []
    matcher = Matcher(maps, localizer._bank, localizer.options)
    every = list(range(len(maps.scenes)))
    for name, frame in tqdm(_each(tests), "ranking", unit="frame"):
        image = frame.read_image()
        features = localizer._encode([localizer._prepare(image, frame.camera)])[0]
        began = time.perf_counter()
        localizer._bank.retrieve(features.flatten(1).T, every)
        ms.append(1000 * (time.perf_counter() - began))
        query = Query(image, features, localizer.options.patches_short_side)
        tried += any(
            localizer.scenes[candidate.scene] == name
            for attempt in localizer.options.attempts
            for candidate in matcher.candidates(query, list(every), attempt, False)
        )
    return tried, float(np.median(ms))


def _each(tests: Mapping[str, Sequence[Frame]]) -> list[tuple[str, Frame]]:
    return [(name, frame) for name, frames in tests.items() for frame in frames]


def add_room(maps: SceneMaps, seed: int, count: int) -> None:
    """Adds a box room with `count` keyframes to what is known."""
    room, camera = BoxRoom(seed, texture_px=192), default_camera(320, 240)
    rng, vlad = np.random.default_rng(seed), vlad_for(maps.encoder)
    images, poses, depths, marks, descriptors = [], [], [], [], []
    for _ in range(count):
        pose = room.random_view(rng)
        grey = room.render(camera, pose).mean(-1).astype(np.uint8)
        view = plain_view(grey, camera, maps.encoder.stride, ViewOptions())
        features_map = encode_features([view], maps.encoder)[0]
        _, rows, columns = features_map.shape
        features = features_map.flatten(1).T
        pixels, _ = detect(grey, (rows, columns), float(maps.encoder.stride))
        n = len(pixels)
        images.append(jpeg(grey))
        poses.append(pose)
        depths.append(torch.full((len(features),), 1 / DEPTH_M).half())
        marks.append(Landmarks(pixels, np.full(n, 0.5), np.zeros((n, 2)), np.full(n, 0.01)))
        descriptors.append(vlad(features))
    record = SceneRecord(
        f"crowd-{seed}",
        camera,
        maps.atlas().place(np.stack([pose.translation_m for pose in poses])),
        torch.zeros(0, maps.descriptor.width).half(),
        count,
        min_support=maps.scenes[0].min_support,
    )
    maps.scenes.append(record)
    maps.keyframes.append(
        Keyframes(
            tuple(images),
            (camera,) * count,
            SE3.stack(poses),
            tuple(depths),
            tuple(marks),
            torch.stack(descriptors).half(),
        )
    )
    maps.method_states.append({})
