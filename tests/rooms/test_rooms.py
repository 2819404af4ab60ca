"""Rooms and camera paths in them. Needs no renderer."""

import numpy as np
import pytest

from evercal.geometry import SE3, pose_distance
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
    for mesh, material in furnished_room.meshes():
        if material.texture.shape[:2] == (1, 1) and material.emission == 0:
            a, b, c = np.moveaxis(mesh.vertices_m[mesh.faces], 1, 0)
            areas = np.linalg.norm(np.cross(b - a, c - a), axis=-1)
            assert areas.max() < 1.0, material.name


def test_paths_keep_train_and_test_apart(furnished_room: Room) -> None:
    shots = sweep_shots(furnished_room, 60, seed=0)
    train = [shot.base_from_camera for shot in shots if shot.split == "train"]
    test = [shot.base_from_camera for shot in shots if shot.split == "test"]
    assert (len(train), len(test)) == (42, 18)
    metres, radians = pose_distance(SE3.stack(test)[:, None], SE3.stack(train)[None])
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
    one = room("kitchen", 5)
    again = room("kitchen", 5)
    assert [item.kind for item in one.items] == [item.kind for item in again.items]
    np.testing.assert_array_equal(one.boxes_m(), again.boxes_m())
    assert not np.array_equal(one.boxes_m(), room("kitchen", 6).boxes_m())


def test_reserved_seeds_and_unknown_kinds_are_refused() -> None:
    with pytest.raises(ValueError, match="reserved"):
        room("living", RESERVED)
    with pytest.raises(ValueError, match="bedroom, kitchen, living"):
        room("garage", 1)
    seeds = []
    for suite in ("sim", "sim-7", "sim-12", "sim-tune", "sim-unseen", "sim-repeat"):
        seeds += [seed for *_, seed in SUITES[suite].rooms]
    assert len(set(seeds)) == len(seeds) == 31
    assert max(seeds) < RESERVED
