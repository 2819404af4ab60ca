"""Boards of markers: tags, grids and ChArUco boards.

Images show how markers lie to each other, measured in sides of the nearest marker. That tells the
columns of a board, its first marker and the side of its markers, whatever the lens.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from evercal.calibration.boards.board import Board, dictionary_of
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.boards.edges import sharpened, squares_by_their_sides
from evercal.typing import Array, BoolArray, IntArray

Plane = NDArray[np.complexfloating]
"""x + i y."""

_SQUARE: Plane = np.array([-1 - 1j, 1 - 1j, 1 + 1j, -1 + 1j], dtype=np.complex128) / 2
"""Corners of a marker in OpenCV's order and axes, sides."""
_THRESHOLDS = (15, 40, 7)
"""Constants of OpenCV's threshold: large ones separate markers from squares at their corners."""
_MIN_CORNERS = 6
"""Minimum number of ChArUco corners."""
_NEAREST, _FEWEST_STEPS = 4, 8
"""Number of neighbours of a marker that are compared; minimum number of steps for a size."""
_OFF, _AGREEING = 0.3, 0.8
"""Largest error of a step, parts of it, and the smallest share of steps without it."""
_SIZE_OFF, _LEAST_SIDE_PX = 0.03, 20.0
"""Largest error of a stated side or pitch, relative; smallest markers that contradict one."""
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


class Layout(NamedTuple):
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
        return turned.conj() if self.up else turned

    def has(self, ids: IntArray) -> BoolArray:
        """Return (n,) whether markers are on the board."""
        return (ids >= self.first) & (ids < self.first + self.markers)

    def fit(self, markers: Markers) -> tuple[BoolArray, float]:
        """Return (m,) which steps fit the layout, and the side of a marker in cells."""
        wanted = self.cells(markers.end) - self.cells(markers.start)
        side = float(
            np.median(
                np.append(
                    np.abs(wanted) / np.abs(markers.steps), [0.0][: not len(wanted)]
                )
            )
        )
        off = np.abs(side * self.on_board(markers.steps) - wanted)
        inside = self.has(markers.start) & self.has(markers.end)
        return inside & (off < _OFF * np.abs(wanted)), side


def find_markers(grey: NDArray, board: Board) -> Markers:
    """Detect the markers of a board's dictionary, to hundredths of a pixel."""
    dictionary = dictionary_of(board)
    parameters = cv2.aruco.DetectorParameters()
    count = board.columns * board.rows if board.is_grid else 1
    found: dict[int, Array] = {}
    # Kalibr's tags have a border of two cells. With one, OpenCV reads large ones as well, but
    # places their corners one cell inside.
    kalibr = board.kind != "charuco" and board.dictionary.startswith("APRILTAG")
    for border in (2, 1) if kalibr else (1,):
        parameters.markerBorderBits = border
        read = dict[int, Array]()
        done = False
        for threshold in _THRESHOLDS if board.kind != "charuco" else (7,):
            parameters.adaptiveThreshConstant = threshold
            detector = cv2.aruco.ArucoDetector(dictionary, parameters)
            squares, numbers, _ = detector.detectMarkers(grey)
            ids = (
                [] if numbers is None else [int(number) for number in np.ravel(numbers)]
            )
            read = {**dict(zip(ids, map(np.asarray, squares), strict=True)), **read}
            done = len(read) >= count and (
                board.kind != "apriltag" or board.tag in {None, *read}
            )
            if done:
                break
        found = max(found, read, key=len)
        if done:
            break
    ids = np.array([*found], dtype=np.int64)
    corners = np.reshape([*found.values()], (-1, 4, 2)).astype(np.float64)
    corners = squares_by_their_sides(grey, corners) if found else corners
    return Markers(ids, corners, *_steps(ids, corners))


def _steps(ids: IntArray, corners: Array) -> tuple[IntArray, IntArray, Plane]:
    n = len(ids)
    near = min(_NEAREST, max(len(ids) - 1, 0))
    ends = np.pad(corners, ((0, 0), (0, 0), (0, 1)), constant_values=1)
    middle = np.cross(
        np.cross(ends[:, 0], ends[:, 2]), np.cross(ends[:, 1], ends[:, 3])
    )
    middle = middle / middle[:, 2:]
    apart = np.linalg.norm(middle[:, None] - middle, axis=2)
    start = np.repeat(np.arange(n), near)
    end = np.argsort(apart, 1)[:, 1 : near + 1].ravel()
    square = np.stack([_SQUARE.real, _SQUARE.imag], 1).astype(np.float32)
    maps = [cv2.getPerspectiveTransform(c.astype(np.float32), square) for c in corners]
    x, y, depth = np.einsum(
        "nij,nj->in", np.reshape(maps, (-1, 3, 3))[start], middle[end]
    )
    return ids[start], ids[end], (x + 1j * y) / depth


def find_tag(grey: NDArray, board: Board) -> BoardView | str:
    """Detect one tag, or return a reason."""
    markers = find_markers(grey, board)
    tags = markers.ids.tolist()
    matches = [k for k, tag in enumerate(tags) if board.tag in (None, tag)]
    if not matches:
        others = f"; it shows {', '.join(map(str, sorted(tags)))}" if tags else ""
        tag = "no tag" if board.tag is None else f"no tag {board.tag}"
        return f"{tag} of {board.dictionary}{others}"
    if len(matches) > 1:
        names = ", ".join(map(str, sorted(tags[k] for k in matches)))
        return f"several tags ({names}); select one with --tag"
    return BoardView(
        _in_space(board.size_m * _SQUARE.conj()), markers.corners[matches[0]]
    )


def _in_space(plane: Plane) -> Array:
    return np.stack([plane.real, plane.imag, 0 * plane.real], -1).reshape(-1, 3)


def find_charuco(grey: NDArray, board: Board) -> BoardView | str:
    """Detect the corners of squares of a ChArUco board, or return a reason."""
    markers = find_markers(grey, board)
    layout, wrong = _layout(markers, board)
    if wrong:
        return wrong
    size = (board.columns, board.rows)
    printed = cv2.aruco.CharucoBoard(
        size, board.size_m, board.marker_m, dictionary_of(board)
    )
    printed.setLegacyPattern(layout.parity == 0)
    found = (
        list(markers.corners[:, None].astype(np.float32)),
        markers.ids[:, None].astype(np.int32),
    )
    detector = cv2.aruco.CharucoDetector(printed)
    pixels, ids = (
        detector.detectBoard(grey, None, None, *found)[:2] if found[0] else (None, None)
    )
    count = 0 if ids is None or pixels is None else len(ids)
    if count >= _MIN_CORNERS:
        every = np.asarray(printed.getChessboardCorners(), dtype=np.float64)
        points = every[np.asarray(ids, dtype=np.int64).ravel()]
        corners = np.reshape(np.asarray(pixels), (-1, 2)).astype(np.float64)
        flat = np.linalg.svd(points - points.mean(0), compute_uv=False)
        if flat[1] > 0.5 * board.size_m:
            return sharpened(grey, BoardView(points, corners), board)
    return (
        f"{count} corners of the ChArUco board; {_MIN_CORNERS} in two rows are required; check"
        f" --size (squares), --dictionary ({board.dictionary}), light and focus"
    )


def grid_views(
    found: Mapping[str, Markers], board: Board
) -> tuple[Board, dict[str, BoardView | str]]:
    """Return the board with its first marker, and the corners in each image or a reason."""
    pooled = Markers(
        *(np.concatenate(part) for part in zip(*found.values(), strict=True))
    )
    layout, wrong = _layout(pooled, board)
    views: dict[str, BoardView | str] = {}
    for name, markers in found.items():
        bad = markers.start[~layout.fit(markers)[0]]
        near = [2 * (bad == k).sum() <= (markers.start == k).sum() for k in markers.ids]
        use = layout.has(markers.ids) & np.array(near, dtype=bool)
        if wrong or not use.any():
            views[name] = (
                wrong
                or f"no markers of the grid, {board.dictionary} from {layout.first}"
            )
            continue
        middle = (board.size_m + board.gap_m) * layout.cells(markers.ids[use])
        around = board.size_m * (layout.on_board(_SQUARE) + 0.5 + 0.5j)
        points = _in_space(middle[:, None] + around)
        views[name] = BoardView(points, markers.corners[use].reshape(-1, 2))
    return replace(board, tag=layout.first), views


def _layout(markers: Markers, board: Board) -> tuple[Layout, str]:
    """Return the layout of markers on a board, and the reason if it is not the stated one."""
    ids = np.unique(markers.ids)
    size = 1000 * board.size_m
    charuco = board.kind == "charuco"
    count = board.columns * board.rows // (2 if charuco else 1)
    layout = _best(markers, board, [board.columns], count)
    good, side = layout.fit(markers)
    if len(good) >= _FEWEST_STEPS and good.mean() < _AGREEING:
        layout = _best(markers, replace(board, tag=None), _COLUMNS, 1 << 30)
        fits = "they lie on no such board"
        if layout.fit(markers)[0].mean() >= _AGREEING:
            rows = -(
                -(ids[-1] - layout.first + 1) * (2 if charuco else 1) // layout.columns
            )
            older = ", OpenCV's legacy pattern" if layout.parity == 0 else ""
            older += "" if board.tag is None else f" from --tag {layout.first}"
            fits = f"they fit {layout.columns}x{rows} {'squares' if charuco else 'markers'}{older}"
        return layout, OtherBoard(
            f"markers {ids[0]} to {ids[-1]} are visible, {fits}, not"
            f" {board.columns}x{board.rows}; correct --size"
            + " or --tag"
            * (board.tag is not None)
        )
    long = np.linalg.norm(np.diff(markers.corners, axis=1), axis=2)
    few = len(good) < _FEWEST_STEPS or np.median(long) < _LEAST_SIDE_PX
    if few or abs(side / board.marker_share - 1) < _SIZE_OFF:
        return layout, ""
    gap = size / side - size
    marker = size * side
    return layout, OtherBoard(
        f"markers measure {marker:.3g} mm beside squares of {size:g} mm, not"
        f" {1000 * board.marker_m:g}; correct --marker-mm"
        if charuco
        else f"gaps measure {gap:.3g} mm beside markers of {size:g} mm, not"
        f" {1000 * board.gap_m:g}; correct --gap-mm"
    )


def _best(markers: Markers, board: Board, columns: Iterable[int], count: int) -> Layout:
    """Return the layout that fits most steps, in doubt the usual one."""
    ids = np.unique(markers.ids).tolist()
    if board.kind == "charuco":  # parity 0 with even rows: OpenCV before 4.6
        layouts = [
            Layout(n, count, parity=parity) for n in columns for parity in (1, 0)
        ]
    else:
        starts = (
            [0, *ids[:3], *range(max(0, ids[-1] - count + 1), ids[0])] if ids else [0]
        )
        firsts = dict.fromkeys(starts if board.tag is None else [board.tag])
        turns = [(turn, up) for up in (False, True) for turn in range(4)]
        turns.sort(key=lambda each: each != STYLES[board.kind])
        layouts = [
            Layout(n, count, first, *turn)
            for n in columns
            for first in firsts
            for turn in turns
        ]
    return max(layouts, key=lambda layout: layout.fit(markers)[0].sum())
