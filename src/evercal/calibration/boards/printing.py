"""Print calibration boards at true size."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from evercal.calibration.boards.board import Board, dictionary_of
from evercal.calibration.boards.circles import circle_points
from evercal.errors import InputError, optional_module
from evercal.typing import Array, Image, Pair

if TYPE_CHECKING:
    from PIL.Image import Image as PillowImage

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
"""Endings of the files that `write_board` writes."""
_CIRCLE = 0.6
"""Diameter of a circle that is not stated, distances from row to row."""
_MARGIN_MM = 8.0
"""White margin around the board and its footer."""
_FOOTER_MM = 13.0
"""Height of the ruler and the line of text below the board."""
_RULER_MM = 100
"""Length of the ruler."""
_TICK_MM = 10
"""Distance of its ticks."""
_DPI = 300.0
"""Approximate resolution; the exact one makes a square a whole number of pixels."""
_MM_PER_INCH = 25.4
"""Millimetres in an inch."""


def board_image(board: Board, unit_px: int) -> Image:
    """Draw a board (h, w) without margin; `unit_px` lie along a square, or a cell of a tag."""
    import cv2

    if board.kind == "chessboard":
        row, column = np.indices((board.rows + 1, board.columns + 1))
        # The square between the first four inner corners is bright.
        bright = np.where((row + column) % 2 == 0, 255, 0).astype(np.uint8)
        return bright.repeat(unit_px, 0).repeat(unit_px, 1)
    if board.kind in ("circles", "acircles"):
        points = unit_px * (circle_points(board)[:, :2] / board.size_m + 1)
        width, height = points.max(0) + unit_px
        y, x = np.indices((round(height), round(width))) + 0.5
        page = np.full(x.shape, 255, np.uint8)
        radius = unit_px * (board.marker_m or _CIRCLE * board.size_m) / board.size_m / 2
        for at_x, at_y in points:
            page[np.hypot(x - at_x, y - at_y) < radius] = 0
        return page
    if board.is_grid:
        raise InputError(
            f"an {board.kind} is not printed; take the print of Kalibr or OpenCV, or print"
            f" `board` charuco"
        )
    dictionary = dictionary_of(board)
    if board.kind == "charuco":
        _require_marker(
            board,
            board.columns * board.rows // 2 - 1,
        )
        size = (board.columns, board.rows)
        page = cv2.aruco.CharucoBoard(size, board.size_m, board.marker_m, dictionary)
        drawn = page.generateImage((board.columns * unit_px, board.rows * unit_px))
    else:
        number = board.tag or 0
        _require_marker(board, number)
        side_px = _cells(board) * unit_px
        drawn = cv2.aruco.generateImageMarker(dictionary, number, side_px)
    return np.asarray(drawn, np.uint8)


def _require_marker(board: Board, number: int) -> None:
    count = len(dictionary_of(board).bytesList)
    if not 0 <= number < count:
        raise InputError(
            f"{board.dictionary} has no marker {number}; its numbers are 0 to {count - 1}"
        )


def _cells(board: Board) -> int:
    """Number of units along a square or tag."""
    if board.kind == "apriltag":
        return dictionary_of(board).markerSize + 2
    return 1


def drawing(board: Board, paper: str = "a4") -> "tuple[PillowImage, float]":
    """Draw a board on a sheet, with a ruler; also return the resolution in pixels per inch."""
    pillow = optional_module("PIL.Image", "printing a board needs Pillow", "boards")
    unit_mm = 1000 * board.size_m / _cells(board)
    unit_px = max(1, round(unit_mm * _DPI / _MM_PER_INCH))
    px_per_mm = unit_px / unit_mm
    picture = board_image(board, unit_px)
    size_mm = np.array(picture.shape[::-1]) / px_per_mm
    width, height = _sheet(board, paper, size_mm)
    sheet = pillow.new("1", (round(width * px_per_mm), round(height * px_per_mm)), 1)
    left = (sheet.width - picture.shape[1]) // 2
    top = (sheet.height - round(_FOOTER_MM * px_per_mm) - picture.shape[0]) // 2
    sheet.paste(pillow.fromarray(picture), (left, top))
    _draw_footer(
        sheet,
        f"{_RULER_MM} mm: {label(board)}",
        height,
        px_per_mm,
    )
    return sheet, _MM_PER_INCH * px_per_mm


def _draw_footer(
    sheet: "PillowImage", text: str, height_mm: float, px_per_mm: float
) -> None:
    """Draw a ruler with ticks, and a line of text below it."""
    from PIL import ImageDraw, ImageFont

    draw = ImageDraw.Draw(sheet)
    bottom = height_mm - _MARGIN_MM

    def draw_bar(
        x: float,
        y: float,
        width: float,
        height: float,
    ) -> None:
        corners_mm = [x + _MARGIN_MM, y, x + _MARGIN_MM + width, y + height]
        corners = np.array(corners_mm) * px_per_mm
        draw.rectangle(corners.round().tolist(), fill=0)

    draw_bar(0, bottom, _RULER_MM, 0.3)
    for tick in range(0, _RULER_MM + 1, _TICK_MM):
        draw_bar(
            tick,
            bottom - 2,
            0.2,
            2,
        )
    origin = (_MARGIN_MM * px_per_mm, (bottom + 1) * px_per_mm)
    font = ImageFont.load_default(size=2.5 * px_per_mm)
    draw.text(origin, text, font=font, fill=0)


def label(board: Board) -> str:
    """Return the line below a board: the options that detect it."""
    side = f"{1000 * board.size_m:g} mm"
    if board.kind in ("circles", "acircles"):
        words = f"{board.kind}, {board.columns}x{board.rows}, {side} from row to row"
    elif board.kind == "chessboard":
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


def _sheet(
    board: Board,
    paper: str,
    size_mm: Array,
) -> Pair:
    """Return width and height of the sheet, turned if the board fits only or better so."""
    if paper not in PAPERS_MM:
        raise InputError(
            f"paper {paper!r} is not known; use one of {', '.join(PAPERS_MM)}"
        )
    needed = size_mm + np.array([2 * _MARGIN_MM, 2 * _MARGIN_MM + _FOOTER_MM])

    def fitting(name: str) -> Pair | None:
        short, long = PAPERS_MM[name]
        sheets = [(short, long), (long, short)]
        if size_mm[0] > size_mm[1]:
            sheets.reverse()
        for sheet in sheets:
            if (needed <= np.array(sheet) + 1e-6).all():
                return sheet
        return None

    sheet = fitting(paper)
    if sheet:
        return sheet
    remedy = "make the squares smaller"
    for larger in reversed(PAPERS_MM):
        if fitting(larger):
            remedy = f"give `paper` {larger}"
    width, height = PAPERS_MM[paper]
    raise InputError(
        f"the {board.kind} takes {needed[0]:.0f}x{needed[1]:.0f} mm with margins, {paper} is"
        f" {width:.0f}x{height:.0f} mm; {remedy}"
    )


def write_board(
    path: Path,
    board: Board,
    paper: str = "a4",
) -> None:
    """Write a board at true size to a PDF or PNG file; the resolution is stored in the file."""
    if path.suffix.lower() not in FILE_KINDS:
        raise InputError(
            f"{path}: give a file name that ends with {' or '.join(FILE_KINDS)}"
        )
    sheet, dpi = drawing(board, paper)
    sheet.save(path, dpi=(dpi, dpi))
