"""Run stages by the name of a strategy, and compare their outcomes."""

from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from evercal.continual.learning.learn import learn as learn_by_method
from evercal.continual.learning.stage import OnEvent, StageOptions, unobserved
from evercal.continual.networks.head import Head
from evercal.continual.scenes import LearnedScenes
from evercal.continual.store import NetworkStore
from evercal.continual.strategies import STRATEGIES, Strategy
from evercal.recordings.frame import Recording

EmptyScenes = Callable[[str], LearnedScenes]
MakeStore = Callable[[Path, Sequence[LearnedScenes]], NetworkStore]
Stages = dict[str, LearnedScenes]
Rooms = tuple[Recording, Recording, Recording]
Tree = Callable[[Path], dict[str, str]]


def learn(
    scenes: LearnedScenes,
    strategy: Strategy,
    recording: Recording,
    options: StageOptions,
    on_event: OnEvent = unobserved,
) -> LearnedScenes:
    """Learn a scene by the method of a strategy."""
    assert strategy.method is not None
    return learn_by_method(scenes, strategy.method, recording, options, on_event)


def second_stage(
    scenes: LearnedScenes,
    rooms: Rooms,
    options: StageOptions,
    on_event: OnEvent = unobserved,
) -> LearnedScenes:
    """Learn the second room with the strategy of the first."""
    return learn(scenes, STRATEGIES[scenes.strategy], rooms[1], options, on_event)


def weights(head: Head) -> dict[str, Tensor]:
    """A copy of a head's state."""
    return {name: value.clone() for name, value in head.state_dict().items()}


def assert_same(a: dict[str, Tensor], b: dict[str, Tensor]) -> None:
    """Assert that names are the same, and values to 1e-7."""
    assert a.keys() == b.keys()
    for name, value in a.items():
        torch.testing.assert_close(value, b[name], rtol=0, atol=1e-7, equal_nan=False)
