"""Boards of markers: tags, grids and ChArUco boards.

Images show how markers lie to each other, measured in sides of the nearest marker. That tells the
columns of a board, its first marker and the side of its markers, whatever the lens.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from evercal.calibration.boards.board import Board, dictionary_of
from evercal.calibration.boards.corners import BoardView, Detection
from evercal.calibration.boards.edges import sharpened, squares_by_their_sides
from evercal.typing import Array, BoolArray, Image, IntArray

Plane: TypeAlias = NDArray[np.complexfloating]
"""Vectors x + i y."""

_SQUARE: Plane = np.array([-1 - 1j, 1 - 1j, 1 + 1j, -1 + 1j], dtype=np.complex128) / 2
"""Corners of a marker in OpenCV's order and axes, sides."""
_THRESHOLDS = (15, 40, 7)
"""`adaptiveThreshConstant` of OpenCV: large ones separate markers from squares at their corners."""
_CHARUCO_THRESHOLDS = (7,)
"""The same for ChArUco boards: OpenCV's default."""
_MIN_CORNERS = 6
"""Minimum number of ChArUco corners."""
_NEAREST = 4
"""Number of neighbours of a marker that are compared."""
_MIN_STEPS = 8
"""Minimum number of steps between markers for a judgement on the layout."""
_STEP_ERROR = 0.3
"""Maximum error of a step, relative to its length."""
_AGREEING = 0.8
"""Minimum share of steps that fit the right layout."""
_SIZE_ERROR = 0.03
"""Maximum relative error of a stated side or pitch."""
_MIN_SIDE_PX = 20.0
"""Minimum median side of markers that contradict a stated size."""
_COLUMNS = range(1, 41)
"""Numbers of columns that are tried if the stated one does not fit."""
STYLES = {"aprilgrid": (2, True), "arucogrid": (0, False)}
"""Quarter turns of markers in Kalibr's and OpenCV's prints of a grid, and whether rows go up."""


class OtherBoard(str):
    """A reason that names a board in the image that is not the stated one."""


class Markers(NamedTuple):
    """n markers in an image, and m steps from each to its neighbours in the image."""

    ids: IntArray
    """(n,)"""
    corners: Array
    """(n, 4, 2) pixels, clockwise from the upper left of OpenCV's print."""
    start: IntArray
    """(m,) number of the marker at the start of a step."""
    end: IntArray
    """(m,) number of the marker at its end."""
    steps: Plane
    """(m,) in axes and sides of the marker at the start."""


class MarkerLayout(NamedTuple):
    """How numbered markers lie on a board."""

    columns: int
    """Markers in a row, or squares of a ChArUco board."""
    markers: int
    """Number of markers."""
    first: int = 0
    """Number of the first marker."""
    turn: int = 0
    """Quarter turns of each marker against the rows."""
    up: bool = False
    """Whether row follows row upwards."""
    parity: int | None = None
    """Of column + row of squares that hold markers; None if each cell holds one."""

    def cells(self, ids: IntArray) -> Plane:
        """Return column + i row of the cells of markers (n,)."""
        number = ids - self.first
        # Every second square; with even columns, rows alternate.
        if self.parity is not None:
            row = 2 * number // self.columns * (1 - self.columns % 2)
            number = 2 * number + (self.parity + row) % 2
        return number % self.columns + 1j * (number // self.columns)

    def on_board(self, sides: Plane) -> Plane:
        """Return vectors in axes of a marker in axes of the board."""
        turned = sides * 1j**self.turn
        if self.up:
            return turned.conj()
        return turned

    def has(self, ids: IntArray) -> BoolArray:
        """Return (n,) whether markers are on the board."""
        return (ids >= self.first) & (ids < self.first + self.markers)

    def fit(self, markers: Markers) -> tuple[BoolArray, float]:
        """Return (m,) which steps fit the layout, and the side of a marker in cells."""
        start = self.cells(markers.start)
        steps = self.cells(markers.end) - start
        if len(steps) == 0:
            return np.zeros(0, dtype=bool), 0.0
        lengths = np.abs(steps)
        measured = np.abs(markers.steps)
        side = float(np.median(lengths / measured))
        predicted = side * self.on_board(markers.steps)
        errors = np.abs(predicted - steps)
        on_board = self.has(markers.start)
        on_board &= self.has(markers.end)
        fits = errors < _STEP_ERROR * lengths
        return on_board & fits, side


def find_markers(grey: Image, board: Board) -> Markers:
    """Detect the markers of a board's dictionary, to hundredths of a pixel."""
    borders = [1]
    # Kalibr's tags have a border of two cells. With one, OpenCV reads large ones as well, but
    # places their corners one cell inside.
    if board.kind != "charuco" and board.dictionary.startswith("APRILTAG"):
        borders = [2, 1]
    squares: dict[int, Array] = {}
    for border in borders:
        detected = _detected_markers(grey, board, border)
        squares = max(squares, detected, key=len)
        if _is_complete(detected, board):
            break
    ids = np.array(list(squares), dtype=np.int64)
    corners = np.reshape(list(squares.values()), (-1, 4, 2)).astype(np.float64)
    if squares:
        corners = squares_by_their_sides(grey, corners)
    return Markers(
        ids,
        corners,
        *_steps(ids, corners),
    )


def _detected_markers(
    grey: Image,
    board: Board,
    border: int,
) -> dict[int, Array]:
    """Return the corners of markers with a border of so many cells, by number."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border
    thresholds = _THRESHOLDS
    if board.kind == "charuco":
        thresholds = _CHARUCO_THRESHOLDS
    markers: dict[int, Array] = {}
    for threshold in thresholds:
        parameters.adaptiveThreshConstant = threshold
        detector = cv2.aruco.ArucoDetector(dictionary_of(board), parameters)
        squares, numbers, _ = detector.detectMarkers(grey)
        if numbers is not None:
            # Markers of earlier thresholds keep their corners.
            ids = np.ravel(numbers).astype(int).tolist()
            corners = [np.asarray(square, np.float32) for square in squares]
            markers = dict(zip(ids, corners, strict=True)) | markers
        if _is_complete(markers, board):
            break
    return markers


def _is_complete(markers: Mapping[int, Array], board: Board) -> bool:
    if board.kind == "apriltag" and board.tag is not None:
        return board.tag in markers
    return len(markers) >= max(1, board.columns * board.rows)


def _steps(ids: IntArray, corners: Array) -> tuple[IntArray, IntArray, Plane]:
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
    distances = np.linalg.norm(centres[:, None] - centres, axis=2)
    start = np.repeat(np.arange(n), near)
    end = np.argsort(distances, 1)[:, 1 : near + 1].ravel()
    unit_square = _SQUARE.view(np.float64).reshape(4, 2).astype(np.float32)
    homographies = np.zeros((n, 3, 3))
    for k, square in enumerate(corners.astype(np.float32)):
        homographies[k] = cv2.getPerspectiveTransform(square, unit_square)
    x, y, depth = np.einsum(
        "nij,nj->in",
        homographies[start],
        centres[end],
    )
    return ids[start], ids[end], (x + 1j * y) / depth


def find_tag(grey: Image, board: Board) -> Detection:
    """Detect one tag, or return a reason."""
    markers = find_markers(grey, board)
    ids = markers.ids.tolist()
    matches = [k for k in np.argsort(ids) if board.tag in (None, ids[k])]
    if len(matches) == 1:
        points = _in_space(board.size_m * _SQUARE.conj())
        return BoardView(points, markers.corners[matches[0]])
    if matches:
        names = ", ".join(str(ids[k]) for k in matches)
        return f"several tags ({names}); select one with `tag`"
    reason = f"no tag of {board.dictionary}"
    if board.tag is not None:
        reason = f"no tag {board.tag} of {board.dictionary}"
    if ids:
        reason += f"; it shows {', '.join(map(str, sorted(ids)))}"
    return reason


def _in_space(plane: Plane) -> Array:
    return np.stack([plane.real, plane.imag, 0 * plane.real], -1).reshape(-1, 3)


def find_charuco(grey: Image, board: Board) -> Detection:
    """Detect the corners of squares of a ChArUco board, or return a reason."""
    markers = find_markers(grey, board)
    layout, other = _layout(markers, board)
    if other:
        return other
    size = (board.columns, board.rows)
    dictionary = dictionary_of(board)
    printed = cv2.aruco.CharucoBoard(size, board.size_m, board.marker_m, dictionary)
    printed.setLegacyPattern(layout.parity == 0)
    ids = np.zeros(0, dtype=np.int64)
    pixels = np.zeros((0, 2))
    if len(markers.ids):
        squares = list(markers.corners[:, None].astype(np.float32))
        numbers = markers.ids[:, None].astype(np.int32)
        detector = cv2.aruco.CharucoDetector(printed)
        detected = detector.detectBoard(grey, None, None, squares, numbers)
        if detected[0] is not None and detected[1] is not None:
            pixels = np.reshape(detected[0], (-1, 2)).astype(np.float64)
            ids = np.ravel(detected[1]).astype(np.int64)
    if len(ids) >= _MIN_CORNERS:
        chessboard = np.asarray(printed.getChessboardCorners(), dtype=np.float64)
        points = chessboard[ids]
        extents = np.linalg.svd(points - points.mean(0), compute_uv=False)
        if extents[1] > 0.5 * board.size_m:
            return sharpened(grey, BoardView(points, pixels), board)
    return (
        f"{len(ids)} corners of the ChArUco board; {_MIN_CORNERS} in two rows are required; check"
        f" `size` (squares), `dictionary` ({board.dictionary}), light and focus"
    )


def grid_views(
    found: Mapping[str, Markers], board: Board
) -> tuple[Board, dict[str, Detection]]:
    """Return the board with its first marker, and the corners in each image or a reason."""
    pooled = Markers(*map(np.concatenate, zip(*found.values(), strict=True)))
    layout, other = _layout(pooled, board)
    views: dict[str, Detection] = {}
    for name, markers in found.items():
        use = _consistent(markers, layout)
        if other:
            views[name] = other
        elif use.any():
            cells = layout.cells(markers.ids[use])
            origins = (board.size_m + board.gap_m) * cells
            corners = board.size_m * (layout.on_board(_SQUARE) + 0.5 + 0.5j)
            points = _in_space(origins[:, None] + corners)
            views[name] = BoardView(points, markers.corners[use].reshape(-1, 2))
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


def _layout(markers: Markers, board: Board) -> tuple[MarkerLayout, str]:
    """Return the layout of markers on a board, and the reason if it is not the stated one."""
    count = board.columns * board.rows
    if board.kind == "charuco":
        count = count // 2
    layout = _best(markers, board, [board.columns], count)
    fits, side = layout.fit(markers)
    if len(fits) < _MIN_STEPS:
        return layout, ""
    if fits.mean() < _AGREEING:
        layout = _best(
            markers,
            replace(board, tag=None),
            _COLUMNS,
            1 << 30,
        )
        return layout, _other_layout(markers, board, layout)
    sides_px = np.linalg.norm(np.diff(markers.corners, axis=1), axis=2)
    if np.median(sides_px) < _MIN_SIDE_PX:
        return layout, ""
    if abs(side / board.marker_share - 1) < _SIZE_ERROR:
        return layout, ""
    return layout, _other_size(board, side)


def _other_layout(
    markers: Markers,
    board: Board,
    layout: MarkerLayout,
) -> "OtherBoard":
    """Return the reason for markers that fit another layout, or none."""
    ids = np.unique(markers.ids)
    fits = "they lie on no such board"
    if layout.fit(markers)[0].mean() >= _AGREEING:
        cells = ids[-1] - layout.first + 1
        unit = "markers"
        if board.kind == "charuco":
            cells = 2 * cells
            unit = "squares"
        rows = int(np.ceil(cells / layout.columns))
        fits = f"they fit {layout.columns}x{rows} {unit}"
        if layout.parity == 0:
            fits += ", OpenCV's legacy pattern"
        if board.tag is not None:
            fits += f" from `tag` {layout.first}"
    remedy = "correct `size`"
    if board.tag is not None:
        remedy += " or `tag`"
    return OtherBoard(
        f"markers {ids[0]} to {ids[-1]} are visible, {fits}, not"
        f" {board.columns}x{board.rows}; {remedy}"
    )


def _other_size(board: Board, side: float) -> "OtherBoard":
    """Return the reason for markers whose side, in cells, contradicts the stated sizes."""
    size_mm = 1000 * board.size_m
    if board.kind == "charuco":
        return OtherBoard(
            f"markers measure {size_mm * side:.3g} mm beside squares of {size_mm:g} mm, not"
            f" {1000 * board.marker_m:g}; correct `marker_mm`"
        )
    return OtherBoard(
        f"gaps measure {size_mm / side - size_mm:.3g} mm beside markers of {size_mm:g} mm, not"
        f" {1000 * board.gap_m:g}; correct `gap_mm`"
    )


def _best(
    markers: Markers, board: Board, columns: Iterable[int], count: int
) -> MarkerLayout:
    """Return the layout that fits most steps, in doubt the usual one."""
    layouts: list[MarkerLayout] = []
    for n in columns:
        if board.kind == "charuco":  # parity 0 with even rows: OpenCV before 4.6
            layouts.append(MarkerLayout(n, count, parity=1))
            layouts.append(MarkerLayout(n, count, parity=0))
            continue
        for first in _first_markers(markers, board, count):
            layouts.append(
                MarkerLayout(
                    n,
                    count,
                    first,
                    *STYLES[board.kind],
                )
            )
            for up in (False, True):
                for turn in range(4):
                    layouts.append(MarkerLayout(n, count, first, turn, up))
    return max(layouts, key=lambda layout: layout.fit(markers)[0].sum())


def _first_markers(
    markers: Markers,
    board: Board,
    count: int,
) -> Iterable[int]:
    """Return candidates for the number of the first marker, the usual ones first."""
    if board.tag is not None:
        return [board.tag]
    ids = np.unique(markers.ids).tolist()
    if not ids:
        return [0]
    earliest = max(0, ids[-1] - count + 1)
    return dict.fromkeys([0, *ids[:3], *range(earliest, ids[0])])
