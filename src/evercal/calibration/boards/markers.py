"""Detect boards of markers: tags, grids and ChArUco boards."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np

from evercal.calibration.boards.board import Board, dictionaries, dictionary_of
from evercal.calibration.boards.corners import BoardView, Detection
from evercal.calibration.boards.edges import sharpened, squares_by_their_sides
from evercal.calibration.boards.marker_layout import (
    SQUARE,
    MarkerLayout,
    Markers,
    OtherSize,
    Plane,
    layout_of,
)
from evercal.classes import frozen_arrays
from evercal.geometry import norms
from evercal.typing import Array, BoolArray, Image, IntArray

_THRESHOLDS = (15, 40, 7)
"""`adaptiveThreshConstant` of OpenCV: large ones separate markers from squares at their corners."""
_CHARUCO_THRESHOLDS = (7,)
"""The same for ChArUco boards: OpenCV's default."""
_MIN_CORNERS = 6
"""Minimum number of ChArUco corners."""
_NEAREST = 4
"""Number of neighbours of a marker that are compared."""


@frozen_arrays
class CharucoView(BoardView):
    """Corners of a ChArUco board, and what is wrong with the size of its markers."""

    other: str = ""
    """Empty for markers of the stated size."""


def sizes_pooled(views: Mapping[str, Detection]) -> dict[str, Detection]:
    """Refuse markers of another size where most images show it."""
    of_charuco = [view for view in views.values() if isinstance(view, CharucoView)]
    doubted = sum(bool(view.other) for view in of_charuco)
    if 2 * doubted <= len(of_charuco):
        return dict(views)
    return {name: getattr(view, "other", "") or view for name, view in views.items()}


def other_dictionary(images: Sequence[Image], board: Board) -> str:
    """Return a hint at another dictionary whose markers most images show, or at mirrored images.

    `images` are (H, W, 3).
    """
    if not board.dictionary:
        return ""
    hint = mirrored_hint(images, board)
    if hint:
        return f"; {hint}"
    best = board.dictionary
    most = 0
    for name in dictionaries():
        count = _visible(images, replace(board, dictionary=name))
        if count > most:
            best = name
            most = count
    if best == board.dictionary:
        return ""
    return f"; markers of {best} are visible: give `dictionary` {best}"


def mirrored_hint(images: Sequence[Image], board: Board) -> str:
    """What to do where mirror images show more markers than images (H, W, 3); empty elsewhere."""
    more = 0
    for image in images:
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        mirror = np.ascontiguousarray(grey[:, ::-1])
        upright, mirrored = (len(find_markers(g, board).ids) for g in (grey, mirror))
        more += mirrored > 2 * upright
    if 2 * more <= len(images):
        return ""
    return "its markers are visible in the mirror image: switch the mirror of the camera off"


def _visible(images: Sequence[Image], board: Board) -> int:
    """Number of markers of the board's dictionary, if most images show one."""
    detector = cv2.aruco.ArucoDetector(dictionary_of(board))
    counts = []
    for image in images:
        ids = detector.detectMarkers(image)[1]
        counts.append(0 if ids is None else len(ids))
    return sum(counts) if np.median(counts) >= 1 else 0


def find_markers(grey: Image, board: Board) -> Markers:
    """Detect the markers of a board's dictionary, to hundredths of a pixel."""
    borders = [1]
    # Kalibr's tags have a border of two cells. With one, OpenCV reads large ones as well, but
    # places their corners one cell inside.
    if board.kind != "charuco" and board.dictionary.startswith("APRILTAG"):
        borders = [2, 1]
    squares: dict[int, list[Array]] = {}
    for border in borders:
        detected = _detected_markers(grey, board, border)
        squares = max(squares, detected, key=len)
        if _is_complete(squares, board):
            break
    once = [number for number, places in squares.items() if len(places) == 1]
    twice = [number for number, places in squares.items() if len(places) > 1]
    ids = np.array(once, np.int64)
    corners = np.array([squares[number][0] for number in once], float)
    if once:
        corners = squares_by_their_sides(grey, corners)
    corners = corners.reshape(-1, 4, 2)
    return Markers(
        ids,
        corners,
        *_steps(ids, corners),
        np.array(twice, np.int64),
    )


def _detected_markers(
    grey: Image,
    board: Board,
    border: int,
) -> dict[int, list[Array]]:
    """Return the corners of markers with a border of so many cells, by number; mostly one each."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border
    thresholds = _THRESHOLDS
    if board.kind == "charuco":
        thresholds = _CHARUCO_THRESHOLDS
    markers: dict[int, list[Array]] = {}
    for threshold in thresholds:
        parameters.adaptiveThreshConstant = threshold
        detector = cv2.aruco.ArucoDetector(dictionary_of(board), parameters)
        squares, numbers, _ = detector.detectMarkers(grey)
        for number, square in zip(np.ravel(numbers), squares, strict=False):
            corners = np.reshape(square, (4, 2)).astype(float)
            places = markers.setdefault(int(number), [])
            # Markers of earlier thresholds keep their corners.
            if not any(_same_place(corners, other) for other in places):
                places.append(corners)
        if _is_complete(markers, board):
            break
    return markers


def _same_place(corners: Array, others: Array) -> bool:
    apart = np.linalg.norm(corners.mean(0) - others.mean(0))
    return bool(apart < np.linalg.norm(others[0] - others[2]) / 2)


def _is_complete(
    markers: Mapping[int, object],
    board: Board,
) -> bool:
    if board.kind == "apriltag":
        return board.tag in markers
    return len(markers) >= max(1, board.columns * board.rows)


def _steps(
    ids: IntArray,
    corners: Array,
) -> tuple[IntArray, IntArray, Plane]:
    """Return start, end and vectors of the steps to the nearest markers, see `Markers`."""
    n = len(ids)
    near = min(_NEAREST, max(n - 1, 0))
    homogeneous = np.pad(
        corners,
        ((0, 0), (0, 0), (0, 1)),
        constant_values=1,
    )
    a, b, c, d = homogeneous.transpose(1, 0, 2)
    centres = np.cross(np.cross(a, c), np.cross(b, d))
    centres = centres / centres[:, 2:]
    distances = norms(centres[:, None] - centres)
    start = np.repeat(np.arange(n), near)
    end = np.argsort(distances, 1)[:, 1 : near + 1].ravel()
    unit_square = SQUARE.view(np.float64).reshape(4, 2).astype(np.float32)
    homographies = np.zeros((n, 3, 3))
    for k, square in enumerate(corners.astype(np.float32)):
        homographies[k] = cv2.getPerspectiveTransform(square, unit_square)
    x, y, depth = np.einsum(
        "nij,nj->in",
        homographies[start],
        centres[end],
    )
    return ids[start], ids[end], (x + 1j * y) / depth


def in_space(plane: Plane) -> Array:
    """Return points (n, 3) of a plane."""
    return np.stack([plane.real, plane.imag, 0 * plane.real], -1).reshape(-1, 3)


def find_charuco(grey: Image, board: Board) -> Detection:
    """Detect the corners of squares of a ChArUco board, or return a reason."""
    markers = find_markers(grey, board)
    layout, other = layout_of(markers, board)
    if other and not isinstance(other, OtherSize):
        return other
    size = (board.columns, board.rows)
    dictionary = dictionary_of(board)
    printed = cv2.aruco.CharucoBoard(size, board.size_m, board.marker_m, dictionary)
    printed.setLegacyPattern(layout.parity == 0)
    ids = np.zeros(0, np.int64)
    pixels = np.zeros((0, 2))
    if len(markers.ids):
        squares = list(markers.corners[:, None].astype(np.float32))
        numbers = markers.ids[:, None].astype(np.int32)
        detector = cv2.aruco.CharucoDetector(printed)
        detected = detector.detectBoard(grey, None, None, squares, numbers)
        if detected[0] is not None and detected[1] is not None:
            pixels = np.reshape(detected[0], (-1, 2)).astype(float)
            ids = np.ravel(detected[1]).astype(np.int64)
    if len(ids) >= _MIN_CORNERS:
        chessboard = np.asarray(printed.getChessboardCorners(), float)
        points = chessboard[ids]
        extents = np.linalg.svd(points - points.mean(0), compute_uv=False)
        if extents[1] > 0.5 * board.size_m:
            view = sharpened(grey, BoardView(points, pixels), board)
            return CharucoView(view.points_m, view.pixels, other)
    return (
        f"{len(ids)} corners of the ChArUco board; {_MIN_CORNERS} in two rows are required; check"
        f" `size` (squares), `dictionary` ({board.dictionary}), light and focus"
    )


def grid_views(
    found: Mapping[str, Markers], board: Board
) -> tuple[Board, dict[str, Detection]]:
    """Return the board with its first marker, and the corners in each image or a reason."""
    pooled = Markers(
        *map(
            np.concatenate,
            zip(*found.values(), strict=True),
        )
    )
    layout, other = layout_of(pooled, board)
    views: dict[str, Detection] = {}
    for name, markers in found.items():
        use = _consistent(markers, layout)
        if other:
            views[name] = other
        elif use.any():
            cells = layout.cells(markers.ids[use])
            origins = (board.size_m + board.gap_m) * cells
            corners = board.size_m * (layout.on_board(SQUARE) + 0.5 + 0.5j)
            points = in_space(origins[:, None] + corners)
            views[name] = BoardView(
                points,
                markers.corners[use].reshape(-1, 2),
            )
        else:
            reason = f"no markers of the grid, {board.dictionary} from {layout.first}"
            views[name] = reason
    return replace(board, tag=layout.first), views


def _consistent(markers: Markers, layout: MarkerLayout) -> BoolArray:
    """Return (n,) which markers are on the board and fit at least half of their neighbours."""
    misfits = markers.start[~layout.fit(markers)[0]]
    use = layout.has(markers.ids)
    for k, number in enumerate(markers.ids):
        use[k] &= 2 * (misfits == number).sum() <= (markers.start == number).sum()
    return use
