"""Changed rooms: small objects and lamps differ, furniture and walls stay. Needs no renderer."""

from dataclasses import replace

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from rooms.changed import SMALL, changed_room
from rooms.items import Item
from rooms.paths import changed_shots, is_clear, sweep_shots
from rooms.room import Room, room
from rooms.shapes import box

pytestmark = pytest.mark.slow("rooms", "src/evercal/simulation")

Items = dict[tuple[str, bytes], Item]


@pytest.fixture(scope="module")
def before() -> Room:
    return room("kitchen", 102)


@pytest.fixture(scope="module")
def after(before: Room) -> Room:
    return changed_room(before, 0)


def items_by_position(rooms: Room, small: bool) -> Items:
    """Small or large items by kind and bounding box in micrometres."""
    return {
        (item.kind, np.round(1e6 * item.bounds_m()).astype(int).tobytes()): item
        for item in rooms.items
        if (item.kind in SMALL) == small
    }


def changed_fraction(before: Room, after: Room) -> float:
    """Fraction of small items that moved or were removed."""
    old = items_by_position(before, small=True)
    return len(old.keys() - items_by_position(after, small=True).keys()) / len(old)


def lights(rooms: Room) -> list[tuple[str, float]]:
    """Names and radiance of lamps."""
    parts = rooms.meshes()
    return sorted(
        (m.name, m.emission) for _, m in parts if m.emission > 0 or "off" in m.name
    )


def test_a_third_of_the_small_items_changes(before: Room, after: Room) -> None:
    assert changed_fraction(before, before) == 0
    assert changed_fraction(before, after) == pytest.approx(1 / 3, abs=0.02)
    old = items_by_position(before, small=True)
    new = items_by_position(after, small=True)
    moved = new.keys() - old.keys()
    touched = old.keys() - new.keys()
    assert 0.3 < len(moved) / len(touched) <= 0.6
    assert sorted(kind for kind, _ in moved) != sorted(kind for kind, _ in touched)


def test_furniture_and_walls_stay(before: Room, after: Room) -> None:
    old = items_by_position(before, small=False)
    new = items_by_position(after, small=False)
    assert old.keys() == new.keys()
    assert len(old) >= 20
    for (mesh, _), (same, _) in zip(before.shell, after.shell, strict=True):
        assert mesh is same
    shifted = replace(before, items=[item.placed(0.01, 0, 0) for item in before.items])
    assert items_by_position(shifted, small=False).keys() != old.keys()


def test_moved_items_stand_on_a_surface_without_overlap(
    before: Room, after: Room
) -> None:
    old = items_by_position(before, small=True)
    new = items_by_position(after, small=True)
    moved = [new[key] for key in new.keys() - old.keys()]
    heights = [before.low_m[2], *(top[4] for item in after.items for top in item.tops)]
    for item in moved:
        low, high = item.bounds_m()
        assert np.abs(np.array(heights) - low[2]).min() < 0.002
        boxes = [
            other.bounds_m()
            for other in after.items
            if other is not item and not other.tops
        ]
        lows, highs = np.stack(boxes, 1)
        assert not ((low < highs) & (high > lows)).all(-1).any(), item.kind


def test_other_lamps_are_on(before: Room, after: Room) -> None:
    sky = ("sky", 4.2)
    assert lights(before).count(sky) == lights(after).count(sky) == 3
    old, new = ([lamp for lamp in lights(r) if lamp != sky] for r in (before, after))
    assert all(light > 0 for _, light in old)
    assert any(light == 0 for _, light in new)
    assert any(light > 0 for _, light in new)
    # Lamps with one material name have one brightness.
    assert len(set(new)) == len({name for name, _ in new})
    assert not set(new) & set(old)


def test_the_same_seed_gives_the_same_change(before: Room, after: Room) -> None:
    again = changed_room(before, 0)
    other = changed_room(before, 4)
    assert lights(after) == lights(again)
    keys, same, others = (
        items_by_position(rooms, small=True).keys() for rooms in (after, again, other)
    )
    assert keys == same
    assert keys != others


def test_the_changed_path_is_new_and_free(before: Room, after: Room) -> None:
    sweep = sweep_shots(before, 60, seed=0)
    train, test = (
        SE3.stack([s.base_from_camera for s in sweep if s.split == split])
        for split in ("train", "test")
    )
    shots = changed_shots(after, 20, train, seed=0)
    poses = SE3.stack([shot.base_from_camera for shot in shots])
    assert {shot.split for shot in shots} == {"test"}
    assert is_clear(after, poses.translation_m).all()
    for earlier, most in ((train, 0.1), (test, 0.5)):
        metres, radians = pose_distance(poses[:, None], earlier[None])
        assert ((metres < 0.05) & (radians < np.deg2rad(5))).any(1).mean() <= most
    arms = np.stack([shot.joints_rad for shot in sweep])
    for shot in shots:
        assert np.abs(arms - shot.joints_rad).max(1).min() > 0.1
    crammed = replace(
        after, items=[Item("block", [(box(9, 9, 9), before.shell[0][1])])]
    )
    with pytest.raises(InputError, match="no free camera path"):
        changed_shots(crammed, 20, train, seed=0)
