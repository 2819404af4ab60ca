"""Print calibration boards at true size."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.boards.detection import Board, dictionary_of
from evercal.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
FILE_KINDS = (".pdf", ".svg")
_MARGIN_MM, _FOOTER_MM, _RULER_MM = 8.0, 13.0, 100


def black_rectangles(board: Board) -> NDArray[np.float64]:
    """Return the dark parts of a board, (k, 4) x0 y0 x1 y1 in metres: x right, y down in the print.

    The origin is that of the board frame. Rectangles do not overlap.
    """
    if board.kind == "apriltag":
        half = board.size_m / 2
        return _marker(board, board.tag or 0, np.array([-half, -half]), board.size_m)
    if board.kind == "chessboard":
        # The square between the first four inner corners is bright.
        columns, rows, first, start = board.columns + 1, board.rows + 1, 1, -board.size_m
    else:
        columns, rows, first, start = board.columns, board.rows, 0, 0.0
    j, i = np.mgrid[:rows, :columns]
    dark = (i + j) % 2 == first
    squares = start + board.size_m * np.stack([i, j, i + 1, j + 1], -1)
    if board.kind == "chessboard":
        return squares[dark]
    inset = (board.size_m - board.marker_m) / 2
    markers = [
        _marker(board, number, square[:2] + inset, board.marker_m)
        for number, square in enumerate(squares[~dark])
    ]
    return np.concatenate([squares[dark], *markers])


def _marker(board: Board, number: int, start: NDArray, side_m: float) -> NDArray[np.float64]:
    """Return the dark runs of a marker's rows, (k, 4), from its upper left corner `start`."""
    import cv2

    dictionary = dictionary_of(board)
    count = dictionary.markerSize + 2
    if not 0 <= number < len(dictionary.bytesList):
        raise InputError(
            f"{board.dictionary} has no marker {number}; its numbers are 0 to"
            f" {len(dictionary.bytesList) - 1}"
        )
    dark = cv2.aruco.generateImageMarker(dictionary, number, count) < 128
    steps = np.diff(np.pad(dark, ((0, 0), (1, 1))).astype(int), axis=1)
    rows, begins = np.nonzero(steps == 1)
    ends = np.nonzero(steps == -1)[1]
    cells = np.stack([begins, rows, ends, rows + 1], 1)
    return np.tile(start, 2) + side_m / count * cells


def drawing(board: Board, paper: str = "a4") -> "Figure":
    """Draw a board at true size on a sheet, upright or landscape, with a ruler.

    Raises:
        InputError: The paper is not known, or the board does not fit.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    dark = 1000 * black_rectangles(board)
    low, high = dark[:, :2].min(0), dark[:, 2:].max(0)
    width, height = _sheet(board, paper, high - low)
    figure = Figure(figsize=(width / 25.4, height / 25.4), facecolor="white")
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, width), ylim=(height, 0))
    axes.axis("off")
    spare = np.array([width, height - _FOOTER_MM]) - (high - low)
    dark += np.tile(spare / 2 - low, 2)
    ruler_y = height - _MARGIN_MM
    ticks = [
        [_MARGIN_MM + t, ruler_y - 2, _MARGIN_MM + t + 0.2, ruler_y] for t in range(0, 101, 10)
    ]
    bar = [_MARGIN_MM, ruler_y, _MARGIN_MM + _RULER_MM + 0.2, ruler_y + 0.3]
    boxes = np.concatenate([dark, ticks, [bar]])
    # One path, so that no viewer draws seams between parts that touch.
    vertices = boxes[:, [0, 1, 2, 1, 2, 3, 0, 3, 0, 1]].reshape(-1, 2)
    codes = [Outline.MOVETO, *[Outline.LINETO] * 3, Outline.CLOSEPOLY] * len(boxes)
    axes.add_patch(PathPatch(Outline(vertices, codes), fc="black", lw=0, snap=False))
    axes.text(_MARGIN_MM, ruler_y + 1, f"{_RULER_MM} mm: {label(board)}", va="top", fontsize=7)
    return figure


def label(board: Board) -> str:
    """Return the line below a board: the options that detect it."""
    side = f"{1000 * board.size_m:g} mm"
    if board.kind == "chessboard":
        words = f"chessboard, {board.columns}x{board.rows} inner corners, squares of {side}"
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
        raise InputError(f"paper {paper!r} is not known; use one of {', '.join(PAPERS_MM)}")
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
    """Write a board at true size to a PDF or SVG file.

    Raises:
        InputError: The file has another ending, or the board does not fit the paper.
    """
    if path.suffix.lower() not in FILE_KINDS:
        raise InputError(f"{path}: give a file name that ends with {' or '.join(FILE_KINDS)}")
    metadata = {"CreationDate" if path.suffix.lower() == ".pdf" else "Date": None}
    drawing(board, paper).savefig(path, format=path.suffix[1:].lower(), metadata=metadata)
