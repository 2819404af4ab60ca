"""An interruption of `learn` does not show in what is learned."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence

import pytest
import torch
from evercal.mapping.scene_maps import SceneMaps
from safetensors.torch import load, save

from evercal.continual import stage_rows
from evercal.continual.networks.trainer import Progress
from evercal.continual.stage import Encoding, Event, StageOptions
from evercal.continual.strategies import STRATEGIES
from evercal.mapping.store import Checkpoint, Resume

from .stages import Rooms, assert_same, continued, outcome, weights


def saved(checkpoint: Checkpoint) -> Checkpoint:
    """The checkpoint as a file would give it back."""
    rows, state = (
        load(save({k: v.contiguous() for k, v in part.items()})) if part else {}
        for part in (checkpoint.rows, checkpoint.trainer)
    )
    return Checkpoint(rows, state)


def interrupted(
    events: Iterator[Event], stop: Callable[[Sequence[Checkpoint]], bool]
) -> Resume | None:
    """Runs until `stop` says so after a checkpoint; None if it ran to the end."""
    checkpoints: list[Checkpoint] = []
    for event in events:
        if isinstance(event, Checkpoint):
            checkpoints.append(saved(event))
            if stop(checkpoints):
                fitters = [c.trainer for c in checkpoints if c.trainer]
                return Resume([c.rows for c in checkpoints if c.rows], (fitters or [{}])[-1])
    return None


STOPS: dict[str, Callable[[Sequence[Checkpoint]], bool]] = {
    "first rows": lambda c: len(c) == 1,
    "halfway through encoding": lambda c: len(c) == 4,
    "first step": lambda c: bool(c[-1].trainer),
    "fifth step": lambda c: sum(bool(x.trainer) for x in c) == 5,
}


def whole_and_interrupted(
    maps: SceneMaps,
    rooms: Rooms,
    options: StageOptions,
    where: str,
    monkeypatch: pytest.MonkeyPatch,
) -> tuple[SceneMaps, Resume]:
    """What the second stage comes to in one go, and what it leaves behind where it is stopped."""
    whole = outcome(continued(maps, rooms, options))
    monkeypatch.setattr(stage_rows, "CHECKPOINT_SECONDS", 0.0)
    resume = interrupted(continued(maps, rooms, options), STOPS[where])
    assert resume is not None
    return whole, resume


@pytest.mark.parametrize("where", STOPS)
@pytest.mark.parametrize("name", ["evercal_network", "sars_spdd", "isolation"])
def test_an_interruption_does_not_show(
    name: str,
    where: str,
    first: dict[str, SceneMaps],
    rooms: Rooms,
    quick: StageOptions,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    maps = first[name]
    whole, resume = whole_and_interrupted(maps, rooms, quick, where, monkeypatch)
    again = list(continued(maps, rooms, quick, resume))
    assert_same(weights(outcome(again).heads[-1]), weights(whole.heads[-1]))
    a, b = outcome(again), whole
    assert torch.equal(a.scenes[-1].prototypes, b.scenes[-1].prototypes)
    # It went on rather than beginning again.
    steps = [event.step for event in again if isinstance(event, Progress)]
    views = [event.done for event in again if isinstance(event, Encoding) and event.total == 60]
    if "step" in where:
        assert steps[0] == (2 if where == "first step" else 6)
    else:
        assert views[0] > 8
        assert steps[0] == 1


def test_interrupted_twice(
    first: dict[str, SceneMaps],
    rooms: Rooms,
    quick: StageOptions,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    maps = first["evercal_network"]
    whole = outcome(continued(maps, rooms, quick))
    monkeypatch.setattr(stage_rows, "CHECKPOINT_SECONDS", 0.0)
    once = interrupted(continued(maps, rooms, quick), STOPS["halfway through encoding"])
    assert once is not None
    twice = interrupted(continued(maps, rooms, quick, once), STOPS["fifth step"])
    assert twice is not None
    resume = Resume([*once.rows, *twice.rows], twice.trainer)
    again = outcome(continued(maps, rooms, quick, resume))
    assert_same(weights(again.heads[0]), weights(whole.heads[0]))


def test_a_checkpoint_keeps_its_value(
    first: dict[str, SceneMaps],
    rooms: Rooms,
    quick: StageOptions,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # A consumer may write it while training goes on.
    monkeypatch.setattr(stage_rows, "CHECKPOINT_SECONDS", 0.0)
    kept: list[tuple[Checkpoint, Checkpoint]] = []
    for event in continued(first["evercal_network"], rooms, quick):
        if isinstance(event, Checkpoint):
            kept.append((event, copy.deepcopy(event)))
    for event, then in kept:
        assert_same(dict(event.rows), dict(then.rows))
        assert_same(dict(event.trainer), dict(then.trainer))


TRAINED = [name for name, s in STRATEGIES.items() if s.method is not None and not s.jointly]


@pytest.mark.parametrize("name", TRAINED)
def test_no_method_forgets_where_it_stood(
    name: str,
    first: dict[str, SceneMaps],
    rooms: Rooms,
    quick: StageOptions,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """After five of eight steps of the second scene; what is kept of the scene is the same, too."""
    maps = first[name]
    whole, resume = whole_and_interrupted(maps, rooms, quick, "fifth step", monkeypatch)
    events = list(continued(maps, rooms, quick, resume))
    assert [event.step for event in events if isinstance(event, Progress)] == [6, 7, 8]
    again = outcome(events)
    assert_same(weights(again.heads[-1]), weights(whole.heads[-1]))
    state, expected = again.method_states[-1], whole.method_states[-1]
    assert state.keys() == expected.keys()
    for key, value in expected.items():
        # Importances are divided by one another: the last digit may differ.
        torch.testing.assert_close(state[key].float(), value.float(), rtol=1e-2, atol=1e-3)
