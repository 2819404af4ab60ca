"""A map of the hall, and small scenes whose content is drawn at random."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

if TYPE_CHECKING:
    from evercal.mapping.built_map import BuiltMap
    from evercal.mapping.scene_map import MapContents, SceneMap
    from evercal.mapping.store import MapStore
    from evercal.recordings.frame import Recording

Contents = Callable[["MapContents"], list[object]]
Make = Callable[[Path, Sequence["SceneMap"]], "MapStore"]


@pytest.fixture(scope="session")
def hall_built(hall: Recording) -> BuiltMap:
    """The map of `hall` with 7 keyframes."""
    from evercal.features.encoder import load_encoder
    from evercal.mapping.build import MapOptions, build_map
    from evercal.mapping.memory_budget import MemoryBudget

    options = MapOptions(memory=MemoryBudget(share=0.25))
    return build_map("hall", hall.train, load_encoder(), options)


@pytest.fixture(scope="session")
def scenes(rooms: tuple[Recording, ...]) -> list[SceneMap]:
    """Three scenes with two keyframes each; landmarks, depths and descriptors are random."""
    from evercal.geometry import SE3
    from evercal.mapping.keyframes import store_keyframes
    from evercal.mapping.landmarks import Landmarks
    from evercal.mapping.map_frame import FrameCorrection, MapFrame, Similarity
    from evercal.mapping.scene_map import SceneMap

    rng = np.random.default_rng(0)
    made = []
    for i, room in enumerate(rooms):
        camera = room.train[0].camera
        marks = [
            Landmarks(
                pixels=rng.integers(0, (64, 48), (n, 2)).astype(float),
                inverse_depth=rng.uniform(0.1, 4, n).astype(np.float32).astype(float),
                slope=rng.normal(0, 0.01, (n, 2)).astype(np.float32).astype(float),
                sigma=rng.uniform(0.001, 0.1, n).astype(np.float32).astype(float),
            )
            for n in (7, 12)
        ]
        keyframes = replace(
            store_keyframes(room.train[:2], 48),
            inverse_depth=tuple(np.full(48, 0.5 + i, np.float16) for _ in marks),
            landmarks=tuple(marks),
            descriptors=rng.normal(size=(2, 128)).astype(np.float16),
        )
        poses = SE3.exp(rng.normal(size=(5, 6)))
        motion = SE3.exp(rng.normal(size=6))
        frame = MapFrame(
            common=SE3.exp(0.01 * rng.normal(size=6)),
            correction=FrameCorrection(poses, rng.normal(size=(5, 6)), (0.2, 0.26)),
            pose_sigma=(0.001, 0.002),
            similarity=Similarity(motion, 1.5),
            base_covariance=np.diag(np.arange(1.0, 7.0)) * 1e-6,
        )
        made.append(
            SceneMap(
                name=room.name,
                camera=camera,
                adjusted_camera=replace(camera, fx=1.01 * camera.fx),
                keyframes=keyframes,
                frame=frame if i == 0 else MapFrame(),
                train_frames=30 + i,
                unit=None if i else 1.0,
            )
        )
    return made


@pytest.fixture
def make() -> Make:
    """Make a store of given scenes with a tiny random encoder and its centroids."""
    from evercal.mapping.store import MapStore

    from ..encoders import tiny_encoder

    def store(root: Path, scenes: Sequence[SceneMap]) -> MapStore:
        encoder = tiny_encoder()
        rows = np.random.default_rng(0).normal(size=(200, 8))
        unit = rows / np.linalg.norm(rows, axis=1, keepdims=True)
        encoder.vlad([unit.astype(np.float32)])
        store = MapStore.create(root, encoder, 48)
        for scene in scenes:
            store.commit(scene, {"scene": scene.name, "seconds": 1.5})
        return store

    return store


@pytest.fixture
def root(
    scenes: list[SceneMap],
    tmp_path: Path,
    make: Callable[[Path, Sequence[SceneMap]], MapStore],
) -> Path:
    """A map of alpha, beta and gamma."""
    return make(tmp_path / "store", scenes).root


@pytest.fixture
def other(
    scenes: list[SceneMap],
    tmp_path: Path,
    make: Callable[[Path, Sequence[SceneMap]], MapStore],
) -> Path:
    """A map of beta, with a number of frames of its own, and delta."""
    beta = replace(scenes[1], train_frames=7)
    delta = replace(scenes[2], name="delta")
    return make(tmp_path / "other", [beta, delta]).root


@pytest.fixture(scope="session")
def content() -> Contents:
    """Everything in a map, for comparisons."""
    from evercal.mapping.map_frame import correction_tensors, frame_to_dict

    def values(contents: MapContents) -> list[object]:
        listed: list[object] = []
        for scene in contents.scenes:
            listed.append(
                (scene.name, scene.camera, scene.adjusted_camera, scene.train_frames)
            )
            listed.append((scene.unit, scene.metric))
            listed.append(_rounded(frame_to_dict(scene.frame)))
            tensors = scene.keyframes.to_tensors()
            if scene.frame.correction is not None:
                tensors |= correction_tensors(scene.frame.correction)
            listed.append(
                {name: _rounded(value.tolist()) for name, value in tensors.items()}
            )
        return listed

    return values


def _rounded(value: object) -> object:
    """Numbers to 12 digits: quaternions are normalised when they are read."""
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_rounded(item) for item in value]
    return round(value, 12) + 0.0 if isinstance(value, float) else value
