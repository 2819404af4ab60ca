"""Printed boards: true size, and detected again from the print."""

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.boards.detection import find_board
from evercal.calibration.boards.printing import drawing, write_board
from evercal.errors import InputError
from evercal.recordings.images import read_image

from .printed import APRILGRID, CHARUCO, CHESSBOARD, TAG


@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO, TAG], ids=lambda b: b.kind)
def test_a_print_is_detected_at_its_size(board: Board, tmp_path: Path) -> None:
    file = tmp_path / "board.png"
    write_board(file, board, "a3")
    with Image.open(file) as image:
        dpi = image.info["dpi"][0]
        sheet_mm = sorted(25.4 * pixels / dpi for pixels in image.size)
    assert sheet_mm == pytest.approx([297, 420], abs=0.1)
    view = find_board(read_image(file), board)
    assert isinstance(view, BoardView), view
    millimetres = view.pixels * 25.4 / dpi
    expected = 1000 * view.points_m[:, :2]
    if board is TAG:
        expected[:, 1] *= -1  # y is up
    assert np.ptp(millimetres - expected, axis=0) == pytest.approx([0, 0], abs=0.05)


def test_the_ruler_is_as_long_as_it_says() -> None:
    page, dpi = drawing(TAG)
    rows = np.flatnonzero(
        (np.asarray(page)[:, : page.width * 2 // 3] == 0).mean(1) > 0.6
    )
    dark = np.flatnonzero(~np.asarray(page)[rows[-1]])
    assert (dark[-1] - dark[0]) * 25.4 / dpi == pytest.approx(100, abs=0.2)


def test_pdf_files_have_the_size_of_the_paper(tmp_path: Path) -> None:
    for paper, board, size in (
        ("letter", TAG, [612, 792]),
        ("a3", CHESSBOARD, [1190.6, 841.9]),
    ):
        # The chessboard is wider: landscape.
        write_board(tmp_path / "b.pdf", board, paper)
        content = (tmp_path / "b.pdf").read_bytes()
        box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", content)
        assert box is not None
        assert [float(v) for v in box.groups()] == pytest.approx(size, abs=0.3)


@pytest.mark.parametrize(
    ("board", "paper", "file", "message"),
    [
        (
            Board("chessboard", 0.025, 28, 17),
            "a4",
            "b.pdf",
            "741x479 mm .*; give `paper` a1",
        ),
        (Board("chessboard", 0.2, 28, 17), "a4", "b.pdf", "make the squares smaller"),
        (
            APRILGRID,
            "a4",
            "b.pdf",
            "an aprilgrid is not printed; take the print of Kalibr",
        ),
        (TAG, "a9", "b.pdf", "paper 'a9' is not known; use one of a4"),
        (TAG, "a4", "b.svg", r"b.svg: give a file name that ends with .pdf or .png"),
        (
            Board("apriltag", 0.08, dictionary="APRILTAG_36h11", tag=587),
            "a4",
            "b.pdf",
            "has no marker 587; its numbers are 0 to 586",
        ),
        (
            Board("charuco", 0.02, 12, 10, 0.015, "4X4_50"),
            "a3",
            "b.pdf",
            "4X4_50 has no marker 59; its numbers are 0 to 49",
        ),
    ],
)
def test_boards_that_cannot_be_printed(
    board: Board, paper: str, file: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message):
        write_board(tmp_path / file, board, paper)
    assert not list(tmp_path.iterdir())
