"""Detect chessboards, ChArUco boards and AprilTags in images with OpenCV.

Board frames, in metres:

- chessboard: the origin is an inner corner, x follows the columns, y the rows, and z points into
  the board, away from the camera. If columns + rows is odd, the origin is the corner next to a
  bright inner square, whatever the roll of the camera.
- charuco: the frame of OpenCV's `CharucoBoard`: origin at an outer corner, z into the board.
- apriltag: the origin is the centre of the black square, x right and y up in OpenCV's print, z
  towards the camera.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.boards.corners import BoardView
from evercal.errors import InputError

Array = NDArray[np.floating]
Image = NDArray[np.uint8]
BoardKind = Literal["chessboard", "charuco", "apriltag"]

_MIN_CORNERS = 6
"""Minimum number of ChArUco corners."""
_LARGEST_CHANGE = 0.3
"""Maximum change of the step from corner to corner, parts of the mean step."""
_SMALLEST_WINDOW_PX = 2
_SAMPLES, _EDGE_BLUR_PX = 24, 2.0
"""Samples along an edge, and its width in the image."""
_LEAST_REACH_PX, _MOST_REACH_PX = 1.5, 5.0
"""Smallest and largest distance of samples from an edge."""
_LARGEST_MOVE_PX = 0.5
"""Largest change of a corner by its edges; six times that for a tag, whose corners blur rounds."""
_LARGEST_DOUBLED_PX = 1400
"""Width of the widest image that is searched again at double size."""


@dataclass(frozen=True)
class Board:
    """A printed board."""

    kind: BoardKind
    size_m: float
    """Side of a square, or of the black square of a tag, metres."""
    columns: int = 0
    """Number of inner corners of a chessboard along x, or of squares of a ChArUco board."""
    rows: int = 0
    """Number along y."""
    marker_m: float = 0.0
    """Side of a marker of a ChArUco board, metres."""
    dictionary: str = ""
    """Marker dictionary, OpenCV's name without DICT_: 4X4_50, APRILTAG_36h11."""
    tag: int | None = None
    """Number of the tag; if omitted, any tag."""

    def __post_init__(self) -> None:
        if self.kind not in get_args(BoardKind):
            raise InputError(f"board {self.kind!r} is not known; use one of {get_args(BoardKind)}")
        if not 0 < self.size_m < 10:
            raise InputError(f"square or tag side is {self.size_m:g} m; allowed are 0 to 10 m")
        if self.kind != "apriltag" and min(self.columns, self.rows) < 3:
            raise InputError(
                f"a {self.kind} has a size of 3x3 or more, got {self.columns}x{self.rows}; give for"
                f" example --size 9x6: inner corners of a chessboard, squares of a ChArUco board"
            )
        if self.kind == "charuco" and not 0 < self.marker_m < self.size_m:
            raise InputError(
                f"markers of a ChArUco board are smaller than its squares, got"
                f" {1000 * self.marker_m:g} mm in {1000 * self.size_m:g} mm; give --marker-mm"
            )
        if self.kind != "chessboard":
            dictionary_of(self)

    @property
    def half_turn(self) -> bool:
        """Whether the board looks the same after a rotation by 180 degrees."""
        return self.kind == "chessboard" and (self.columns + self.rows) % 2 == 0

    @property
    def quarter_turn(self) -> bool:
        """Whether the corners look the same after a rotation by 90 degrees."""
        return self.kind == "chessboard" and self.columns == self.rows

    def to_dict(self) -> dict[str, object]:
        """Return JSON values."""
        return dict(vars(self))

    @classmethod
    def from_dict(cls, data: object) -> Self:
        """Create a board from the values of `to_dict`, or raise ValueError."""
        if not isinstance(data, dict):
            raise ValueError("'board' must be an object")
        try:
            return cls(**data)
        except (TypeError, InputError) as error:
            raise ValueError(f"'board' is invalid ({error})") from None


def find_board(image: Image, board: Board) -> BoardView | str:
    """Detect the corners of a board in an image (H, W, 3) uint8 RGB, or return a reason."""
    import cv2

    find = {"chessboard": _find_chessboard, "charuco": _find_charuco, "apriltag": _find_tag}
    return find[board.kind](cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), board)


def _find_chessboard(grey: NDArray, board: Board) -> BoardView | str:
    y, x = np.indices((board.rows, board.columns), dtype=np.float64)
    points = board.size_m * np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)
    for pixels in _chessboard_candidates(grey, (board.columns, board.rows)):
        view = _sharpened(grey, BoardView(points, pixels), board)
        grid = view.pixels.reshape(board.rows, board.columns, 2)
        if _is_even(grid):
            if not board.half_turn and not _first_square_is_bright(grey, grid):
                grid = grid[::-1, ::-1]
            return BoardView(points, grid.reshape(-1, 2))
    return _no_chessboard(grey, board)


def _chessboard_candidates(grey: NDArray, size: tuple[int, int]) -> Iterator[Array]:
    """Yield corners (k, 2) by OpenCV's finders, the fastest first."""
    import cv2

    normalized = cv2.CALIB_CB_NORMALIZE_IMAGE
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | normalized
    detected, pixels = cv2.findChessboardCorners(grey, size, flags=flags)
    if detected:
        yield pixels.reshape(-1, 2).astype(np.float64)
    detected, pixels = cv2.findChessboardCornersSB(grey, size, flags=normalized)
    if detected:
        yield pixels.reshape(-1, 2).astype(np.float64)
    if grey.shape[1] <= _LARGEST_DOUBLED_PX:  # for small or tilted squares
        double = cv2.resize(grey, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
        detected, pixels = cv2.findChessboardCornersSB(double, size, flags=normalized)
        if detected:
            yield (pixels.reshape(-1, 2).astype(np.float64) - 0.5) / 2


def _is_even(grid: Array) -> bool:
    for axis in (0, 1):
        steps = np.diff(grid, axis=axis)
        change = np.linalg.norm(np.diff(steps, axis=axis), axis=2)
        if (change > _LARGEST_CHANGE * np.linalg.norm(steps, axis=2).mean()).any():
            return False
    return True


def _no_chessboard(grey: NDArray, board: Board) -> str:
    import cv2

    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE
    detected, _, meta = cv2.findChessboardCornersSBWithMeta(grey, (3, 3), flags)
    wanted = f"{board.columns}x{board.rows} inner corners"
    if detected:
        rows, columns = np.shape(meta)[:2]
        return (
            f"a part of a chessboard, {columns}x{rows} inner corners, not {wanted}; show the whole"
            f" board, or correct --size"
        )
    return f"no chessboard with {wanted}; show the whole board, sharp and without glare"


def _sharpened(grey: NDArray, view: BoardView, board: Board) -> BoardView:
    """Refine the corners of squares to one or two hundredths of a pixel.

    First in windows around them, then by lines along the edges of the squares, which are longer.
    Windows and edges keep away from markers and from the next corner.
    """
    import cv2

    points, pixels = view.points_m[:, :2] / board.size_m, view.pixels
    if cv2.findHomography(points, pixels)[0] is None:
        return view
    share = (board.size_m - board.marker_m) / (2 * board.size_m)
    along, down, area = _steps(points, pixels)
    longer = np.maximum(np.abs(along).sum(1), np.abs(down).sum(1))
    pixels = _in_windows(grey, pixels, share * area / np.maximum(longer, 1e-9))
    along, down, area = _steps(points, pixels)
    lines = []
    for step in (along, down):
        free = share * area / np.maximum(np.linalg.norm(step, axis=1), 1e-9) - _EDGE_BLUR_PX
        reach = np.where(free >= _LEAST_REACH_PX, np.minimum(free, _MOST_REACH_PX), np.nan)
        arms = [
            _edges(grey, pixels + sign * 0.08 * step, pixels + sign * 0.5 * step, reach)
            for sign in (-1, 1)
        ]
        lines.append(_lines(np.concatenate(arms, axis=1)))
    return BoardView(view.points_m, _crossings(pixels, *lines))


def _in_windows(grey: NDArray, pixels: Array, free_px: Array) -> Array:
    """Refine corners (n, 2) that have space for a window of at most `free_px` (n,) to each side."""
    import cv2

    half = np.minimum(free_px, 11).astype(int)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    start = np.ascontiguousarray(pixels, dtype=np.float32)
    refined = start.copy()
    for size in np.unique(half[half >= _SMALLEST_WINDOW_PX]):
        window, moved = (int(size), int(size)), start[half == size, None].copy()
        refined[half == size] = cv2.cornerSubPix(grey, moved, window, (-1, -1), stop)[:, 0]
    lost = np.linalg.norm(refined - start, axis=1) > half
    refined[lost] = start[lost]
    return refined.astype(np.float64)


def _steps(points: Array, pixels: Array) -> tuple[Array, Array, Array]:
    import cv2

    homography = cv2.findHomography(points, pixels)[0]
    mapped = np.column_stack([points, np.ones(len(points))]) @ homography.T
    depth = mapped[:, 2:]
    projected = mapped[:, :2] / depth
    along, down = ((h[:2] - projected * h[2]) / depth for h in homography.T[:2])
    return along, down, np.abs(along[:, 0] * down[:, 1] - along[:, 1] * down[:, 0])


def _first_square_is_bright(grey: NDArray, grid: Array) -> bool:
    import cv2

    middle = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    small = cv2.boxFilter(grey, -1, (3, 3))
    x, y = np.round(middle).astype(int).transpose(2, 0, 1)
    values = small[np.clip(y, 0, grey.shape[0] - 1), np.clip(x, 0, grey.shape[1] - 1)]
    even = np.add.outer(np.arange(values.shape[0]), np.arange(values.shape[1])) % 2 == 0
    return float(values[even].mean()) > float(values[~even].mean())


def _find_charuco(grey: NDArray, board: Board) -> BoardView | str:
    import cv2

    printed = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.size_m, board.marker_m, dictionary_of(board)
    )
    pixels, ids = None, None
    for legacy in (False, True):  # even number of rows, printed before OpenCV 4.6
        printed.setLegacyPattern(legacy)
        pixels, ids, _, _ = cv2.aruco.CharucoDetector(printed).detectBoard(grey)
        if ids is not None and len(ids) >= _MIN_CORNERS:
            every = np.asarray(printed.getChessboardCorners(), dtype=np.float64)
            points = every[np.asarray(ids, dtype=np.int64).ravel()]
            corners = np.reshape(pixels, (-1, 2)).astype(np.float64)
            flat = np.linalg.svd(points - points.mean(0), compute_uv=False)
            if flat[1] > 0.5 * board.size_m:
                return _sharpened(grey, BoardView(points, corners), board)
    count = 0 if ids is None else len(ids)
    return (
        f"{count} corners of the ChArUco board; {_MIN_CORNERS} in two rows are required; check"
        f" --size (squares), --dictionary ({board.dictionary}), light and focus"
    )


def _find_tag(grey: NDArray, board: Board) -> BoardView | str:
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(dictionary_of(board), parameters)
    corners, ids, _ = detector.detectMarkers(grey)
    tags = [] if ids is None else [int(i) for i in np.ravel(ids)]
    matches = [k for k, tag in enumerate(tags) if board.tag is None or tag == board.tag]
    if not matches:
        others = f"; it shows {', '.join(map(str, sorted(tags)))}" if tags else ""
        tag = "no tag" if board.tag is None else f"no tag {board.tag}"
        return f"{tag} of {board.dictionary}{others}"
    if len(matches) > 1:
        names = ", ".join(map(str, sorted(tags[k] for k in matches)))
        return f"several tags ({names}); select one with --tag"
    half = board.size_m / 2
    points = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    square = np.reshape(corners[matches[0]], (4, 2)).astype(np.float64)
    return BoardView(points, _square_by_its_sides(grey, square))


def _square_by_its_sides(grey: NDArray, square: Array) -> Array:
    """Refine the (4, 2) corners of a dark square by intersecting lines along its edges.

    Blur moves corners inwards, but no edges. OpenCV's lines are off by half a pixel at times.
    """
    sides = np.roll(square, -1, axis=0) - square
    reach = np.clip(0.04 * np.linalg.norm(sides, axis=1), 2.0, 5.0)
    edges = _edges(grey, square + 0.1 * sides, square + 0.9 * sides, reach, 5 * _SAMPLES)
    lines = _lines(edges)
    return _crossings(square, np.roll(lines, 1, axis=0), lines, 6 * _LARGEST_MOVE_PX)


def _edges(grey: NDArray, starts: Array, ends: Array, reach: Array, count: int = _SAMPLES) -> Array:
    """Return points (n, count, 2) on edges up to `reach` (n,) pixels off a side, or NaN."""
    import cv2

    sides = ends - starts
    across = np.stack([sides[:, 1], -sides[:, 0]], 1)
    across /= np.maximum(np.linalg.norm(sides, axis=1, keepdims=True), 1e-9)
    offsets = np.linspace(-1, 1, 33) * np.nan_to_num(reach)[:, None]
    points = starts[:, None] + np.linspace(0, 1, count)[:, None] * sides[:, None]
    grid = points[:, :, None] + offsets[:, None, :, None] * across[:, None, None]
    x, y = grid.reshape(len(starts), -1, 2).astype(np.float32).transpose(2, 0, 1)
    values = cv2.remap(grey, x, y, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
    values = np.asarray(values, dtype=np.float64).reshape(grid.shape[:3])
    slope = np.abs(np.gradient(values, axis=2))
    # Keep the edge and remove the noise beside it.
    slope = np.where(slope > 0.3 * slope.max(2, keepdims=True), slope, 0.0)
    strength = slope.sum(2)
    offset = (slope * offsets[:, None]).sum(2) / np.where(strength > 0, strength, np.nan)
    offset[np.isnan(reach)] = np.nan
    return points + offset[..., None] * across[:, None]


def _lines(points: Array) -> Array:
    middle = points.mean(1)
    spread = np.einsum("nki,nkj->nij", points - middle[:, None], points - middle[:, None])
    normal = np.linalg.eigh(np.nan_to_num(spread))[1][:, :, 0]
    return np.column_stack([normal, -(normal * middle).sum(1)])


def _crossings(
    corners: Array, first: Array, second: Array, reach_px: float = _LARGEST_MOVE_PX
) -> Array:
    crossing = np.cross(first, second)
    with np.errstate(divide="ignore", invalid="ignore"):
        refined = crossing[:, :2] / crossing[:, 2:]
    moved = np.linalg.norm(refined - corners, axis=1)
    return np.where((moved < reach_px)[:, None], refined, corners)


def dictionary_of(board: Board) -> Any:
    """Return the dictionary of markers of a board."""
    import cv2

    code = getattr(cv2.aruco, f"DICT_{board.dictionary}", None)
    if code is None:
        names = sorted(key[5:] for key in dir(cv2.aruco) if key.startswith("DICT_"))
        raise InputError(
            f"dictionary {board.dictionary!r} is not known; use one of {', '.join(names)}"
        )
    return cv2.aruco.getPredefinedDictionary(code)
