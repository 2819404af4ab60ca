"""Rooms of identical copies: floor, racks, tables, chairs, curtains. Needs no renderer."""

import numpy as np
import pytest

from rooms.items import Item
from rooms.materials import SIZE
from rooms.paths import WORK_AREA_M, fixed_shots, sweep_shots
from rooms.room import KINDS, REPEATED, Room, room
from rooms.shapes import drape
from rooms.suites import CALIBRATION_FRAMES, SUITES

pytestmark = pytest.mark.slow("rooms", "src/evercal/simulation")

COPIES = {
    "workshop": {"rack": 4, "table": 6, "jar": 12},
    "canteen": {"table": 8, "cupboard": 4, "jar": 12},
    "hall": {"chair": 30, "striped curtain": 8, "jar": 12},
}
"""Smallest number of identical copies, by kind of room and of item."""


@pytest.fixture(
    scope="module", params=SUITES["sim-repeat"].rooms, ids=lambda entry: entry[0]
)
def repeated_room(request: pytest.FixtureRequest) -> Room:
    _, kind, seed = request.param
    return room(kind, seed)


def are_copies(a: Item, b: Item) -> bool:
    """Whether two items have the same shape and surface, up to a shift."""
    if len(a.parts) != len(b.parts):
        return False
    middle_a = a.bounds_m().mean(0)
    middle_b = b.bounds_m().mean(0)
    for (mesh, material), (other, same) in zip(a.parts, b.parts, strict=True):
        if material is not same or mesh.vertices_m.shape != other.vertices_m.shape:
            return False
        moved = mesh.vertices_m - middle_a, other.vertices_m - middle_b
        if not np.allclose(*moved, atol=1e-9) or not np.array_equal(mesh.uv, other.uv):
            return False
    return True


def test_each_room_has_many_identical_copies(repeated_room: Room) -> None:
    for kind, count in COPIES[repeated_room.kind].items():
        items = [item for item in repeated_room.items if item.kind == kind]
        copies = max(sum(are_copies(a, b) for b in items) for a in items)
        assert copies >= count, kind


def test_floors_are_periodic_and_uncovered(repeated_room: Room) -> None:
    (mesh, floor), *rest = [
        part for part in repeated_room.shell if part[1].name == "floor"
    ]
    assert not rest
    assert "carpet" not in {material.name for _, material in repeated_room.shell}
    assert np.ptp(mesh.uv, axis=0) == pytest.approx(np.ptp(mesh.vertices_m, axis=0)[:2])
    one_tile = SIZE // 2
    tiles = floor.texture
    np.testing.assert_array_equal(tiles, np.roll(tiles, (one_tile, one_tile), (0, 1)))
    checkered = not np.array_equal(tiles, np.roll(tiles, one_tile, 1))
    assert checkered == (repeated_room.kind == "hall")
    assert mesh.uv[:, 0].max() / floor.tile_m >= 8


def test_folds_without_a_seed_are_equal() -> None:
    equal = drape(0.6, 2.0, 0.03, 6, None)
    uneven = drape(0.6, 2.0, 0.03, 6, 1)

    def period_error(mesh_points: np.ndarray) -> float:
        front = mesh_points[: len(mesh_points) // 2, 1].reshape(49, 9)[4:-4]
        return float(np.abs(front[8:] - front[:-8]).max())

    assert period_error(equal.vertices_m) < 1e-9
    assert period_error(uneven.vertices_m) > 1e-3


def test_a_chessboard_lies_in_the_work_area(repeated_room: Room) -> None:
    boards = [item for item in repeated_room.items if item.kind == "chessboard"]
    assert len(boards) == (2 if repeated_room.kind == "workshop" else 1)
    low, high = boards[0].bounds_m()
    np.testing.assert_allclose(((low + high) / 2)[:2], WORK_AREA_M[:2], atol=1e-9)
    assert 0 < low[2] < high[2] < 0.01
    squares = boards[0].parts[1][1].texture[32:-32:32, 32:-32:32, 0] > 128
    assert squares.shape == (7, 9)
    np.testing.assert_array_equal(squares, np.indices((7, 9)).sum(0) % 2 == 1)
    if len(boards) == 2:  # the other one hangs on a wall and faces the room
        normal = boards[1].parts[1][0].normals[0]
        middle = boards[1].bounds_m().mean(0)
        assert abs(normal[1]) == pytest.approx(1)
        assert normal[1] * middle[1] < 0
        assert middle[2] > 0.5


def test_cameras_find_free_paths(repeated_room: Room) -> None:
    eyes = [
        shot.base_from_camera.translation_m
        for shot in sweep_shots(repeated_room, 130, 0)
    ]
    assert repeated_room.is_free(np.stack(eyes), 0.05).all()
    assert (
        len(fixed_shots(repeated_room, CALIBRATION_FRAMES, 0).before)
        == CALIBRATION_FRAMES
    )


def test_rooms_for_pretraining_are_unchanged() -> None:
    assert sorted(KINDS) == ["bedroom", "kitchen", "living"]
    assert not KINDS.keys() & REPEATED.keys()
