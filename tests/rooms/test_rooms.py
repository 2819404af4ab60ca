"""Rooms and camera paths in them. Needs no renderer."""

import numpy as np
import pytest

from evercal.geometry import pose_distance
from rooms.paths import fixed_shots, sweep_shots
from rooms.room import RESERVED, Room, room
from rooms.suites import SUITES

pytestmark = pytest.mark.slow("rooms", "src/evercal/simulation")


@pytest.fixture(scope="module", params=SUITES["sim"].rooms, ids=lambda entry: entry[0])
def furnished_room(request: pytest.FixtureRequest) -> Room:
    _, kind, seed = request.param
    return room(kind, seed)


def test_rooms_have_many_kinds_of_items(furnished_room: Room) -> None:
    assert len(furnished_room.items) >= 25
    assert len({item.kind for item in furnished_room.items}) >= 12
    assert (furnished_room.low_m < furnished_room.high_m).all()


def test_large_surfaces_are_textured(furnished_room: Room) -> None:
    area: dict[str, float] = {}
    for mesh, material in furnished_room.meshes():
        corners = mesh.vertices_m[mesh.faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        largest = float(np.linalg.norm(cross, axis=-1).max())
        if material.texture.shape[:2] == (1, 1) and material.emission == 0:
            area[material.name] = max(area.get(material.name, 0.0), largest)
    assert all(value < 1.0 for value in area.values()), area


def test_paths_keep_train_and_test_apart(furnished_room: Room) -> None:
    shots = sweep_shots(furnished_room, 60, seed=0)
    train = [shot.base_from_camera for shot in shots if shot.split == "train"]
    test = [shot.base_from_camera for shot in shots if shot.split == "test"]
    assert (len(train), len(test)) == (42, 18)
    metres, radians = pose_distance(
        type(train[0]).stack(test)[:, None], type(train[0]).stack(train)[None]
    )
    assert ((metres < 0.05) & (radians < np.deg2rad(5))).any(1).mean() <= 0.10
    assert not ((metres < 0.01) & (radians < np.deg2rad(1))).any()
    eyes = np.stack([pose.translation_m for pose in train + test])
    assert furnished_room.is_free(eyes, 0.05).all()
    reach = np.linalg.norm(eyes - (0.45, 0.0, 0.15), axis=-1)
    assert reach.min() >= 0.8
    assert reach.max() <= 2.5


def test_bumps_have_their_documented_size(furnished_room: Room) -> None:
    for seed, metres, degrees in ((0, 0.005, 0.0), (1, 0.0, 0.5)):
        before, after, bump = fixed_shots(furnished_room, 25, seed)
        assert len(before) == len(after) == 25
        distance, angle = pose_distance(
            before[0].base_from_camera, after[-1].base_from_camera
        )
        assert distance == pytest.approx(metres, abs=1e-9)
        assert np.rad2deg(angle) == pytest.approx(degrees, abs=1e-6)
        expected = before[3].base_from_camera @ bump
        np.testing.assert_allclose(
            expected.matrix(), after[3].base_from_camera.matrix(), atol=1e-12
        )


def test_the_same_seed_gives_the_same_room() -> None:
    a = room("kitchen", 5)
    b = room("kitchen", 5)
    c = room("kitchen", 6)
    assert [item.kind for item in a.items] == [item.kind for item in b.items]
    np.testing.assert_array_equal(a.boxes_m(), b.boxes_m())
    assert a.boxes_m().shape != c.boxes_m().shape or not np.allclose(
        a.boxes_m(), c.boxes_m()
    )


def test_reserved_seeds_and_unknown_kinds_are_refused() -> None:
    with pytest.raises(ValueError, match="reserved"):
        room("living", RESERVED)
    with pytest.raises(ValueError, match="bedroom, kitchen, living"):
        room("garage", 1)
    seeds = [
        seed
        for suite in ("sim", "sim-7", "sim-12", "sim-tune", "sim-unseen", "sim-repeat")
        for *_, seed in SUITES[suite].rooms
    ]
    assert len(set(seeds)) == len(seeds) == 31
    assert max(seeds) < RESERVED
