"""Memory in bytes, and a network that learns beside a map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from evercal.continual.stage_map import fitting
from evercal.mapping.scene_maps import SceneMaps

from evercal.continual.learn import learn
from evercal.continual.networks.buffer import FeatureBuffer
from evercal.continual.stage import Stage, StageOptions
from evercal.continual.strategies import STRATEGIES
from evercal.geometry.se3 import SE3, pose_distance
from evercal.recordings.frame import Frame, Recording

from .stages import Blank, Rooms


def shifted(scene: Recording, change: SE3) -> Recording:
    """The scene with stated poses that are off by a motion of the camera."""
    frames = []
    for frame in scene.train:
        assert frame.base_from_camera is not None
        frames.append(replace(frame, base_from_camera=frame.base_from_camera @ change))
    return replace(scene, train=tuple(frames))


@pytest.mark.parametrize("name", ["evercal_hybrid", "joint_map"])
def test_a_network_beside_a_map_learns_the_frames_of_the_map(
    name: str,
    blank: Blank,
    arcs: tuple[Recording, Recording],
    quick: StageOptions,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # A network that learned the stated poses would give points in another frame than the landmarks.
    import evercal.continual.learn
    import evercal.continual.learn_jointly
    from evercal.continual import stage_rows

    learned: list[Frame] = []

    def encoded(buffer: FeatureBuffer, frames: list[Frame], *rest: object) -> object:
        learned.extend(frames)
        return stage_rows.encoded(buffer, frames, *rest)  # pyright: ignore[reportArgumentType]

    for module in (evercal.continual.learn, evercal.continual.learn_jointly):
        monkeypatch.setattr(module, "encoded", encoded)
    off = SE3.exp(np.array([0, 0, 0, 0.012, -0.02, 0.015]))
    scene, strategy = shifted(arcs[0], off.inverse()), STRATEGIES[name]
    maps = blank(name)
    if strategy.jointly:
        events = evercal.continual.learn_jointly.learn_jointly(maps, strategy, [scene], quick)
    else:
        events = learn(maps, strategy, scene, quick)
    *_, stage = events
    assert isinstance(stage, Stage)
    assert len(learned) == len(scene.train)
    for frame, true in zip(learned, arcs[0].train, strict=True):
        assert frame.base_from_camera is not None
        assert true.base_from_camera is not None
        assert pose_distance(frame.base_from_camera, true.base_from_camera)[1] < 0.006
    record = stage.maps.scenes[0]
    assert pose_distance(record.common, off)[1] < 0.006
    assert record.refined_camera == learned[0].camera


@pytest.mark.parametrize("name", ["evercal", "evercal_hybrid", "er"])
def test_memory_in_bytes_is_kept_and_used(
    name: str, blank: Blank, rooms: Rooms, quick: StageOptions
) -> None:
    budget = 60_000
    *_, stage = learn(blank(name), STRATEGIES[name], rooms[0], replace(quick, memory_bytes=budget))
    assert isinstance(stage, Stage)
    kept = stage.maps.keyframes[0]
    assert kept is not None
    assert 0.6 * budget < kept.bytes <= budget
    assert len(kept) == stage.frames_kept


def test_as_many_keyframes_as_fit(hall_maps: SceneMaps) -> None:
    keyframes = hall_maps.keyframes[0]
    assert keyframes is not None
    everything = keyframes.bytes
    assert fitting(keyframes, everything).tolist() == list(range(len(keyframes)))
    fewer = keyframes.take(fitting(keyframes, everything - 1))
    assert len(keyframes) / 2 < len(fewer) < len(keyframes)
    assert fewer.bytes < everything
    assert len(fitting(keyframes, 1)) == 1  # at least one, or nothing could be located
