"""What stays of a finished scene: frames by the method's choice, its state, and both as memory."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import torch
from evercal.mapping.scene_maps import SceneMaps
from torch import Tensor

from evercal.continual.finish_scene import memory_bytes
from evercal.continual.frame_statistics import FrameStatistics
from evercal.continual.learn import learn
from evercal.continual.methods.method import FinishedScene, Method, StageStart
from evercal.continual.networks.hooks import TrainingHooks
from evercal.continual.stage import Stage, StageOptions
from evercal.continual.strategies import STRATEGIES, Strategy
from evercal.mapping.store import Store

from .stages import Blank, Rooms, assert_same, continued, outcome, weights

STATEFUL = ["gec", "der", "ewc", "ewc_online", "si", "mas", "gpm"]


@dataclass(frozen=True)
class Noting(Method):
    """Keeps the second and fifth frame, and writes down all that it is told."""

    replays = True
    citation = "a method that watches, for tests"
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


def test_a_method_is_told_what_it_needs(blank: Blank, rooms: Rooms, quick: StageOptions) -> None:
    method = Noting()
    maps, strategy = blank("noting"), Strategy("noting", method)
    heads = []
    for scene in rooms:
        maps = outcome(learn(maps, strategy, scene, quick))
        heads.append(copy.deepcopy(maps.heads[0]))
    for number, (start, end) in enumerate(zip(method.starts, method.ends, strict=True)):
        assert (start.replay_rows, start.seed) == (32, 0)
        assert start.head.scenes == number + 1
        assert [float(state["number"]) for state in start.states] == list(range(number))
        # Two keyframes of each earlier scene, as they are and augmented.
        assert [memory.scene for memory in start.memories] == list(range(number))
        assert [memory.views for memory in start.memories] == [4] * number
        if number == 0:
            assert start.teacher is None
        else:
            assert start.teacher is not None
            before = weights(heads[number - 1])
            assert all(torch.equal(v, before[k]) for k, v in weights(start.teacher).items())
        assert (end.number, end.keyframes) == (number, 2)
        assert [float(state["number"]) for state in end.earlier[:number]] == list(range(number))
        assert end.rows().views == 60
        assert end.hooks is not None
        # The rows that will be replayed, to the last digit: those of the next stage's memory.
        remembered = end.remembered().tensors
        for later in method.starts[number + 1 :]:
            again = later.memories[number].tensors
            assert all(torch.equal(value, again[name]) for name, value in remembered.items())
    assert [float(state["number"]) for state in maps.method_states] == [0, 1, 2]
    for keyframes, scene in zip(maps.keyframes, rooms, strict=True):
        assert keyframes is not None
        stood = np.stack(
            [
                frame.base_from_camera.translation_m
                for frame in (scene.train[1], scene.train[4])
                if frame.base_from_camera
            ]
        )
        np.testing.assert_allclose(keyframes.base_from_camera.translation_m, stood)


@pytest.mark.parametrize("name", STATEFUL)
def test_states_reach_the_next_stage_and_count_as_memory(
    name: str, first: dict[str, SceneMaps], rooms: Rooms, quick: StageOptions
) -> None:
    maps = first[name]
    second = outcome(continued(maps, rooms, quick))
    assert [len(known.method_states) for known in (maps, second)] == [1, 2]
    size = sum(value.nbytes for state in second.method_states for value in state.values())
    images = sum(kept.bytes for kept in second.keyframes if kept is not None)
    assert second.memory_bytes == images + size
    assert size > 0
    assert all(bool(v.isfinite().all()) for state in second.method_states for v in state.values())


def test_only_what_later_stages_look_at_counts_as_memory(
    first: dict[str, SceneMaps], rooms: Rooms, quick: StageOptions
) -> None:
    """Two scenes of EWC cost two anchors, a running sum one; and the rest is really not read."""
    sizes = {}
    for name in ("ewc", "ewc_online", "si", "mas", "gpm"):
        strategy = STRATEGIES[name]
        second = outcome(continued(first[name], rooms, quick))
        states = [sum(v.nbytes for v in state.values()) for state in second.method_states]
        sizes[name] = memory_bytes(second, strategy) / states[-1]
        assert memory_bytes(first[name], strategy) == first[name].memory_bytes
        blanked = second.copy_for_training()
        if name != "ewc":
            assert memory_bytes(second, strategy) == states[-1]
            blanked.method_states[0] = {}
            third, again = (
                outcome(learn(maps, strategy, rooms[2], quick)) for maps in (second, blanked)
            )
            assert_same(weights(third.heads[0]), weights(again.heads[0]))
    assert sizes.pop("ewc") > 1.8  # the head has grown a little
    assert set(sizes.values()) == {1.0}


@pytest.mark.parametrize("name", ["ewc", "ewc_online", "si", "mas", "gpm", "der"])
def test_without_its_state_a_method_ends_elsewhere(
    name: str, first: dict[str, SceneMaps], rooms: Rooms, quick: StageOptions
) -> None:
    """A state of other numbers makes another second stage: it is really read."""
    changed = first[name].copy_for_training()

    def other(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
        drawn = torch.Generator().manual_seed(1)
        return {k: torch.randn(v.shape, generator=drawn).to(v) for k, v in state.items()}

    changed.method_states = [other(state) for state in changed.method_states]
    ends = [outcome(continued(maps, rooms, quick)).heads[0] for maps in (first[name], changed)]
    key = "first.1.weight"
    assert not torch.allclose(weights(ends[0])[key], weights(ends[1])[key], atol=1e-5)


@pytest.mark.parametrize("name", STATEFUL)
def test_states_survive_the_store(
    name: str,
    first: dict[str, SceneMaps],
    make: Callable[[Path, list[SceneMaps]], Store],
    tmp_path: Path,
) -> None:
    make(tmp_path / "store", [first[name]])
    (again,) = Store.open(tmp_path / "store").maps.method_states
    (state,) = first[name].method_states
    assert again.keys() == state.keys()
    for key, value in state.items():
        assert again[key].dtype == value.dtype
        assert torch.equal(again[key], value)


def test_a_stage_tells_how_many_frames_it_kept(
    first: dict[str, SceneMaps], rooms: Rooms, quick: StageOptions
) -> None:
    *_, none = continued(first["finetune"], rooms, quick)
    *_, some = continued(first["er"], rooms, quick)
    assert isinstance(none, Stage)
    assert isinstance(some, Stage)
    assert (none.frames_kept, some.frames_kept) == (0, 3)
    assert STRATEGIES["finetune"].method is not None
