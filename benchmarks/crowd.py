"""A store among thousands of keyframes of other places: is the right scene still tried, and when?

The crowd are views of procedural box rooms with their real images, features and descriptors. Their
depths are made up: what is measured is retrieval, the choice of scenes and memory, none of which
looks at a depth; poses of crowd scenes are never right, so they can only do harm.
"""

import resource
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from evercal.datasets import load_scene
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
from evercal.simulation.box_room import BoxRoom, default_camera

FIRST_SEED = 5_000
DEPTH_M = 2.0


def run(store: Path, scenes: Sequence[Path], keyframes: int, rooms: int) -> None:
    """Prints what locating the scenes' test frames takes in the crowd.

    Args:
        store: that knows the scenes.
        scenes: folders of recorded scenes of the store, NAME=FOLDER where it has another name.
        keyframes: of the crowd.
        rooms: that they are shared out over.
    """
    localizer = Localizer.open(store)
    maps = localizer.maps
    for number in tqdm(range(rooms), "crowd", unit="room"):
        add_room(maps, FIRST_SEED + number, keyframes // rooms)
    localizer = Localizer(maps)
    matcher = Matcher(maps, localizer._bank, localizer.options)
    tried, right, wrong, refused, rank, ms = 0, 0, 0, 0, [], []
    for folder in scenes:
        name, _, path = str(folder).rpartition("=")
        scene = load_scene(path, name=name or None)
        index = localizer.scenes.index(scene.name)
        for frame in tqdm(scene.test, scene.name):
            image, truth = frame.read_image(), frame.base_from_camera
            assert truth is not None
            features = localizer._encode([localizer._prepare(image, frame.camera)])[0]
            began = time.perf_counter()
            localizer._bank.retrieve(features.flatten(1).T, range(len(maps.scenes)))
            rank.append(1000 * (time.perf_counter() - began))
            query = Query(image, features, localizer.options.patches_short_side)
            usable = list(range(len(maps.scenes)))
            tried += any(
                candidate.scene == index
                for attempt in localizer.options.attempts
                for candidate in matcher.candidates(query, list(usable), attempt, False)
            )
            began = time.perf_counter()
            found = localizer.localize(image, frame.camera)
            ms.append(1000 * (time.perf_counter() - began))
            refused += found.base_from_camera is None
            if found.base_from_camera is not None:
                metres, radians = pose_distance(found.base_from_camera, truth)
                good = found.scene == scene.name and metres < 0.01 and radians < np.deg2rad(1)
                right += bool(good)
                wrong += found.scene != scene.name
    total = len(ms)
    print(
        f"{keyframes} keyframes of {rooms} rooms around {len(scenes)} scenes, {total} test frames:"
        f" right scene tried for {100 * tried / total:.1f} %, within 1 cm/1 deg"
        f" {100 * right / total:.1f} %, refused {refused}, wrong scene {wrong}; ranking"
        f" {np.median(rank):.1f} ms, locating {np.median(ms):.0f} ms (90 %"
        f" {np.percentile(ms, 90):.0f}); most memory"
        f" {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB"
    )


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
