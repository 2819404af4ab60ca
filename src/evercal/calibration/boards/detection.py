"""Detect printed boards in images with OpenCV."""

from collections.abc import Callable, Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.boards.edges import sharpened
from evercal.calibration.boards.markers import (
    Markers,
    OtherBoard,
    find_charuco,
    find_markers,
    find_tag,
    grid_views,
)
from evercal.errors import InputError
from evercal.geometry.camera import resize_pixels
from evercal.typing import Array, Image

_LARGEST_CHANGE = 0.3
"""Maximum change of the step from corner to corner, parts of the mean step."""
_LARGEST_DOUBLED_PX = 1400
"""Width of the widest image that is searched again at double size."""
_FEW, _MANY = 4, 20
"""Number of images with another board, and of images without any, after which a search ends."""


def find_board(image: Image, board: Board) -> BoardView | str:
    """Detect the corners of a board in an image (H, W, 3) uint8 RGB, or return a reason."""
    return _settled({"": _look(image, board)}, board)[1][""]


def find_boards(
    names: Sequence[str], read: Callable[[str], Image | str], board: Board
) -> tuple[Board, dict[str, BoardView | str]]:
    """Detect a board in images of one camera; return the corners in each, or a reason.

    `read` returns an image, or the reason why there is none. Also return the board, with its first
    marker. Images are searched in an order that spreads. If none shows the board, InputError; also
    after a few images that show another board.
    """
    order = sorted(range(len(names)), key=lambda i: i * (5**0.5 - 1) / 2 % 1)
    found: dict[str, BoardView | str | Markers] = {}
    settled = board
    views = {}
    for tried, i in enumerate(order, 1):
        found[names[i]] = (
            image if isinstance(image := read(names[i]), str) else _look(image, board)
        )
        if tried == len(names) or (tried <= _MANY and tried % _FEW == 0):
            settled, views = _settled(found, board)
            if any(isinstance(view, BoardView) for view in views.values()):
                continue
            others = [
                name for name, view in views.items() if isinstance(view, OtherBoard)
            ]
            if len(others) >= _FEW or tried in (_MANY, len(names)):
                name = [*others, names[order[0]]][0]
                part = "" if tried == len(names) else f", spread over {len(names)}"
                raise InputError(
                    f"no board in any of {tried} images{part} ({name}: {views[name]})"
                )
    return settled, {name: views[name] for name in names}


def _look(image: Image, board: Board) -> BoardView | str | Markers:
    find = {
        "chessboard": _find_chessboard,
        "charuco": find_charuco,
        "apriltag": find_tag,
    }
    return find.get(board.kind, find_markers)(
        cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), board
    )


def _settled(
    found: dict[str, BoardView | str | Markers], board: Board
) -> tuple[Board, dict[str, BoardView | str]]:
    markers = {name: each for name, each in found.items() if isinstance(each, Markers)}
    views = {
        name: each for name, each in found.items() if not isinstance(each, Markers)
    }
    return grid_views(markers, board) if markers else (board, views)


def _find_chessboard(grey: NDArray, board: Board) -> BoardView | str:
    y, x = np.indices((board.rows, board.columns), dtype=np.float64)
    points = board.size_m * np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)
    for pixels in _chessboard_candidates(grey, (board.columns, board.rows)):
        view = sharpened(grey, BoardView(points, pixels), board)
        grid = view.pixels.reshape(board.rows, board.columns, 2)
        if _is_even(grid):
            if not board.half_turn and not _first_square_is_bright(grey, grid):
                grid = grid[::-1, ::-1]
            return BoardView(points, grid.reshape(-1, 2))
    return _no_chessboard(grey, board)


def _chessboard_candidates(grey: NDArray, size: tuple[int, int]) -> Iterator[Array]:
    """Yield corners (k, 2) by OpenCV's finders, the fastest first."""
    normalized = cv2.CALIB_CB_NORMALIZE_IMAGE
    searches = [
        (cv2.findChessboardCorners, 1, cv2.CALIB_CB_ADAPTIVE_THRESH | normalized),
        (cv2.findChessboardCornersSB, 1, normalized),
        (cv2.findChessboardCornersSB, 2, normalized),  # for small or tilted squares
    ]
    for find, scale, flags in searches[
        : 3 if grey.shape[1] <= _LARGEST_DOUBLED_PX else 2
    ]:
        image = cv2.resize(
            grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC
        )
        detected, pixels = find(image, size, flags=flags)
        if detected:
            yield resize_pixels(pixels.reshape(-1, 2).astype(np.float64), 1 / scale)


def _is_even(grid: Array) -> bool:
    for axis in (0, 1):
        steps = np.diff(grid, axis=axis)
        change = np.linalg.norm(np.diff(steps, axis=axis), axis=2)
        if (change > _LARGEST_CHANGE * np.linalg.norm(steps, axis=2).mean()).any():
            return False
    return True


def _no_chessboard(grey: NDArray, board: Board) -> str:
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE
    detected, pixels, meta = cv2.findChessboardCornersSBWithMeta(grey, (3, 3), flags)
    wanted = f"not {board.columns}x{board.rows} inner corners"
    if not detected:
        return f"no chessboard with {wanted[4:]}; show the whole board, sharp and without glare"
    rows, columns = np.shape(meta)[:2]
    grid = np.reshape(pixels, (rows, columns, 2))
    for _ in range(2):  # beyond the last corners lie the edges of the board
        grid = np.concatenate(
            [2 * grid[:1] - grid[1:2], grid, 2 * grid[-1:] - grid[-2:-1]]
        )
        grid = grid.transpose(1, 0, 2)
    size = f"{columns}x{rows} inner corners"
    if ((grid < 0) | (grid > np.array(grey.shape[::-1]) - 1)).any():
        return (
            f"a part of a chessboard, {size}, cut by the border of the image, {wanted}; show the"
            f" whole board, or correct --size"
        )
    return OtherBoard(
        f"a chessboard or a part of one, {size}, {wanted}; show the whole board, or correct --size"
    )


def _first_square_is_bright(grey: NDArray, grid: Array) -> bool:
    middle = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    small = cv2.boxFilter(grey, -1, (3, 3))
    x, y = np.round(middle).astype(int).transpose(2, 0, 1)
    values = small[np.clip(y, 0, grey.shape[0] - 1), np.clip(x, 0, grey.shape[1] - 1)]
    even = np.add.outer(np.arange(values.shape[0]), np.arange(values.shape[1])) % 2 == 0
    return float(values[even].mean()) > float(values[~even].mean())
