"""How numbered markers lie on a board: its columns, its first marker and the side of its markers.

Images show how markers lie to each other, measured in sides of the nearest marker. That tells the
layout of a board, whatever the lens.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.boards.board import Board
from evercal.geometry import norms
from evercal.typing import Array, BoolArray, IntArray

Plane: TypeAlias = NDArray[np.complexfloating]
"""Vectors x + i y."""

SQUARE: Plane = np.array([-1 - 1j, 1 - 1j, 1 + 1j, -1 + 1j], np.complex128) / 2
"""Corners of a marker in OpenCV's order and axes, sides."""
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


class OtherSize(OtherBoard):
    """The reason for markers of another size, which a few images may show by chance."""


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
    twice: IntArray
    """Numbers that are visible at two places or more; they are not among `ids`."""

    def without(self, numbers: Iterable[int]) -> "Markers":
        """The markers of other numbers, without their steps."""
        use = ~np.isin(self.ids, list(numbers))
        none = self.start[:0]
        return Markers(
            self.ids[use], self.corners[use], none, none, self.steps[:0], none
        )


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

    def fit(
        self,
        markers: Markers,
    ) -> tuple[BoolArray, float]:
        """Return (m,) which steps fit the layout, and the side of a marker in cells."""
        start = self.cells(markers.start)
        steps = self.cells(markers.end) - start
        if len(steps) == 0:
            return np.zeros(0, bool), 0.0
        lengths = np.abs(steps)
        measured = np.abs(markers.steps)
        side = float(np.median(lengths / measured))
        predicted = side * self.on_board(markers.steps)
        errors = np.abs(predicted - steps)
        on_board = self.has(markers.start)
        on_board &= self.has(markers.end)
        fits = errors < _STEP_ERROR * lengths
        return on_board & fits, side


def layout_of(
    markers: Markers,
    board: Board,
) -> tuple[MarkerLayout, str]:
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
    sides_px = norms(np.diff(markers.corners, axis=1))
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
        return OtherSize(
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
