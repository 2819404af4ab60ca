"""What the strategies know after a room."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from evercal.continual.stage import StageOptions
    from evercal.mapping.scene_maps import SceneMaps
    from evercal.recordings.frame import Recording

    Blank = Callable[[str], SceneMaps]
    Rooms = tuple[Recording, Recording, Recording]


@pytest.fixture(scope="session")
def first(blank: Blank, rooms: Rooms, quick: StageOptions) -> dict[str, SceneMaps]:
    """What each strategy that learns scene by scene knows after `alpha`."""
    from evercal.continual.learn import learn
    from evercal.continual.stage import Stage
    from evercal.continual.strategies import STRATEGIES

    found = {}
    for name, strategy in STRATEGIES.items():
        if strategy.jointly:
            continue
        *_, stage = learn(blank(name), strategy, rooms[0], quick)
        assert isinstance(stage, Stage)
        found[name] = stage.maps
    return found
