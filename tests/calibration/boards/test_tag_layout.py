"""Layouts of tags: files of several tools, and what images say of them."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evercal.calibration.boards import tag_layout
from evercal.calibration.boards.board import Board
from evercal.calibration.boards.corners import board_pose
from evercal.calibration.boards.marker_layout import Markers
from evercal.calibration.boards.markers import find_markers
from evercal.calibration.boards.tag_layout import Arrangement
from evercal.calibration.boards.tags import corners_of, square
from evercal.errors import InputError
from evercal.geometry import norms

from .layouts import (
    SIZED,
    UNSIZED,
    Written,
    apriltag_ros,
    corner_table,
    corners,
    marker_map,
    quaternion_table,
)
from .tagged import BOX, CAMERA, PLATE, Places, around, photographed, placed

EQUAL: Places = {number: (pose, 0.04) for number, (pose, _) in PLATE.items()}
CORNER: Places = {
    1: (placed(0, 0), 0.05),
    2: (placed(0.07, 0), 0.05),
    3: (placed(0, 0.06, 0, (90, 0, 0)), 0.05),
}
"""Two tags in one plane, one across."""
THINGS = {"plate": PLATE, "box": BOX, "equal": EQUAL}


def board(tag: int, side: float) -> Board:
    return Board("apriltag", side, dictionary="APRILTAG_36h11", tag=tag)


@cache
def images(thing: str, count: int, tilt: float) -> dict[str, Markers]:
    """Markers in images of a thing."""
    places = THINGS[thing]
    middle = np.mean([pose.translation_m for pose, _ in places.values()], 0)
    found = {}
    for i, view in enumerate(around(count, middle, 0, tilt)):
        grey = photographed(places, view, seed=i)[..., 0]
        found[str(i)] = find_markers(grey, board(-1, 0.04))
    return found


def arranged(thing: str, file: Path | None = None, stated: bool = True):
    first, (_, side) = next(iter(THINGS[thing].items()))
    camera = CAMERA if stated else None
    found = images(thing, 16 if thing == "box" else 6, 55 if thing == "box" else 40)
    own = Arrangement(board(first, side), CAMERA.size, camera, file)
    settled, notes = own(found)
    return corners_of(settled), notes


def misfit_mm(own: dict[int, np.ndarray], thing: str) -> float:
    """Largest distance of a corner from its place, after the first tags are aligned."""
    truth = corners(THINGS[thing])
    assert {*own} == {*truth}
    a = np.concatenate([own[number] for number in truth])
    b = np.concatenate([*truth.values()])
    turn = Rotation.align_vectors(b - b.mean(0), a - a.mean(0))[0]
    return 1000 * float(norms(turn.apply(a - a.mean(0)) - b + b.mean(0)).max())


SLOW = pytest.mark.slow("src/evercal/calibration/boards")
FILES = [(write, "plate") for write in SIZED] + [(write, "equal") for write in UNSIZED]
FILES += [
    pytest.param(write, "box", marks=SLOW)
    for write in (apriltag_ros, marker_map, quaternion_table)
]


@pytest.mark.filterwarnings("ignore:Gimbal lock")
@pytest.mark.parametrize(
    ("write", "thing"), FILES, ids=lambda value: getattr(value, "__name__", value)
)
def test_files_of_many_tools_are_read(
    write: Callable[[Places], Written], thing: str, tmp_path: Path
) -> None:
    text, ending = write(THINGS[thing])
    file = tmp_path / f"layout.{ending}"
    file.write_text(text)
    own, notes = arranged(thing, file)
    assert misfit_mm(own, thing) < 0.001
    assert not [note for note in notes if "elsewhere" in note]


@pytest.mark.parametrize(
    ("thing", "most_mm", "stated"),
    [
        ("plate", 0.1, True),
        pytest.param("plate", 0.1, False, marks=SLOW),
        pytest.param("box", 0.6, True, marks=SLOW),
        pytest.param("box", 0.6, False, marks=SLOW),
    ],
)
def test_images_alone_show_a_layout(thing: str, most_mm: float, stated: bool) -> None:
    own, notes = arranged(thing, None, stated)
    assert misfit_mm(own, thing) < most_mm
    first = next(iter(THINGS[thing]))
    assert own[first] == pytest.approx(square(THINGS[thing][first][1]))
    assert "sides by the images" in notes[0]


def test_a_tag_in_one_image(tmp_path: Path) -> None:
    """It decides the axes of a file where the others lie in one plane; alone it has no place."""
    file = tmp_path / "layout.csv"
    file.write_text(quaternion_table(CORNER)[0])
    found = {}
    middle = np.mean([pose.translation_m for pose, _ in CORNER.values()], 0)
    for i, view in enumerate(around(4, middle, 4, 35)):
        grey = photographed(CORNER, view, seed=i)[..., 0]
        found[str(i)] = find_markers(grey, board(-1, 0.04))
    assert sum(3 in markers.ids for markers in found.values()) == 1
    own, notes = Arrangement(board(1, 0.05), CAMERA.size, CAMERA, file)(found)
    right = corners(CORNER)
    for number, points in corners_of(own).items():
        assert points == pytest.approx(right[number] - right[1].mean(0), abs=1e-6)
    assert not notes
    own, notes = Arrangement(board(1, 0.05), CAMERA.size, CAMERA)(found)
    assert corners_of(own).keys() == {1, 2}
    assert "fewer than two images, not used: 3" in notes[1]


def test_tags_of_as_many_images_are_placed_together(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls = []

    def counted(*given: object) -> object:
        calls.append(given)
        return board_pose(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(tag_layout, "board_pose", counted)
    own, _ = arranged("plate")
    assert misfit_mm(own, "plate") < 0.1
    assert len(calls) <= 12


def test_a_layout_that_images_contradict_is_named(tmp_path: Path) -> None:
    moved = dict(PLATE)
    pose, side = moved[7]
    moved[7] = (pose @ type(pose).from_translation([0.002, 0, 0]), side)
    file = tmp_path / "layout.csv"
    file.write_text(quaternion_table(moved)[0])
    _, notes = arranged("plate", file)
    assert "tags lie up to 2." in notes[0]
    assert "mm elsewhere than in layout.csv" in notes[0]
    assert "give `layout` estimate" in notes[0]


def test_a_layout_of_another_thing_is_refused(tmp_path: Path) -> None:
    numbers = [*PLATE]
    swapped = dict(
        zip(numbers, [PLATE[number] for number in numbers[::-1]], strict=True)
    )
    file = tmp_path / "layout.csv"
    file.write_text(corner_table(swapped)[0])
    with pytest.raises(InputError, match="its tags lie elsewhere in the images, by"):
        arranged("plate", file)


def test_a_layout_is_scaled_to_the_stated_side_with_a_word(tmp_path: Path) -> None:
    file = tmp_path / "layout.csv"
    file.write_text(corner_table(PLATE)[0].replace("id,", "number,"))
    found = images("plate", 6, 40)
    _, notes = Arrangement(board(3, 0.05), CAMERA.size, CAMERA, file)(found)
    assert notes[0] == (
        "warning: layout.csv was scaled by 1.25, so that tag 3 measures 50 mm"
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("id,x,y,z\n", "holds 0 things with tags"),
        ("id,x,y,z,foo\n3,0,0,0,1\n", "'foo' of tag 3 is not known"),
        ("id,x,y\n3,0,0\n", "the position of tag 3 has 2 numbers"),
        ("3 0 0 0 1 0\n", "has 6 columns without names"),
        ("id,x,y,z,size\n3,0,0,0\n", "elsewhere in the images|no image shows two"),
        ("id,x,y,z,size\n3.5,0,0,0,1\n", "the number of a tag is whole, got '3.5'"),
        ("id,x,y,z,size\n3,0,0,0,1\n3,1,0,0,1\n", "holds tag 3 twice"),
        ("id,x,y,z,qw,qx,qy,qz\n3,0,0,0,0,0,0,0\n7,1,0,0,0,0,0,0\n", "layout.csv: "),
        ("id,x,y,z,size\n41,0,0,0,1\n42,1,0,0,1\n", "no image shows two of its tags"),
    ],
)
def test_broken_files_are_refused(text: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "layout.csv"
    file.write_text(text)
    with pytest.raises(InputError, match=message):
        arranged("plate", file)


def test_a_number_that_is_visible_twice_is_no_part_of_a_layout() -> None:
    found = images("plate", 6, 40)
    found = dict(found)
    doubled = found["0"].without([12])
    found["0"] = doubled._replace(twice=np.array([12]))
    own, _ = Arrangement(board(3, 0.04), CAMERA.size, CAMERA)(found)
    assert corners_of(own).keys() == {3, 7, 20}


def test_tags_that_are_never_together_are_no_layout() -> None:
    found = {
        name: markers.without([7, 12, 20] if int(name) % 2 else [3])
        for name, markers in images("plate", 6, 40).items()
    }
    with pytest.raises(InputError, match="no two images show tag 3 beside the same"):
        Arrangement(board(3, 0.04), CAMERA.size, CAMERA)(found)
