"""Boards of markers: tags, grids and ChArUco boards.

Images show how markers lie to each other, measured in sides of the nearest marker. That tells the
columns of a board, its first marker and the side of its markers, whatever the lens.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.boards.board import Board, dictionary_of
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.boards.edges import sharpened, squares_by_their_sides

Array = NDArray[np.floating]

_SQUARE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
"""Corners of a marker in OpenCV's order and axes, sides."""
_PASSES = tuple((border, threshold) for threshold in (15, 40, 7) for border in (1, 2))
"""Cells in the black border of a marker, two in Kalibr's print, and constants of OpenCV's
threshold: larger ones separate markers from squares that touch their corners."""
_MIN_CORNERS = 6
"""Minimum number of ChArUco corners."""
_NEAREST, _FEWEST_STEPS = 4, 8
"""Number of neighbours of a marker that are compared; minimum number of steps for a size."""
_OFF, _AGREEING = 0.3, 0.8
"""Largest error of a step, parts of it, and the smallest share of steps without it."""
_SIZE_OFF, _LEAST_SIDE_PX = 0.03, 20.0
"""Largest error of a stated side or pitch, relative; smallest markers that contradict one."""
_MOST_COLUMNS = 40
"""Largest number of columns that is tried."""


class OtherBoard(str):
    """A reason that names a board in the image that is not the stated one."""


class Markers(NamedTuple):
    """Markers in an image."""

    ids: NDArray[np.int64]
    """(n,)"""
    corners: Array
    """(n, 4, 2) pixels, clockwise from the upper left of OpenCV's print."""


class Steps(NamedTuple):
    """Steps from markers to their neighbours."""

    first: NDArray[np.int64]
    """(m,) number of the marker at the start."""
    second: NDArray[np.int64]
    """(m,) number of the marker at the end."""
    sides: Array
    """(m, 2) in axes and sides of the first marker."""


class Layout(NamedTuple):
    """How numbered markers lie on a board."""

    columns: int
    """Markers in a row, or squares of a ChArUco board."""
    start: int = 0
    """Number of the first marker."""
    turn: int = 0
    """Quarter turns of each marker against the rows."""
    up: bool = False
    """Whether row follows row upwards."""
    count: int = 1 << 30
    """Number of markers."""
    parity: int | None = None
    """Of column + row of squares that hold markers; None if each cell holds one."""

    def cells(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return column and row (n, 2) of the cells of markers (n,)."""
        number = ids - self.start
        if self.parity is None:
            return np.stack([number % self.columns, number // self.columns], 1)
        rows = 2 * (int(number.max(initial=0)) + 1) // self.columns + 2
        row, column = np.indices((rows, self.columns))
        return np.argwhere((row + column) % 2 == self.parity)[number][:, ::-1]

    def axes(self) -> Array:
        """Return (2, 2) from axes of a marker to axes of the board."""
        turned = np.linalg.matrix_power(np.array([[0.0, -1.0], [1.0, 0.0]]), self.turn)
        return np.diag([1.0, -1.0 if self.up else 1.0]) @ turned

    def has(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return (n,) whether markers are on the board."""
        return (ids >= self.start) & (ids < self.start + self.count)

    def fit(self, steps: Steps) -> tuple[NDArray[np.bool_], float]:
        """Return (m,) which steps fit the layout, and the side of a marker in cells."""
        inside = self.has(steps.first) & self.has(steps.second)
        use = [values[inside] for values in steps]
        wanted = self.cells(use[1]) - self.cells(use[0])
        length = np.linalg.norm(wanted, axis=1)
        side = float(np.median(length / np.linalg.norm(use[2], axis=1))) if len(length) else np.nan
        off = np.linalg.norm(side * use[2] @ self.axes().T - wanted, axis=1)
        good = inside.copy()
        good[inside] = off < _OFF * length
        return good, side


STYLES = {
    "aprilgrid": Layout(1, turn=2, up=True),
    "arucogrid": Layout(1),
}
"""Kalibr's and OpenCV's prints of a grid."""


def find_markers(grey: NDArray, board: Board) -> Markers:
    """Detect the markers of a board's dictionary, to hundredths of a pixel."""
    import cv2

    ids, corners, known, used = [], [], set[int](), None
    parameters = cv2.aruco.DetectorParameters()
    count = {"charuco": 1, "apriltag": 1}.get(board.kind, board.columns * board.rows)
    for border, threshold in _PASSES if board.kind != "charuco" else ((1, 7),):
        if used in (None, border):
            parameters.markerBorderBits = border
            parameters.adaptiveThreshConstant = threshold
            detector = cv2.aruco.ArucoDetector(dictionary_of(board), parameters)
            squares, numbers, _ = detector.detectMarkers(grey)
            both = zip(np.ravel([] if numbers is None else numbers), squares, strict=True)
            new = [(int(k), np.reshape(square, (4, 2))) for k, square in both if k not in known]
            ids += [k for k, _ in new]
            corners += [square for _, square in new]
            known, used = set(ids), border if ids else None
        if len(ids) >= count and (board.kind != "apriltag" or board.tag in {None, *ids}):
            break
    squares = np.reshape(corners, (-1, 4, 2)).astype(np.float64)
    if len(ids):
        squares = squares_by_their_sides(grey, squares)
    return Markers(np.array(ids, dtype=np.int64), squares)


def steps_between(markers: Markers) -> Steps:
    """Return the steps from each marker to its neighbours in the image."""
    import cv2

    n = len(markers.ids)
    if n < 2:
        return Steps(markers.ids[:0], markers.ids[:0], np.zeros((0, 2)))
    ends = np.concatenate([markers.corners, np.ones((n, 4, 1))], 2)
    middle = np.cross(np.cross(ends[:, 0], ends[:, 2]), np.cross(ends[:, 1], ends[:, 3]))
    middle = middle / middle[:, 2:]
    apart = np.linalg.norm(middle[:, None] - middle, axis=2) + np.diag(np.full(n, np.inf))
    start, end = np.repeat(np.arange(n), min(_NEAREST, n - 1)), np.argsort(apart, 1)
    end = end[:, : min(_NEAREST, n - 1)].ravel()
    square = _SQUARE.astype(np.float32)
    maps = [cv2.getPerspectiveTransform(c.astype(np.float32), square) for c in markers.corners]
    at = np.einsum("nij,nj->ni", np.reshape(maps, (-1, 3, 3))[start], middle[end])
    return Steps(markers.ids[start], markers.ids[end], at[:, :2] / at[:, 2:])


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
    points = board.size_m * np.pad(_SQUARE * (1, -1), ((0, 0), (0, 1)))
    return BoardView(points, markers.corners[matches[0]])


def find_charuco(grey: NDArray, board: Board) -> BoardView | str:
    """Detect the corners of squares of a ChArUco board, or return a reason."""
    import cv2

    markers = find_markers(grey, board)
    layout, wrong = _layout(markers.ids, steps_between(markers), markers.corners, board)
    if wrong:
        return wrong
    size = (board.columns, board.rows)
    printed = cv2.aruco.CharucoBoard(size, board.size_m, board.marker_m, dictionary_of(board))
    printed.setLegacyPattern(layout.parity == 0)
    squares = [square[None].astype(np.float32) for square in markers.corners]
    pixels, ids, _, _ = (
        cv2.aruco.CharucoDetector(printed).detectBoard(
            grey, None, None, squares, markers.ids.astype(np.int32)[:, None]
        )
        if squares
        else (None, None, None, None)
    )
    count = 0 if ids is None else len(ids)
    if count >= _MIN_CORNERS:
        every = np.asarray(printed.getChessboardCorners(), dtype=np.float64)
        points = every[np.asarray(ids, dtype=np.int64).ravel()]
        corners = np.reshape(pixels, (-1, 2)).astype(np.float64)
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
    steps = {name: steps_between(markers) for name, markers in found.items()}
    ids, corners = (np.concatenate(both) for both in zip(*found.values(), strict=True))
    pooled = Steps(*(np.concatenate(part) for part in zip(*steps.values(), strict=True)))
    layout, wrong = _layout(ids, pooled, corners, board)
    if wrong:
        return board, dict.fromkeys(found, wrong)
    views: dict[str, BoardView | str] = {}
    pitch = board.size_m + board.gap_m
    for name, markers in found.items():
        good, (first, *_) = layout.fit(steps[name])[0], steps[name]
        use = layout.has(markers.ids)
        use[use] = (
            [good[first == k].mean() >= 0.5 for k in markers.ids[use]] if len(first) else True
        )
        if not use.any():
            views[name] = f"no markers of the grid, {board.dictionary} from {layout.start}"
            continue
        around = _SQUARE @ layout.axes().T * board.size_m - board.gap_m / 2
        points = pitch * (layout.cells(markers.ids[use])[:, None] + 0.5) + around
        points = np.pad(points.reshape(-1, 2), ((0, 0), (0, 1)))
        views[name] = BoardView(points, markers.corners[use].reshape(-1, 2))
    return replace(board, tag=layout.start), views


def _layout(
    ids: NDArray[np.int64], steps: Steps, corners: Array, board: Board
) -> tuple[Layout, str]:
    """Return the layout of markers (n,) on a board, and the reason if it is not the stated one."""
    ids = np.unique(ids)
    layout = _best(_stated(board, ids), steps)
    good, side = layout.fit(steps)
    if len(good) and good.mean() < _AGREEING:
        return layout, _other_board(board, ids, steps)
    stated = (
        board.size_m / (board.size_m + board.gap_m)
        if board.is_grid
        else board.marker_m / board.size_m
    )
    long = np.linalg.norm(np.diff(corners, axis=1), axis=2)
    if (
        len(good) < _FEWEST_STEPS
        or np.median(long) < _LEAST_SIDE_PX
        or abs(side / stated - 1) < _SIZE_OFF
    ):
        return layout, ""
    square = 1000 * board.size_m
    if board.is_grid:
        return layout, OtherBoard(
            f"gaps measure {square * (1 / side - 1):.3g} mm between markers of {square:g} mm, not"
            f" {1000 * board.gap_m:g}; correct --gap-mm"
        )
    return layout, OtherBoard(
        f"markers measure {square * side:.3g} mm beside squares of {square:g} mm, not"
        f" {1000 * board.marker_m:g}; correct --marker-mm"
    )


def _stated(board: Board, ids: NDArray[np.int64]) -> Iterator[Layout]:
    """Yield the layouts of a stated board that shows markers (n,), the usual ones first."""
    count = board.columns * board.rows
    if board.kind == "charuco":
        yield Layout(board.columns, count=count // 2, parity=1)
        if board.rows % 2 == 0:  # the pattern of OpenCV before 4.6
            yield Layout(board.columns, count=count // 2, parity=0)
        return
    starts = (
        [0, *ids[:3].tolist(), *range(max(0, ids[-1] - count + 1), ids[0])] if len(ids) else [0]
    )
    for start in dict.fromkeys(starts if board.tag is None else [board.tag]):
        yield from _turned(board, Layout(board.columns, start, count=count))


def _turned(board: Board, layout: Layout) -> Iterator[Layout]:
    """Yield a layout with markers and rows in all directions, the usual ones first."""
    usual = STYLES[board.kind]
    for up in (usual.up, not usual.up):
        for turn in range(4):
            yield layout._replace(up=up, turn=(usual.turn + turn) % 4)


def _best(layouts: Iterable[Layout], steps: Steps) -> Layout:
    return max(layouts, key=lambda layout: layout.fit(steps)[0].sum())


def _other_board(board: Board, ids: NDArray[np.int64], steps: Steps) -> OtherBoard:
    """Return the reason that names the number of columns that markers (n,) have."""
    charuco = board.kind == "charuco"
    layouts: list[Layout] = []
    for columns in range(2, _MOST_COLUMNS + 1):
        if charuco:
            layouts += [Layout(columns, parity=parity) for parity in (1, 0)]
        else:
            for start in dict.fromkeys([0, int(ids[0])]):
                layouts += _turned(board, Layout(columns, start))
    layout = _best(layouts, steps)
    fits = "they lie on no such board"
    if layout.fit(steps)[0].mean() >= _AGREEING:
        rows = -(-(int(ids[-1]) - layout.start + 1) * (2 if charuco else 1) // layout.columns)
        older = ", OpenCV's legacy pattern" if layout.parity == 0 else ""
        fits = f"they fit {layout.columns}x{rows} {'squares' if charuco else 'markers'}{older}"
    return OtherBoard(
        f"markers {ids[0]} to {ids[-1]} are visible, {fits}, not {board.columns}x{board.rows};"
        f" correct --size"
    )
