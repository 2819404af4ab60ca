"""Printed boards, and their frames in metres.

- chessboard: the origin is an inner corner, x follows the columns, y the rows, and z points into
  the board, away from the camera. If columns + rows is odd, the origin is the corner next to a
  bright inner square, whatever the roll of the camera.
- charuco: the frame of OpenCV's `CharucoBoard`: origin at an outer corner, z into the board.
- apriltag: the origin is the centre of the black square, x right and y up in OpenCV's print, z
  towards the camera.
- aprilgrid, arucogrid: the origin is the outer corner of the first marker, x follows its row, y
  the rows, and z is x cross y: towards the camera in Kalibr's print, whose rows go up; into the
  board in that of OpenCV's `GridBoard`, whose rows go down.
- circles, acircles: the origin is the centre of a corner's circle, x follows the columns, y the
  rows, and z points into the board. Columns of acircles are two rows apart, as in OpenCV.
"""

from typing import Any, Self, get_args

from evercal.choices import BoardKind
from evercal.classes import frozen
from evercal.errors import InputError
from evercal.typing import Floats, JsonObject

_LEAST_COUNT = {
    "chessboard": 3,
    "charuco": 3,
    "apriltag": 0,
    "aprilgrid": 1,
    "arucogrid": 1,
    "circles": 3,
    "acircles": 3,
}
"""Minimum number of rows and of columns."""
_PLAIN = ("chessboard", "circles", "acircles")
"""Boards without markers."""
_MOST_COUNT = 200
"""Maximum number of rows and of columns."""
_LEAST_M = 0.0005
"""Minimum side of a square or marker, metres: below, the unit is wrong."""
_MOST_M = 2.0
"""Maximum side of a square or marker, metres: above, the unit is wrong."""


@frozen
class Board:
    """A printed board."""

    kind: BoardKind
    size_m: float
    """Side of a square, or of the black square of a tag or of a marker of a grid, metres. From
    row to row of circles."""
    columns: int = 0
    """Number of inner corners of a chessboard along x, squares of a ChArUco board, markers of a
    grid."""
    rows: int = 0
    """Number along y."""
    marker_m: float = 0.0
    """Side of a marker of a ChArUco board, or diameter of a circle to print, metres."""
    dictionary: str = ""
    """Marker dictionary, OpenCV's name without DICT_: 4X4_50, APRILTAG_36h11."""
    tag: int | None = None
    """Number of the tag, or of the first marker of a grid; if omitted, any."""
    gap_m: float = 0.0
    """Distance between two markers of a grid, metres."""
    layout: tuple[Floats, ...] = ()
    """Tags that are one board: number, then x y z of the four corners in the order of OpenCV's
    print, metres. Empty for a single tag."""

    def __post_init__(self) -> None:
        rows = tuple(tuple(row) for row in self.layout)
        object.__setattr__(self, "layout", rows)
        if any(len(row) != 13 for row in rows):
            raise InputError("a row of a layout has 13 numbers: a tag and its corners")
        if self.kind not in get_args(BoardKind):
            raise InputError(
                f"board {self.kind!r} is not known; use one of {get_args(BoardKind)}"
            )
        if not _LEAST_M <= self.size_m <= _MOST_M:
            raise InputError(
                f"the side of a square or tag is {1000 * self.size_m:g} mm; allowed are"
                f" {1000 * _LEAST_M:g} to {1000 * _MOST_M:g} mm; give millimetres: `square_mm` 25"
            )
        counts = (self.columns, self.rows)
        least = _LEAST_COUNT[self.kind]
        if min(counts) < least or max(counts) > _MOST_COUNT:
            raise InputError(
                f"a {self.kind} has a size of {least}x{least} to {_MOST_COUNT}x{_MOST_COUNT}, got"
                f" {self.columns}x{self.rows}; give for example `size` 9x6: inner corners of a"
                f" chessboard, squares of a ChArUco board, markers of a grid"
            )
        if self.is_grid and not 0 < self.gap_m < 10 * self.size_m:
            raise InputError(
                f"the gap between markers of {1000 * self.size_m:g} mm is {1000 * self.gap_m:g} mm;"
                f" give `gap_mm`: the side of a marker times Kalibr's tagSpacing, or OpenCV's"
                f" markerSeparation"
            )
        if self.kind == "charuco" and not 0 < self.marker_m < self.size_m:
            raise InputError(
                f"markers of a ChArUco board are smaller than its squares, got"
                f" {1000 * self.marker_m:g} mm in {1000 * self.size_m:g} mm; give `marker_mm`"
            )
        if self.kind not in _PLAIN:
            dictionary_of(self)

    @property
    def is_grid(self) -> bool:
        """Whether the board is a grid of markers."""
        return self.kind in ("aprilgrid", "arucogrid")

    @property
    def marker_share(self) -> float:
        """Side of a marker, parts of the distance from one square or marker to the next."""
        if self.is_grid:
            return self.size_m / (self.size_m + self.gap_m)
        return self.marker_m / (self.size_m + self.gap_m)

    @property
    def half_turn(self) -> bool:
        """Whether the board looks the same after a rotation by 180 degrees."""
        odd = {
            "chessboard": self.columns + self.rows,
            "circles": 0,
            "acircles": self.rows,
        }
        return odd.get(self.kind, 1) % 2 == 0

    @property
    def quarter_turn(self) -> bool:
        """Whether the corners look the same after a rotation by 90 degrees."""
        return self.kind in ("chessboard", "circles") and self.columns == self.rows

    def to_dict(self) -> JsonObject:
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


def dictionaries() -> list[str]:
    """Names of the dictionaries of markers, the small ones of each family first."""
    import cv2

    names = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
    # Of two spellings, 36h11 before 36H11.
    names.sort(key=lambda name: (getattr(cv2.aruco, name), name.swapcase()))
    return [name.removeprefix("DICT_") for name in names]


def dictionary_of(board: Board) -> Any:
    """Return the dictionary of markers of a board."""
    import cv2

    code = getattr(cv2.aruco, f"DICT_{board.dictionary}", None)
    if code is None:
        names = ", ".join(sorted(dictionaries()))
        raise InputError(
            f"dictionary {board.dictionary!r} is not known; use one of {names}"
        )
    return cv2.aruco.getPredefinedDictionary(code)
