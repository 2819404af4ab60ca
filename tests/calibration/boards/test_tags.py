"""Tags of several numbers: one board only if they are said to be."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.boards.detection import Found, find_boards
from evercal.cli import main
from evercal.errors import InputError

from .tagged import PLATE, Places, around, photographed, placed

CENTRE = np.array([0.06, -0.045, 0])
VIEWS = around(3, CENTRE, seed=2)
DICTIONARIES = (
    "APRILTAG_36h11",
    "APRILTAG_25h9",
    "APRILTAG_16h5",
    "4X4_50",
    "5X5_100",
    "6X6_250",
    "ARUCO_ORIGINAL",
)


def shown(plates: list[Places], dictionary: str, tag: int | None = None) -> Found:
    """Find a tag in images of one plate after the other."""
    images = {
        f"{i}.png": photographed(plate, VIEWS[i % 3], seed=i, dictionary=dictionary)
        for i, plate in enumerate(plates)
    }
    board = Board("apriltag", 0.04, dictionary=dictionary, tag=tag)
    return find_boards(list(images), images.__getitem__, board)


def only(*numbers: int) -> Places:
    """Tags of these numbers, side by side."""
    return {number: (placed(0.07 * k, -0.04), 0.04) for k, number in enumerate(numbers)}


@pytest.mark.parametrize("dictionary", DICTIONARIES)
def test_tags_of_several_numbers_are_refused_by_name(dictionary: str) -> None:
    plates = [only(2, 11), only(2), only(2, 11)]
    with pytest.raises(InputError) as raised:
        shown(plates, dictionary)
    text = str(raised.value)
    assert "2 in 3, 11 in 2 images" in text
    assert "`tag` N" in text
    assert "`layout` FILE" in text


@pytest.mark.parametrize("dictionary", ["APRILTAG_36h11", "4X4_50"])
def test_numbers_that_change_from_image_to_image_are_not_one_board(
    dictionary: str,
) -> None:
    with pytest.raises(InputError, match="0 in 2, 1 in 1 images"):
        shown([only(0), only(1), only(0)], dictionary)


def test_the_stated_number_is_taken_in_all_images() -> None:
    found = shown([only(2, 11), only(2), only(11)], "APRILTAG_36h11", tag=11)
    kinds = [isinstance(view, BoardView) for view in found.views.values()]
    assert kinds == [True, False, True]
    assert found.views["1.png"] == "no tag 11 of APRILTAG_36h11; it shows 2"


def test_one_number_needs_no_choice() -> None:
    found = shown([only(7)] * 3, "APRILTAG_36h11")
    assert found.board.tag == 7
    assert not found.notes


@pytest.mark.parametrize("number", [5, 0])
@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("dictionary", ["APRILTAG_36h11", "5X5_100"])
def test_a_number_that_is_visible_twice_is_named(
    number: int, stated: bool, dictionary: str
) -> None:
    # `photographed` draws numbers modulo 1000.
    twice = only(number, number + 1000)
    with pytest.raises(InputError, match=f"tag {number} is visible twice in 2 of 3"):
        shown([twice, only(number), twice], dictionary, number if stated else None)


def test_a_single_image_with_two_is_left_out_and_named() -> None:
    found = shown([only(5, 1005), only(5), only(5)], "APRILTAG_36h11")
    assert found.views["0.png"] == "tag 5 is visible twice"
    assert found.notes == ("marker 5 is visible twice in 1 images and not used there",)


def test_the_command_line_names_tags_and_the_way_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for i, view in enumerate(around(6, CENTRE, seed=3)):
        image = photographed(PLATE, view, seed=i)
        cv2.imwrite(str(tmp_path / f"{i}.png"), image)
    out = tmp_path / "board.json"
    detect = ["detect", str(tmp_path), "--board", "apriltag", "--square-mm", "40"]
    detect += ["--out", str(out)]
    assert main(detect) == 2
    error = capsys.readouterr().err
    assert "--tag N takes one of them, --layout FILE or --layout estimate" in error
    assert not out.exists()
    assert main([*detect, "--layout", "estimate", "--tag", "3"]) == 0
    text = capsys.readouterr().out
    assert "sides by the images, mm: 3 40.00, 7 " in text
    again = ["--tag", "7", "--layout", str(out)]
    assert main([*detect, *again]) == 0
    wrong = [*detect[:2], "--board", "charuco", *detect[4:], "--layout", "estimate"]
    wrong += ["--size", "5x4", "--marker-mm", "20"]
    assert main(wrong) == 2
    assert "--layout: give --board apriltag" in capsys.readouterr().err
