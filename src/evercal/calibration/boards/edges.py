"""Corners to one or two hundredths of a pixel, by windows around them and lines along edges."""

import cv2
import numpy as np

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.corners import BoardView
from evercal.geometry import norms, unit_vectors
from evercal.typing import Array, Image

_NEIGHBOURS = 8
"""Number of neighbours that determine the quadratic map at a corner."""
_MIN_WINDOW_PX = 2
"""Minimum half side of a window around a corner."""
_MAX_WINDOW_PX = 11
"""Maximum half side of a window around a corner."""
_SAMPLES = 24
"""Number of samples along an edge between two squares."""
_TAG_SAMPLES = 120
"""Number of samples along an edge of a tag."""
_EDGE_BLUR_PX = 2.0
"""Width of an edge in the image."""
_MIN_REACH_PX = 1.5
"""Minimum distance to which an edge is sampled on either side."""
_MAX_REACH_PX = 5.0
"""Maximum distance to which an edge is sampled on either side."""
_MAX_MOVE_PX = 0.5
"""Maximum change of a corner by its edges."""
_MAX_TAG_MOVE_PX = 5.0
"""Maximum change of a corner of a tag, which blur rounds."""
_TAG_ROUNDS = ((0.1, 6.0, 0.15), (0.05, 5.0, 0.1))
"""Rounds for tags: distance to which an edge is sampled, as a share of the side and in pixels at
most; share of the side that is left out at either end."""


def sharpened(
    grey: Image,
    view: BoardView,
    board: Board,
) -> BoardView:
    """Refine the corners of squares to one or two hundredths of a pixel.

    First in windows around them, then by lines along the edges of the squares, which are longer.
    Windows and edges keep away from markers and from the next corner.
    """
    points = view.points_m[:, :2] / board.size_m
    pixels = view.pixels
    homography, _ = cv2.findHomography(points, pixels)
    if homography is None:
        return view
    # Half of the distance from a corner to the next marker, or corner.
    share = (board.size_m - board.marker_m) / (2 * board.size_m)
    along, down, area = _steps(points, pixels)
    longer = np.maximum(np.abs(along).sum(1), np.abs(down).sum(1))
    pixels = _in_windows(
        grey,
        pixels,
        share * area / np.maximum(longer, 1e-9),
    )
    along, down, area = _steps(points, pixels)
    lines = []
    for step in (along, down):
        length = norms(step)
        reach = share * area / np.maximum(length, 1e-9) - _EDGE_BLUR_PX
        reach[reach < _MIN_REACH_PX] = np.nan
        reach = np.minimum(reach, _MAX_REACH_PX)
        back = _edges(
            grey,
            pixels - 0.08 * step,
            pixels - 0.5 * step,
            reach,
        )
        ahead = _edges(
            grey,
            pixels + 0.08 * step,
            pixels + 0.5 * step,
            reach,
        )
        edges = np.concatenate([back, ahead], axis=1)
        lines.append(_tangents(edges, pixels))
    return BoardView(view.points_m, _crossings(pixels, *lines))


def _in_windows(
    grey: Image,
    pixels: Array,
    free_px: Array,
) -> Array:
    """Refine corners (n, 2) that have space for a window of at most `free_px` (n,) to each side."""
    half = np.minimum(free_px, _MAX_WINDOW_PX).astype(int)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    start = np.ascontiguousarray(pixels, dtype=np.float32)
    refined = start.copy()
    for size in np.unique(half[half >= _MIN_WINDOW_PX]).tolist():
        rows = half == size
        corners = start[rows, None].copy()
        window = (size, size)
        corners = cv2.cornerSubPix(
            grey,
            corners,
            window,
            (-1, -1),
            criteria,
        )
        refined[rows] = corners[:, 0]
    lost = norms(refined - start) > half
    refined[lost] = start[lost]
    return refined.astype(float)


def _steps(
    points: Array,
    pixels: Array,
) -> tuple[Array, Array, Array]:
    """Return pixels (n, 2) that a corner moves with a square to the right, down, and their area.

    Each corner has a quadratic map by its neighbours, so that any lens will do.
    """
    differences = points[:, None] - points
    distances = norms(differences)
    near = np.argsort(distances, 1)[:, 1 : _NEIGHBOURS + 1]
    x, y = np.moveaxis(
        points[near] - points[:, None],
        2,
        0,
    )
    moved = pixels[near] - pixels[:, None]
    terms = np.stack([x, y, x * x, x * y, y * y], -1)
    slopes = np.linalg.pinv(terms) @ moved
    along = slopes[:, 0]
    down = slopes[:, 1]
    area = along[:, 0] * down[:, 1]
    area = area - along[:, 1] * down[:, 0]
    return along, down, np.abs(area)


def squares_by_their_sides(grey: Image, squares: Array) -> Array:
    """Refine the corners (n, 4, 2) of dark squares by intersecting lines along their edges.

    Blur moves corners inwards, but no edges. Lines end before the corners, where squares of
    Kalibr's grids touch, and look only for edges from dark to bright.
    """
    refined = squares
    for share, most_px, end in _TAG_ROUNDS:
        corners = refined.reshape(-1, 2)
        sides = (
            np.roll(
                refined,
                -1,
                axis=1,
            )
            - refined
        ).reshape(-1, 2)
        reach = np.clip(share * norms(sides), 2.0, most_px)
        starts = corners + end * sides
        ends = corners + (1 - end) * sides
        edges = _edges(
            grey,
            starts,
            ends,
            reach,
            _TAG_SAMPLES,
            outwards=True,
        )
        by_square = edges.reshape(-1, 4, _TAG_SAMPLES, 2)
        before = np.roll(by_square, 1, axis=1).reshape(edges.shape)
        first = _tangents(before, corners)
        second = _tangents(edges, corners)
        refined = _crossings(corners, first, second, _MAX_TAG_MOVE_PX)
        refined = refined.reshape(-1, 4, 2)
    return refined


def _edges(
    grey: Image,
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
    across = unit_vectors(across, 1e-9)[:, None]
    offsets = np.linspace(-1, 1, 33) * np.nan_to_num(reach)[:, None]
    offsets = offsets[:, None]
    points = starts[:, None] + np.linspace(0, 1, count)[:, None] * sides[:, None]
    grid = points[:, :, None] + offsets[..., None] * across[:, None]
    x, y = grid.reshape(len(starts), -1, 2).astype(np.float32).transpose(2, 0, 1)
    values = cv2.remap(
        grey,
        x,
        y,
        cv2.INTER_LINEAR,
        None,
        cv2.BORDER_REPLICATE,
    )
    values = np.asarray(values, float).reshape(grid.shape[:3])
    slope = np.gradient(values, axis=2)
    if outwards:
        slope = np.maximum(slope, 0.0)
    slope = np.abs(slope)
    # Keep the edge and remove the noise beside it.
    slope = np.where(slope > 0.3 * slope.max(2, keepdims=True), slope, 0.0)
    strength = slope.sum(2)
    strength[strength == 0] = np.nan
    offset = (slope * offsets).sum(2) / strength
    offset[np.isnan(reach)] = np.nan
    return points + offset[..., None] * across


def _tangents(points: Array, corners: Array) -> Array:
    """Return lines (n, 3) along edges with points (n, k, 2), beside corners (n, 2).

    Lenses bend edges, and a line is off by the sagitta: then tangents of parabolas. One degree for
    all edges, by the Bayesian information criterion: parabolas are noisier.
    """
    away = np.nan_to_num(points - corners[:, None])
    deviations = away - away.mean(1, keepdims=True)
    spread = np.einsum("nki,nkj->nij", deviations, deviations)
    _, axes = np.linalg.eigh(spread)
    across, along = np.moveaxis(
        away @ axes,
        2,
        0,
    )
    unit = np.maximum(np.abs(along).max(1), 1e-9)[:, None]
    powers = (along / unit)[..., None] ** np.arange(3)
    lowest = np.inf
    line = np.zeros(0)
    for degree in (1, 2):
        terms = powers[..., : degree + 1]
        fit = np.linalg.pinv(terms) @ across[..., None]
        residual = (terms @ fit)[..., 0] - across
        score = across.size * np.log(float(residual.var()) + 1e-12)
        score += fit.size * np.log(across.size)
        if score < lowest:
            lowest = score
            line = fit
    offset = line[:, 0]
    slope = line[:, 1]
    normal = axes[..., 0] - slope / unit * axes[..., 1]
    distance = (normal * (corners + offset * axes[..., 0])).sum(1)
    lines = np.column_stack([normal, -distance])
    lines[np.isnan(points).any((1, 2))] = np.nan
    return lines


def _crossings(
    corners: Array, first: Array, second: Array, reach_px: float = _MAX_MOVE_PX
) -> Array:
    crossing = np.cross(first, second)
    with np.errstate(divide="ignore", invalid="ignore"):
        refined = crossing[:, :2] / crossing[:, 2:]
    moved = norms(refined - corners)
    return np.where((moved < reach_px)[:, None], refined, corners)
