"""Printed boards: true size, and detected again from the print."""

import re
from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.boards.corners import BoardView
from evercal.calibration.boards.detection import Board, find_board
from evercal.calibration.boards.printing import black_rectangles, drawing, write_board
from evercal.errors import InputError
from evercal.recordings.images import read_image

from .printed import CHARUCO, CHESSBOARD, TAG

DPI = 200


@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO, TAG], ids=lambda b: b.kind)
def test_a_print_is_detected_at_its_size(board: Board, tmp_path: Path) -> None:
    file = tmp_path / "board.png"
    drawing(board, "a3").savefig(file, dpi=DPI)
    view = find_board(read_image(file), board)
    assert isinstance(view, BoardView), view
    millimetres = view.pixels * 25.4 / DPI
    expected = 1000 * view.points_m[:, :2]
    if board.kind == "apriltag":
        expected[:, 1] *= -1  # y is up on a tag
    offset = millimetres - expected
    assert np.ptp(offset, axis=0) == pytest.approx([0, 0], abs=0.1)


def test_files_have_the_size_of_the_paper(tmp_path: Path) -> None:
    write_board(tmp_path / "b.pdf", TAG, "letter")
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", (tmp_path / "b.pdf").read_bytes())
    assert box is not None
    assert [float(v) for v in box.groups()] == pytest.approx([612, 792], abs=0.1)
    write_board(tmp_path / "b.svg", CHESSBOARD, "a3")  # wider than high: landscape
    header = (tmp_path / "b.svg").read_text()[:2000]
    assert re.search(r'width="1190\.\d+pt" height="841\.\d+pt"', header)


def test_rectangles_cover_half_of_a_chessboard() -> None:
    x0, y0, x1, y1 = black_rectangles(CHESSBOARD).T
    assert ((x1 - x0) * (y1 - y0)).sum() == pytest.approx(0.5 * 10 * 7 * 0.03**2)


@pytest.mark.parametrize(
    ("board", "paper", "file", "message"),
    [
        (Board("chessboard", 0.025, 28, 17), "a4", "b.pdf", "741x479 mm .*; give --paper a1"),
        (Board("chessboard", 0.2, 28, 17), "a4", "b.pdf", "make the squares smaller"),
        (TAG, "a9", "b.pdf", "paper 'a9' is not known; use one of a4"),
        (TAG, "a4", "b.png", r"b.png: give a file name that ends with .pdf or .svg"),
        (
            Board("apriltag", 0.08, dictionary="APRILTAG_36h11", tag=587),
            "a4",
            "b.pdf",
            "has no marker 587; its numbers are 0 to 586",
        ),
    ],
)
def test_boards_that_cannot_be_printed(
    board: Board, paper: str, file: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message):
        write_board(tmp_path / file, board, paper)
    assert not list(tmp_path.iterdir())
