"""Views of one room with coarse textures, drawn once."""

from collections.abc import Callable, Iterator

import pytest

from evercal.simulation.box_room import BoxRoom
from training import contrastive, pairs, places
from training.pairs import RoomViews, room_views

SEED = 420


@pytest.fixture(scope="session")
def coarse() -> Iterator[Callable[[int], RoomViews]]:
    """`room_views` with coarse textures and two anchors."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            pairs, "BoxRoom", lambda seed, texture_px: BoxRoom(seed, texture_px=48)
        )
        yield lambda seed: room_views(seed, anchors=2)


@pytest.fixture(scope="session")
def views(coarse: Callable[[int], RoomViews]) -> RoomViews:
    return coarse(SEED)


@pytest.fixture
def one_room(monkeypatch: pytest.MonkeyPatch, views: RoomViews) -> RoomViews:
    """Use one room for all held-out rooms, to save time."""
    for module in (contrastive, places):
        monkeypatch.setattr(module, "room_views", lambda seed: views)
    return views
