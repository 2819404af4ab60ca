"""Run stages to their end, and compare their outcomes."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

from evercal.continual.learning.learn import learn
from evercal.continual.learning.stage import Event, Stage, StageOptions
from evercal.continual.networks.head import Head
from evercal.continual.scenes import LearnedScenes
from evercal.continual.store import NetworkStore, Resume
from evercal.continual.strategies import STRATEGIES
from evercal.recordings.frame import Recording

EmptyScenes = Callable[[str], LearnedScenes]
MakeStore = Callable[[Path, Sequence[LearnedScenes]], NetworkStore]
Estimates = Callable[[LearnedScenes], list[bytes]]
Rooms = tuple[Recording, Recording, Recording]
Tree = Callable[[Path], dict[str, str]]


def finished(events: Iterable[Event]) -> Stage:
    """The last event of a stage."""
    *_, stage = events
    assert isinstance(stage, Stage)
    return stage


def outcome(events: Iterable[Event]) -> LearnedScenes:
    """What is learned after a stage."""
    return finished(events).scenes


def weights(head: Head) -> dict[str, Tensor]:
    """A copy of a head's state."""
    return {name: value.clone() for name, value in head.state_dict().items()}


def assert_same(a: dict[str, Tensor], b: dict[str, Tensor]) -> None:
    """Assert that names are the same, and values to 1e-7."""
    assert a.keys() == b.keys()
    for name, value in a.items():
        torch.testing.assert_close(value, b[name], rtol=0, atol=1e-7, equal_nan=False)


def second_stage(
    scenes: LearnedScenes, rooms: Rooms, options: StageOptions, resume: Resume | None = None
) -> Iterator[Event]:
    """Learn the second room with the strategy of the first."""
    return learn(scenes, STRATEGIES[scenes.strategy], rooms[1], options, resume)
