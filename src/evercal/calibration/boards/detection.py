"""Detect printed boards in images with OpenCV."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.circles import find_circles
from evercal.calibration.boards.corners import BoardView, Detection
from evercal.calibration.boards.edges import sharpened
from evercal.calibration.boards.marker_layout import Markers, OtherBoard
from evercal.calibration.boards.markers import (
    find_charuco,
    find_markers,
    grid_views,
    mirrored_hint,
    other_dictionary,
    sizes_pooled,
)
from evercal.calibration.boards.tags import tag_views, twice_notes
from evercal.errors import InputError
from evercal.geometry import norms
from evercal.geometry.camera import resize_pixels
from evercal.typing import Array, Image, Size, Strings

_MAX_CHANGE = 0.3
"""Maximum change of the step from corner to corner, relative to the mean step."""
_MAX_DOUBLED_PX = 1400
"""Maximum width of an image that is searched again at double size."""
_FEW_IMAGES = 4
"""Number of images that show another board, after which a search ends."""
_HINT_IMAGES = 3
"""Number of images in which markers of other dictionaries are searched then."""
_MANY_IMAGES = 20
"""Number of images without any board, after which a search ends."""


class Found(NamedTuple):
    """A board in images of one camera."""

    board: Board
    """With the number of its first marker, and its layout."""
    views: dict[str, Detection]
    """Corners in each image, or a reason."""
    notes: Strings = ()
    """What is not used, a line each."""


def find_board(image: Image, board: Board) -> Detection:
    """Detect the corners of a board in an image (H, W, 3) uint8 RGB, or return a reason."""
    try:
        return _settled({"": _look(image, board)}, board).views[""]
    except InputError as error:
        return str(error)


def find_boards(
    names: Sequence[str],
    read: Callable[[str], Image | str],
    board: Board,
    arrange: Callable[[Mapping[str, Markers]], tuple[Board, Strings]] | None = None,
) -> Found:
    """Detect a board in images of one camera; return the corners in each, or a reason.

    `read` returns an image, or the reason why there is none. Also return the board, with its first
    marker. Images are searched in an order that spreads. If none shows the board, InputError; also
    after a few images that show another board. `arrange` returns the board with a layout of the
    tags in all images.
    """
    order = sorted(
        range(len(names)),
        key=lambda i: i * (5**0.5 - 1) / 2 % 1,
    )
    looked: dict[str, Detection | Markers] = {}
    found = Found(board, {})
    for tried, i in enumerate(order, 1):
        image = read(names[i])
        looked[names[i]] = image if isinstance(image, str) else _look(image, board)
        last = tried == len(names)
        early = tried <= _MANY_IMAGES and tried % _FEW_IMAGES == 0
        if early and not last and _shows_tags(looked, board):
            continue
        if last or early:
            notes: Strings = ()
            if last and arrange:
                board, notes = arrange(_markers(looked))
            found = _settled(looked, board)
            found = found._replace(notes=notes + found.notes)
            views = found.views
            reason = _no_board(views, len(names))
            if reason and any(isinstance(view, OtherBoard) for view in views.values()):
                raise InputError(reason)
            if reason:
                shown = _readable(read, [names[k] for k in order[:_HINT_IMAGES]])
                raise InputError(reason + other_dictionary(shown, board))
            if last and board.gap_m and _few_markers(views, board):
                shown = _readable(read, [names[k] for k in order[:_HINT_IMAGES]])
                hint = mirrored_hint(shown, board)
                if hint:
                    raise InputError(hint)
    ordered = {name: found.views[name] for name in names}
    return found._replace(views=ordered)


def _readable(read: Callable[[str], Image | str], names: Sequence[str]) -> list[Image]:
    images = map(read, names)
    return [image for image in images if not isinstance(image, str)]


def _few_markers(views: Mapping[str, Detection], board: Board) -> bool:
    """Whether most images show less than half of a grid: some markers decode in mirror images."""
    shown = [len(v.pixels) for v in views.values() if isinstance(v, BoardView)]
    return bool(np.median(shown) < 2 * board.columns * board.rows)


def _markers(looked: Mapping[str, Detection | Markers]) -> dict[str, Markers]:
    return {name: own for name, own in looked.items() if isinstance(own, Markers)}


def _shows_tags(
    looked: Mapping[str, Detection | Markers],
    board: Board,
) -> bool:
    """Whether tags are visible, which all images settle."""
    if board.kind != "apriltag":
        return False
    shown = [{*own.ids, *own.twice} for own in _markers(looked).values()]
    return any(own if board.tag is None else board.tag in own for own in shown)


def _no_board(
    views: Mapping[str, Detection],
    count: int,
) -> str:
    """Reason to refuse `count` images: all, many or a few of another board were searched in vain.

    It is empty otherwise.
    """
    others = []
    for name, view in views.items():
        if isinstance(view, BoardView):
            return ""
        if isinstance(view, OtherBoard):
            others.append(name)
    tried = len(views)
    if len(others) < _FEW_IMAGES and tried not in (_MANY_IMAGES, count):
        return ""
    name = [*others, *views][0]
    spread = ""
    if tried < count:
        spread = f", spread over {count}"
    return f"no board in any of {tried} images{spread} ({name}: {views[name]})"


def _look(
    image: Image,
    board: Board,
) -> Detection | Markers:
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    if board.kind == "chessboard":
        return _find_chessboard(grey, board)
    if board.kind in ("circles", "acircles"):
        return find_circles(grey, board)
    if board.kind == "charuco":
        return find_charuco(grey, board)
    return find_markers(grey, board)


def _settled(
    found: Mapping[str, Detection | Markers],
    board: Board,
) -> Found:
    """Settle the board with its first marker, and the views; markers of all images decide."""
    markers = _markers(found)
    views: dict[str, Detection] = {}
    for name, detection in found.items():
        if not isinstance(detection, Markers):
            views[name] = detection
    if not markers:
        return Found(board, sizes_pooled(views))
    settle = grid_views
    if board.kind == "apriltag":
        settle = tag_views
    settled, of_markers = settle(markers, board)
    return Found(settled, of_markers | views, twice_notes(markers.values()))


def _find_chessboard(grey: Image, board: Board) -> Detection:
    size = (board.columns, board.rows)
    y, x = np.indices(size[::-1], dtype=float)
    squares = np.stack([x, y, np.zeros_like(x)], -1)
    points = board.size_m * squares.reshape(-1, 3)
    for pixels in _chessboard_candidates(grey, size):
        view = BoardView(points, pixels)
        view = sharpened(grey, view, board)
        grid = view.pixels.reshape(board.rows, board.columns, 2)
        if not _is_even(grid):
            continue
        if not board.half_turn and not _first_square_is_bright(grey, grid):
            grid = grid[::-1, ::-1]
        return BoardView(points, grid.reshape(-1, 2))
    return _no_chessboard(grey, board)


def _chessboard_candidates(
    grey: Image,
    size: Size,
) -> Iterator[Array]:
    """Yield corners (k, 2) by OpenCV's finders, the fastest first."""
    normalized = cv2.CALIB_CB_NORMALIZE_IMAGE
    adaptive = cv2.CALIB_CB_ADAPTIVE_THRESH | normalized
    searches = [
        (cv2.findChessboardCorners, 1, adaptive),
        (cv2.findChessboardCornersSB, 1, normalized),
    ]
    if grey.shape[1] <= _MAX_DOUBLED_PX:  # for small or tilted squares
        searches.append((cv2.findChessboardCornersSB, 2, normalized))
    cubic = cv2.INTER_CUBIC
    for find, scale, flags in searches:
        image = cv2.resize(
            grey,
            None,
            fx=scale,
            fy=scale,
            interpolation=cubic,
        )
        detected, pixels = find(image, size, flags=flags)
        if detected:
            yield resize_pixels(
                pixels.reshape(-1, 2).astype(float),
                1 / scale,
            )


def _is_even(grid: Array) -> bool:
    """Whether the steps from corner to corner change little along rows and columns."""
    for axis in (0, 1):
        steps = np.diff(grid, axis=axis)
        changes = norms(np.diff(steps, axis=axis))
        mean = norms(steps).mean()
        if (changes > _MAX_CHANGE * mean).any():
            return False
    return True


def _no_chessboard(grey: Image, board: Board) -> str:
    """Return the reason for a chessboard that was not detected."""
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE
    detected, pixels, meta = cv2.findChessboardCornersSBWithMeta(grey, (3, 3), flags)
    stated = f"{board.columns}x{board.rows} inner corners"
    if not detected:
        return (
            f"no chessboard with {stated}; show the whole board, sharp and without"
            f" glare"
        )
    rows, columns = np.shape(meta)[:2]
    size = f"{columns}x{rows} inner corners"
    corners = np.asarray(pixels, np.float32).reshape(rows, columns, 2)
    outline = _with_border(corners)
    height, width = grey.shape
    if (outline < 0).any() or (outline > (width - 1, height - 1)).any():
        return (
            f"a part of a chessboard, {size}, cut by the border of the image, not {stated}; show"
            f" the whole board, or correct `size`"
        )
    return OtherBoard(
        f"a chessboard or a part of one, {size}, not {stated}; show the whole board, or correct"
        f" `size`"
    )


def _with_border(grid: Array) -> Array:
    """Extrapolate a grid of corners (rows, columns, 2) by a square, to the edges of the board."""
    for _ in range(2):
        first = 2 * grid[:1] - grid[1:2]
        last = 2 * grid[-1:] - grid[-2:-1]
        grid = np.concatenate([first, grid, last]).transpose(1, 0, 2)
    return grid


def _first_square_is_bright(grey: Image, grid: Array) -> bool:
    """Whether the first inner square, and every second one, is brighter than the others."""
    rows = grid[:-1] + grid[1:]
    middle = rows[:, :-1] + grid[:-1, 1:] + grid[1:, 1:]
    middle = middle / 4
    smooth = cv2.boxFilter(
        grey,
        -1,
        (3, 3),
    )
    height, width = grey.shape
    x, y = np.moveaxis(
        np.round(middle).astype(int),
        2,
        0,
    )
    x = np.clip(x, 0, width - 1)
    y = np.clip(y, 0, height - 1)
    values = smooth[y, x]
    row, column = np.indices(values.shape)
    even = (row + column) % 2 == 0
    bright = values[even].mean()
    dark = values[~even].mean()
    return float(bright) > float(dark)
