"""What is stored of a finished scene: keyframes by the method's choice, and the method's state."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from evercal.continual.learning.stage import StageOptions
from evercal.continual.methods.method import FinishedScene, Method, StageStart
from evercal.continual.networks.hooks import TrainingHooks
from evercal.continual.scenes import LearnedScenes
from evercal.continual.selection.frame_statistics import FrameStatistics
from evercal.continual.store import NetworkStore
from evercal.continual.strategies import Strategy
from evercal.recordings.frame import stated_poses

from ..stages import EmptyScenes, MakeStore, Rooms, learn, second_stage, weights

STATEFUL = ["gec", "ewc"]


@dataclass(frozen=True)
class RecordingMethod(Method):
    """Keeps the second and fifth frame, and records its arguments."""

    replays = True
    starts: list[StageStart] = field(default_factory=list, compare=False)
    ends: list[FinishedScene] = field(default_factory=list, compare=False)

    def select(self, frames: FrameStatistics, capacity: int) -> np.ndarray | None:
        return np.array([1, 4])

    def begin(self, start: StageStart) -> TrainingHooks:
        self.starts.append(start)
        return TrainingHooks()

    def after_scene(self, scene: FinishedScene) -> dict[str, Tensor]:
        self.ends.append(scene)
        return {"number": torch.tensor(float(scene.number))}


def test_arguments_of_a_method(
    empty_scenes: EmptyScenes, rooms: Rooms, quick: StageOptions
) -> None:
    method = RecordingMethod()
    scenes = empty_scenes("recording")
    strategy = Strategy("recording", method)
    heads = []
    for room in rooms:
        scenes = learn(scenes, strategy, room, quick)
        heads.append(copy.deepcopy(scenes.heads[0]))
    for number, (start, end) in enumerate(zip(method.starts, method.ends, strict=True)):
        assert start.replay_rows == 32
        assert start.head.scenes == number + 1
        assert [float(state["number"]) for state in start.states] == list(range(number))
        # Two keyframes of each earlier scene, without and with augmentation.
        assert [memory.scene for memory in start.memories] == list(range(number))
        assert [memory.views for memory in start.memories] == [4] * number
        assert (start.teacher is None) == (number == 0)
        if start.teacher is not None:
            before = weights(heads[number - 1])
            assert all(
                torch.equal(v, before[k]) for k, v in weights(start.teacher).items()
            )
        assert end.number == number
        assert end.rows().views == 60
        # These rows are replayed in the next stage, to the last digit.
        remembered = end.remembered().tensors
        for later in method.starts[number + 1 :]:
            again = later.memories[number].tensors
            assert all(
                torch.equal(value, again[name]) for name, value in remembered.items()
            )
    assert [float(state["number"]) for state in scenes.method_states] == [0, 1, 2]
    for keyframes, room in zip(scenes.keyframes, rooms, strict=True):
        assert keyframes is not None
        selected = stated_poses([room.train[1], room.train[4]])
        np.testing.assert_allclose(
            keyframes.base_from_camera.translation_m, selected.translation_m
        )


@pytest.mark.parametrize("name", STATEFUL)
def test_states_are_stored_and_count_as_memory(
    name: str,
    first_stages: dict[str, LearnedScenes],
    rooms: Rooms,
    quick: StageOptions,
    make_store: MakeStore,
    tmp_path: Path,
) -> None:
    first = first_stages[name]
    second = second_stage(first, rooms, quick)
    states = [value for state in second.method_states for value in state.values()]
    assert len(second.method_states) == 2
    assert all(bool(value.isfinite().all()) for value in states)
    images = sum(
        keyframes.bytes for keyframes in second.keyframes if keyframes is not None
    )
    assert second.memory_bytes - images == sum(value.nbytes for value in states) > 0
    make_store(tmp_path / "store", [first])
    (stored,) = NetworkStore.open(tmp_path / "store").contents.method_states
    (state,) = first.method_states
    assert stored.keys() == state.keys()
    for key, value in state.items():
        assert stored[key].dtype == value.dtype
        assert torch.equal(stored[key], value)
