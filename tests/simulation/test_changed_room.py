"""A room after a change: what may differ does, what must not does not; needs no renderer."""

from dataclasses import replace

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.simulation import changed_room as module
from evercal.simulation.cell import SUITES
from evercal.simulation.cell_paths import changed_shots, is_clear, sweep_shots
from evercal.simulation.changed_room import SMALL, changed_room
from evercal.simulation.furnished.furniture import Item
from evercal.simulation.furnished.rooms import Room, room
from evercal.simulation.furnished.shapes import box

Placed = dict[tuple[str, bytes], Item]


@pytest.fixture(scope="module", params=SUITES["sim-mini"].rooms, ids=lambda entry: entry[0])
def place(request: pytest.FixtureRequest) -> Room:
    _, kind, seed = request.param
    return room(kind, seed)


def placed(rooms: Room, small: bool) -> Placed:
    """Small or large things by kind and bounding box in micrometres."""
    return {
        (item.kind, np.round(1e6 * item.bounds_m()).astype(int).tobytes()): item
        for item in rooms.items
        if (item.kind in SMALL) == small
    }


def share_touched(before: Room, after: Room) -> float:
    """How many of the small things are no longer where they were."""
    old = placed(before, small=True)
    return len(old.keys() - placed(after, small=True).keys()) / len(old)


def lights(rooms: Room) -> list[tuple[str, float]]:
    """Names and radiance of all that gives light or is a lamp."""
    parts = rooms.meshes()
    return sorted((m.name, m.emission) for _, m in parts if m.emission > 0 or "off" in m.name)


def test_a_third_of_the_small_things_is_elsewhere_or_gone(place: Room) -> None:
    after = changed_room(place, 0)
    assert share_touched(place, place) == 0
    assert share_touched(place, after) == pytest.approx(1 / 3, abs=0.02)
    old, new = placed(place, small=True), placed(after, small=True)
    moved, touched = new.keys() - old.keys(), old.keys() - new.keys()
    assert 0.3 < len(moved) / len(touched) <= 0.6
    assert sorted(kind for kind, _ in moved) != sorted(kind for kind, _ in touched)


def test_furniture_and_walls_stay(place: Room) -> None:
    after = changed_room(place, 0)
    old, new = placed(place, small=False), placed(after, small=False)
    assert old.keys() == new.keys()
    assert len(old) >= 20
    for (mesh, _), (same, _) in zip(place.shell, after.shell, strict=True):
        assert mesh is same
    shifted = replace(place, items=[item.placed(0.01, 0, 0) for item in place.items])
    assert placed(shifted, small=False).keys() != old.keys()


def test_what_moved_stands_on_something_and_in_nothing(place: Room) -> None:
    after = changed_room(place, 0)
    old = placed(place, small=True)
    moved = [item for key, item in placed(after, small=True).items() if key not in old]
    heights = [place.low_m[2], *(top[4] for item in after.items for top in item.tops)]
    for thing in moved:
        low, high = thing.bounds_m()
        assert np.abs(np.array(heights) - low[2]).min() < 0.002
        others = [item for item in after.items if item is not thing and not item.tops]
        boxes = np.stack([item.bounds_m() for item in others])
        assert not ((low < boxes[:, 1]) & (high > boxes[:, 0])).all(-1).any(), thing.kind
        assert module._fits(thing, place, others, None)
        assert not module._fits(thing, place, [*others, thing], None)
        assert not module._fits(thing.placed(99.0, 0, 0), place, others, None)
    foot = Item("box", [(box(0.1, 0.1, 0.1), place.shell[0][1])])
    assert not module._fits(foot, place, [], None)


def test_other_lamps_are_on(place: Room) -> None:
    after = changed_room(place, 0)
    sky = ("sky", 4.2)
    assert lights(place).count(sky) == lights(after).count(sky) == 3
    before, now = ([lamp for lamp in lights(r) if lamp != sky] for r in (place, after))
    assert all(light > 0 for _, light in before)
    assert any(light == 0 for _, light in now)
    assert any(light > 0 for _, light in now)
    # What is drawn as one gives one light.
    assert len(set(now)) == len({name for name, _ in now})
    assert not set(now) & set(before)


def test_a_room_with_one_lamp_is_left_to_daylight() -> None:
    assert module._factors(1, np.random.default_rng(0)) == [0.0]
    for seed in range(20):
        factors = module._factors(4, np.random.default_rng(seed))
        assert 1 <= factors.count(0.0) <= 3
        assert len(set(factors)) == 2


def test_the_same_seed_gives_the_same_change(place: Room) -> None:
    a, b, c = changed_room(place, 3), changed_room(place, 3), changed_room(place, 4)
    assert placed(a, small=True).keys() == placed(b, small=True).keys()
    assert lights(a) == lights(b)
    assert placed(a, small=True).keys() != placed(c, small=True).keys()


def test_the_path_is_of_its_own_and_clear_of_moved_things(place: Room) -> None:
    after = changed_room(place, 0)
    sweep = sweep_shots(place, 60, seed=0)
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
    again = changed_shots(after, 20, train, seed=0)
    same = SE3.stack([shot.base_from_camera for shot in again])
    np.testing.assert_array_equal(poses.matrix(), same.matrix())
    crammed = replace(after, items=[Item("block", [(box(9, 9, 9), place.shell[0][1])])])
    with pytest.raises(InputError, match="no free camera path"):
        changed_shots(crammed, 20, train, seed=0)
