"""Print calibration boards at true size."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.boards.board import Board, dictionary_of
from evercal.errors import InputError
from evercal.typing import Image

if TYPE_CHECKING:
    from PIL.Image import Image as Page

PAPERS_MM = {
    "a4": (210.0, 297.0),
    "letter": (215.9, 279.4),
    "legal": (215.9, 355.6),
    "a3": (297.0, 420.0),
    "tabloid": (279.4, 431.8),
    "a2": (420.0, 594.0),
    "a1": (594.0, 841.0),
    "a0": (841.0, 1189.0),
}
"""Width and height of upright paper, smaller sheets first."""
FILE_KINDS = (".pdf", ".png")
_MARGIN_MM = 8.0
_FOOTER_MM = 13.0
_RULER_MM = 100
_DPI = 300.0
"""Approximate resolution; the exact one makes a square a whole number of pixels."""


def board_image(board: Board, unit_px: int) -> Image:
    """Draw a board (h, w) without margin; `unit_px` lie along a square, or a cell of a tag."""
    import cv2

    if board.kind == "chessboard":
        i, j = np.indices((board.rows + 1, board.columns + 1))
        # The square between the first four inner corners is bright.
        bright = np.where((i + j) % 2 == 0, 255, 0).astype(np.uint8)
        return bright.repeat(unit_px, 0).repeat(unit_px, 1)
    if board.is_grid:
        raise InputError(
            f"an {board.kind} is not printed; take the print of Kalibr or OpenCV, or print"
            f" --board charuco"
        )
    dictionary = dictionary_of(board)
    size = (board.columns, board.rows)
    last = size[0] * size[1] // 2 - 1 if board.kind == "charuco" else board.tag or 0
    if not 0 <= last < len(dictionary.bytesList):
        raise InputError(
            f"{board.dictionary} has no marker {last}; its numbers are 0 to"
            f" {len(dictionary.bytesList) - 1}"
        )
    if board.kind == "charuco":
        page = cv2.aruco.CharucoBoard(size, board.size_m, board.marker_m, dictionary)
        drawn = page.generateImage((size[0] * unit_px, size[1] * unit_px))
    else:
        drawn = cv2.aruco.generateImageMarker(dictionary, last, _cells(board) * unit_px)
    return np.asarray(drawn, dtype=np.uint8)


def _cells(board: Board) -> int:
    return dictionary_of(board).markerSize + 2 if board.kind == "apriltag" else 1


def drawing(board: Board, paper: str = "a4") -> "tuple[Page, float]":
    """Draw a board on a sheet, with a ruler; also return the resolution in pixels per inch."""
    from PIL import Image, ImageDraw, ImageFont

    unit_mm = 1000 * board.size_m / _cells(board)
    unit_px = max(1, round(unit_mm * _DPI / 25.4))
    per_mm = unit_px / unit_mm
    picture = board_image(board, unit_px)
    width, height = _sheet(board, paper, np.array(picture.shape[::-1]) / per_mm)
    page = Image.new("1", (round(width * per_mm), round(height * per_mm)), 1)
    left = (page.width - picture.shape[1]) // 2
    top = (page.height - round(_FOOTER_MM * per_mm) - picture.shape[0]) // 2
    page.paste(Image.fromarray(picture), (left, top))
    draw = ImageDraw.Draw(page)
    bottom = height - _MARGIN_MM
    bars = [(0, bottom, _RULER_MM, 0.3)]
    bars += [(tick, bottom - 2, 0.2, 2) for tick in range(0, _RULER_MM + 1, 10)]
    for x, y, wide, high in bars:
        corners = (
            np.array([x + _MARGIN_MM, y, x + _MARGIN_MM + wide, y + high]) * per_mm
        )
        draw.rectangle(corners.round().tolist(), fill=0)
    text_at = (_MARGIN_MM * per_mm, (bottom + 1) * per_mm)
    font = ImageFont.load_default(size=2.5 * per_mm)
    draw.text(text_at, f"{_RULER_MM} mm: {label(board)}", font=font, fill=0)
    return page, 25.4 * per_mm


def label(board: Board) -> str:
    """Return the line below a board: the options that detect it."""
    side = f"{1000 * board.size_m:g} mm"
    if board.kind == "chessboard":
        words = (
            f"chessboard, {board.columns}x{board.rows} inner corners, squares of {side}"
        )
    elif board.kind == "charuco":
        words = (
            f"ChArUco, {board.columns}x{board.rows} squares of {side}, markers of"
            f" {1000 * board.marker_m:g} mm, {board.dictionary}"
        )
    else:
        words = f"tag {board.tag or 0} of {board.dictionary}, black square of {side}"
    return f"{words}. Print at 100 %."


def _sheet(board: Board, paper: str, size_mm: NDArray) -> tuple[float, float]:
    """Return width and height of the sheet, turned if the board fits only or better so."""
    if paper not in PAPERS_MM:
        raise InputError(
            f"paper {paper!r} is not known; use one of {', '.join(PAPERS_MM)}"
        )
    takes = size_mm + np.array([2 * _MARGIN_MM, 2 * _MARGIN_MM + _FOOTER_MM])

    def turned(name: str) -> tuple[float, float] | None:
        short, long = PAPERS_MM[name]
        sheets = [(short, long), (long, short)]
        sheets = sheets[:: 1 if size_mm[0] <= size_mm[1] else -1]
        return next((s for s in sheets if (takes <= np.array(s) + 1e-6).all()), None)

    sheet = turned(paper)
    if sheet is None:
        larger = next((name for name in PAPERS_MM if turned(name)), None)
        remedy = f"give --paper {larger}" if larger else "make the squares smaller"
        raise InputError(
            f"the {board.kind} takes {takes[0]:.0f}x{takes[1]:.0f} mm with margins, {paper} is"
            f" {PAPERS_MM[paper][0]:.0f}x{PAPERS_MM[paper][1]:.0f} mm; {remedy}"
        )
    return sheet


def write_board(path: Path, board: Board, paper: str = "a4") -> None:
    """Write a board at true size to a PDF or PNG file; the resolution is stored in the file."""
    if path.suffix.lower() not in FILE_KINDS:
        raise InputError(
            f"{path}: give a file name that ends with {' or '.join(FILE_KINDS)}"
        )
    page, dpi = drawing(board, paper)
    page.save(path, dpi=(dpi, dpi))
