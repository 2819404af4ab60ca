"""An interrupted `learn` that is resumed has the same outcome as an uninterrupted one."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import pytest
import torch
from safetensors.torch import load, save

from evercal.continual.learning import stage_rows
from evercal.continual.learning.stage import Encoding, Event, StageOptions
from evercal.continual.networks.trainer import Progress
from evercal.continual.scenes import LearnedScenes
from evercal.continual.store import Checkpoint, Resume
from evercal.continual.strategies import STRATEGIES

from ..stages import Rooms, assert_same, outcome, second_stage, weights

TRAINED = [name for name, s in STRATEGIES.items() if s.method is not None and not s.jointly]


def saved(checkpoint: Checkpoint) -> Checkpoint:
    """The checkpoint as it is read from its files."""
    rows, state = (
        load(save({k: v.contiguous() for k, v in part.items()})) if part else {}
        for part in (checkpoint.rows, checkpoint.trainer)
    )
    return Checkpoint(rows, state)


def interrupted(events: Iterator[Event], stop: Callable[[Sequence[Checkpoint]], bool]) -> Resume:
    """The checkpoints at the first one for which `stop` is true."""
    checkpoints: list[Checkpoint] = []
    for event in events:
        if isinstance(event, Checkpoint):
            checkpoints.append(saved(event))
            if stop(checkpoints):
                states = [c.trainer for c in checkpoints if c.trainer]
                return Resume([c.rows for c in checkpoints if c.rows], (states or [{}])[-1])
    raise AssertionError("the stage ended before it was stopped")


STOPS: dict[str, Callable[[Sequence[Checkpoint]], bool]] = {
    "first rows": lambda c: len(c) == 1,
    "halfway through encoding": lambda c: len(c) == 4,
    "first step": lambda c: bool(c[-1].trainer),
    "fifth step": lambda c: sum(bool(x.trainer) for x in c) == 5,
}


class Runs(NamedTuple):
    """The second stage in one run, and in two."""

    whole: LearnedScenes
    resumed: LearnedScenes
    events: list[Event]
    """Events after the interruption."""


@pytest.fixture
def runs(
    first_stages: dict[str, LearnedScenes],
    rooms: Rooms,
    quick: StageOptions,
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[[str, str], Runs]:
    """Run the second stage of a strategy with and without an interruption."""

    def make(name: str, stop: str) -> Runs:
        scenes = first_stages[name]
        whole = outcome(second_stage(scenes, rooms, quick))
        with monkeypatch.context() as patch:
            patch.setattr(stage_rows, "CHECKPOINT_SECONDS", 0.0)
            resume = interrupted(second_stage(scenes, rooms, quick), STOPS[stop])
        events = list(second_stage(scenes, rooms, quick, resume))
        return Runs(whole, outcome(events), events)

    return make


@pytest.mark.parametrize("stop", STOPS)
@pytest.mark.parametrize("name", ["evercal_network", "evercal_hybrid", "isolation"])
def test_interruption_does_not_change_the_outcome(
    name: str, stop: str, runs: Callable[[str, str], Runs]
) -> None:
    whole, resumed, events = runs(name, stop)
    assert_same(weights(resumed.heads[-1]), weights(whole.heads[-1]))
    assert torch.equal(resumed.scenes[-1].prototypes, whole.scenes[-1].prototypes)
    steps = [event.step for event in events if isinstance(event, Progress)]
    views = [event.done for event in events if isinstance(event, Encoding) and event.total == 60]
    if "step" in stop:
        assert steps[0] == (2 if stop == "first step" else 6)
    else:
        assert views[0] > 8
        assert steps[0] == 1


@pytest.mark.parametrize("name", TRAINED)
def test_methods_resume_within_training(name: str, runs: Callable[[str, str], Runs]) -> None:
    whole, resumed, events = runs(name, "fifth step")
    assert [event.step for event in events if isinstance(event, Progress)] == [6, 7, 8]
    assert_same(weights(resumed.heads[-1]), weights(whole.heads[-1]))
    state, expected = resumed.method_states[-1], whole.method_states[-1]
    assert state.keys() == expected.keys()
    for key, value in expected.items():
        # Importances are divided by one another: the last digit may differ.
        torch.testing.assert_close(state[key].float(), value.float(), rtol=1e-2, atol=1e-3)


def test_two_interruptions(
    first_stages: dict[str, LearnedScenes],
    rooms: Rooms,
    quick: StageOptions,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scenes = first_stages["evercal_network"]
    whole = outcome(second_stage(scenes, rooms, quick))
    monkeypatch.setattr(stage_rows, "CHECKPOINT_SECONDS", 0.0)
    once = interrupted(second_stage(scenes, rooms, quick), STOPS["halfway through encoding"])
    twice = interrupted(second_stage(scenes, rooms, quick, once), STOPS["fifth step"])
    resume = Resume([*once.rows, *twice.rows], twice.trainer)
    again = outcome(second_stage(scenes, rooms, quick, resume))
    assert_same(weights(again.heads[0]), weights(whole.heads[0]))


def test_checkpoints_do_not_change_while_training_continues(
    first_stages: dict[str, LearnedScenes],
    rooms: Rooms,
    quick: StageOptions,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(stage_rows, "CHECKPOINT_SECONDS", 0.0)
    pairs = [
        (event, copy.deepcopy(event))
        for event in second_stage(first_stages["evercal_network"], rooms, quick)
        if isinstance(event, Checkpoint)
    ]
    for event, then in pairs:
        assert_same(dict(event.rows), dict(then.rows))
        assert_same(dict(event.trainer), dict(then.trainer))
