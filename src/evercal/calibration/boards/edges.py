"""Corners to one or two hundredths of a pixel, by windows around them and lines along edges."""

import cv2
import numpy as np
from numpy.typing import NDArray

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.corners import BoardView
from evercal.typing import Array

_NEIGHBOURS = 8
_SMALLEST_WINDOW_PX = 2
_SAMPLES, _EDGE_BLUR_PX = 24, 2.0
"""Samples along an edge, and its width in the image."""
_LEAST_REACH_PX, _MOST_REACH_PX = 1.5, 5.0
"""Smallest and largest distance of samples from an edge."""
_LARGEST_MOVE_PX, _LARGEST_TAG_MOVE_PX = 0.5, 5.0
"""Largest change of a corner by its edges; that of a tag is rounded by blur."""


def sharpened(grey: NDArray, view: BoardView, board: Board) -> BoardView:
    """Refine the corners of squares to one or two hundredths of a pixel.

    First in windows around them, then by lines along the edges of the squares, which are longer.
    Windows and edges keep away from markers and from the next corner.
    """
    points = view.points_m[:, :2] / board.size_m
    pixels = view.pixels
    if cv2.findHomography(points, pixels)[0] is None:
        return view
    share = (board.size_m - board.marker_m) / (2 * board.size_m)
    along, down, area = _steps(points, pixels)
    longer = np.maximum(np.abs(along).sum(1), np.abs(down).sum(1))
    pixels = _in_windows(grey, pixels, share * area / np.maximum(longer, 1e-9))
    along, down, area = _steps(points, pixels)
    lines = []
    for step in (along, down):
        free = (
            share * area / np.maximum(np.linalg.norm(step, axis=1), 1e-9)
            - _EDGE_BLUR_PX
        )
        reach = np.where(
            free >= _LEAST_REACH_PX, np.minimum(free, _MOST_REACH_PX), np.nan
        )
        arms = [
            _edges(grey, pixels + sign * 0.08 * step, pixels + sign * 0.5 * step, reach)
            for sign in (-1, 1)
        ]
        lines.append(_tangents(np.concatenate(arms, axis=1), pixels))
    return BoardView(view.points_m, _crossings(pixels, *lines))


def _in_windows(grey: NDArray, pixels: Array, free_px: Array) -> Array:
    """Refine corners (n, 2) that have space for a window of at most `free_px` (n,) to each side."""
    half = np.minimum(free_px, 11).astype(int)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    start = np.ascontiguousarray(pixels, dtype=np.float32)
    refined = start.copy()
    for size in np.unique(half[half >= _SMALLEST_WINDOW_PX]):
        window = (int(size), int(size))
        moved = start[half == size, None].copy()
        refined[half == size] = cv2.cornerSubPix(grey, moved, window, (-1, -1), stop)[
            :, 0
        ]
    lost = np.linalg.norm(refined - start, axis=1) > half
    refined[lost] = start[lost]
    return refined.astype(np.float64)


def _steps(points: Array, pixels: Array) -> tuple[Array, Array, Array]:
    """Return pixels (n, 2) that a corner moves with a square to the right, down, and their area.

    Each corner has a quadratic map by its neighbours, so that any lens will do.
    """
    apart = points[:, None] - points
    near = np.argsort(np.linalg.norm(apart, axis=2), 1)[:, 1 : _NEIGHBOURS + 1]
    rows = np.arange(len(points))[:, None]
    x, y = np.moveaxis(points[near] - points[rows], 2, 0)
    terms = np.stack([x, y, x * x, x * y, y * y], -1)
    along, down, *_ = np.moveaxis(
        np.linalg.pinv(terms) @ (pixels[near] - pixels[rows]), 1, 0
    )
    return along, down, np.abs(along[:, 0] * down[:, 1] - along[:, 1] * down[:, 0])


def squares_by_their_sides(grey: NDArray, squares: Array) -> Array:
    """Refine the corners (n, 4, 2) of dark squares by intersecting lines along their edges.

    Blur moves corners inwards, but no edges. Lines end before the corners, where squares of
    Kalibr's grids touch, and look only for edges from dark to bright.
    """
    refined = squares
    for share, most, end in ((0.1, 6.0, 0.15), (0.05, 5.0, 0.1)):
        corners = refined.reshape(-1, 2)
        sides = (np.roll(refined, -1, axis=1) - refined).reshape(-1, 2)
        reach = np.clip(share * np.linalg.norm(sides, axis=1), 2.0, most)
        ends = corners + end * sides, corners + (1 - end) * sides
        edges = _edges(grey, *ends, reach, 5 * _SAMPLES, outwards=True)
        before = np.roll(edges.reshape(-1, 4, 5 * _SAMPLES, 2), 1, axis=1).reshape(
            edges.shape
        )
        lines = _tangents(before, corners), _tangents(edges, corners)
        refined = _crossings(corners, *lines, _LARGEST_TAG_MOVE_PX).reshape(-1, 4, 2)
    return refined


def _edges(
    grey: NDArray,
    starts: Array,
    ends: Array,
    reach: Array,
    count: int = _SAMPLES,
    outwards: bool = False,
) -> Array:
    """Return points (n, count, 2) on edges up to `reach` (n,) pixels off a side, or NaN.

    With `outwards`, only edges that get brighter to the left of the side count.
    """
    sides = ends - starts
    across = np.stack([sides[:, 1], -sides[:, 0]], 1)
    across /= np.maximum(np.linalg.norm(sides, axis=1, keepdims=True), 1e-9)
    offsets = np.linspace(-1, 1, 33) * np.nan_to_num(reach)[:, None]
    points = starts[:, None] + np.linspace(0, 1, count)[:, None] * sides[:, None]
    grid = points[:, :, None] + offsets[:, None, :, None] * across[:, None, None]
    x, y = grid.reshape(len(starts), -1, 2).astype(np.float32).transpose(2, 0, 1)
    values = cv2.remap(grey, x, y, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
    values = np.asarray(values, dtype=np.float64).reshape(grid.shape[:3])
    slope = np.gradient(values, axis=2)
    slope = np.maximum(slope, 0.0) if outwards else np.abs(slope)
    # Keep the edge and remove the noise beside it.
    slope = np.where(slope > 0.3 * slope.max(2, keepdims=True), slope, 0.0)
    strength = slope.sum(2)
    offset = (slope * offsets[:, None]).sum(2) / np.where(
        strength > 0, strength, np.nan
    )
    offset[np.isnan(reach)] = np.nan
    return points + offset[..., None] * across[:, None]


def _tangents(points: Array, corners: Array) -> Array:
    """Return lines (n, 3) along edges with points (n, k, 2), beside corners (n, 2).

    Lenses bend edges, and a line is off by the sagitta: then tangents of parabolas. One degree for
    all edges, by the Bayesian information criterion: parabolas are noisier.
    """
    away = np.nan_to_num(points - corners[:, None])
    middle = away.mean(1, keepdims=True)
    spread = np.einsum("nki,nkj->nij", away - middle, away - middle)
    frame = np.linalg.eigh(spread)[1]  # across the edge, and along it
    across, along = np.moveaxis(away @ frame, 2, 0)
    unit = np.maximum(np.abs(along).max(1), 1e-9)
    powers = (along / unit[:, None])[..., None] ** np.arange(3)
    fits = []
    scores = []
    for degree in (1, 2):
        terms = powers[..., : degree + 1]
        fit = np.linalg.pinv(terms) @ across[..., None]
        left = float(((terms @ fit)[..., 0] - across).var())
        scores.append(
            across.size * np.log(left + 1e-12) + fit.size * np.log(across.size)
        )
        fits.append(fit[:, :2, 0].T)
    offset, slope = fits[int(np.argmin(scores))]
    normal = frame[..., 0] - (slope / unit)[:, None] * frame[..., 1]
    touched = (normal * (corners + offset[:, None] * frame[..., 0])).sum(1)
    lines = np.column_stack([normal, -touched])
    lines[np.isnan(points).any((1, 2))] = np.nan
    return lines


def _crossings(
    corners: Array, first: Array, second: Array, reach_px: float = _LARGEST_MOVE_PX
) -> Array:
    crossing = np.cross(first, second)
    with np.errstate(divide="ignore", invalid="ignore"):
        refined = crossing[:, :2] / crossing[:, 2:]
    moved = np.linalg.norm(refined - corners, axis=1)
    return np.where((moved < reach_px)[:, None], refined, corners)
