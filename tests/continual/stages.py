"""Stages run to their end, and what two of them must have in common."""

from collections.abc import Callable, Iterable, Iterator

import torch
from evercal.mapping.scene_maps import SceneMaps
from torch import Tensor

from evercal.continual.learn import learn
from evercal.continual.networks.head import Head
from evercal.continual.stage import Event, Stage, StageOptions
from evercal.continual.strategies import STRATEGIES
from evercal.mapping.store import Resume
from evercal.recordings.frame import Recording

Blank = Callable[[str], SceneMaps]
Rooms = tuple[Recording, Recording, Recording]


def outcome(events: Iterable[Event]) -> SceneMaps:
    """What is known after a stage that ran to its end."""
    *_, stage = events
    assert isinstance(stage, Stage)
    return stage.maps


def weights(head: Head) -> dict[str, Tensor]:
    """A copy of everything that a head holds."""
    return {name: value.clone() for name, value in head.state_dict().items()}


def assert_same(a: dict[str, Tensor], b: dict[str, Tensor]) -> None:
    """The same names and, but for the last digit, the same values."""
    assert a.keys() == b.keys()
    for name, value in a.items():
        torch.testing.assert_close(value, b[name], rtol=0, atol=1e-7, equal_nan=False)


def continued(
    maps: SceneMaps, rooms: Rooms, options: StageOptions, resume: Resume | None = None
) -> Iterator[Event]:
    """The events of the second stage, `beta`, with the strategy of the first."""
    return learn(maps, STRATEGIES[maps.strategy], rooms[1], options, resume)
