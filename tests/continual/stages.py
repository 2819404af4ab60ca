"""Stages run to their end, and what two of them must have in common."""

from collections.abc import Callable, Iterable, Iterator

import torch
from torch import Tensor

from evercal.continual.knowledge import Knowledge
from evercal.continual.learn import Event, Resume, Stage, StageOptions, learn
from evercal.datasets.frame import Scene
from evercal.models.head import Head

Blank = Callable[[str], Knowledge]
Rooms = tuple[Scene, Scene, Scene]


def outcome(events: Iterable[Event]) -> Knowledge:
    """What is known after a stage that ran to its end."""
    *_, stage = events
    assert isinstance(stage, Stage)
    return stage.knowledge


def weights(head: Head) -> dict[str, Tensor]:
    """A copy of everything that a head holds."""
    return {name: value.clone() for name, value in head.state_dict().items()}


def assert_same(a: dict[str, Tensor], b: dict[str, Tensor]) -> None:
    """The same names and, but for the last digit, the same values."""
    assert a.keys() == b.keys()
    for name, value in a.items():
        torch.testing.assert_close(value, b[name], rtol=0, atol=1e-7, equal_nan=False)


def continued(
    known: Knowledge, rooms: Rooms, options: StageOptions, resume: Resume | None = None
) -> Iterator[Event]:
    """The events of the second stage, `beta`, for any strategy."""
    return learn(known, rooms[1], options, resume, earlier=rooms[:1])
