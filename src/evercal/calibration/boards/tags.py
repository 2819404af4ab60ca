"""Tags of one number, or of several numbers that are one board: the same in all images."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.corners import BoardView, Detection
from evercal.calibration.boards.marker_layout import SQUARE, Markers
from evercal.calibration.boards.markers import in_space
from evercal.errors import InputError
from evercal.typing import Array, Strings

_NAMED = 5
"""Number of tags that a message names."""

Corners: TypeAlias = dict[int, Array]
"""Corners (4, 3) of tags by their numbers, metres, in the order of OpenCV's print."""


def square(size_m: float) -> Array:
    """Corners (4, 3) of a tag in its own frame."""
    return in_space(size_m * SQUARE.conj())


def corners_of(board: Board) -> Corners:
    """Corners of all tags of a board."""
    if board.layout:
        return {int(row[0]): np.reshape(row[1:], (4, 3)) for row in board.layout}
    if board.tag is None:
        return {}
    return {board.tag: square(board.size_m)}


def with_corners(board: Board, corners: Corners) -> Board:
    """The board with a layout."""
    rows = [(number, *own.ravel().tolist()) for number, own in sorted(corners.items())]
    return replace(board, layout=tuple(rows))


def tag_views(
    found: Mapping[str, Markers], board: Board
) -> tuple[Board, dict[str, Detection]]:
    """Return the board with its number, and the corners in each image or a reason."""
    if not board.layout:
        board = _with_number(found, board)
    corners = corners_of(board)
    views: dict[str, Detection] = {}
    for name, markers in found.items():
        views[name] = view_of(markers, corners) or _without(markers, board)
    return board, views


def view_of(markers: Markers, corners: Corners) -> BoardView | None:
    """The corners of tags in an image, if there are any."""
    ids = markers.ids.tolist()
    use = [k for k, number in enumerate(ids) if number in corners]
    if not use:
        return None
    points = np.concatenate([corners[ids[k]] for k in use])
    return BoardView(points, markers.corners[use].reshape(-1, 2))


def _without(markers: Markers, board: Board) -> str:
    """The reason for an image without the tags."""
    ids = markers.ids.tolist()
    reason = f"no tag of {board.dictionary}"
    if board.tag is not None:
        reason = f"no tag {board.tag} of {board.dictionary}"
    if board.tag in markers.twice:
        reason = f"tag {board.tag} is visible twice"
    elif ids:
        reason += f"; it shows {', '.join(map(str, sorted(ids)))}"
    return reason


def _with_number(found: Mapping[str, Markers], board: Board) -> Board:
    """The board with the number of its tag, or InputError: several, or one that is there twice."""
    counts = Counter[int]()
    for markers in found.values():
        counts.update({*markers.ids.tolist(), *markers.twice.tolist()})
    if board.tag is None and len(counts) > 1:
        raise InputError(
            f"tags of several numbers are visible: {counted(counts)}; `tag` N takes one of them,"
            " `layout` FILE or `layout` estimate takes all as one board"
        )
    number = board.tag
    if number is None:
        number = next(iter(counts), None)
    twice = sum(number in markers.twice for markers in found.values())
    if twice > 1 or (twice and twice == len(found)):
        raise InputError(
            f"tag {number} is visible twice in {twice} of {len(found)} images, and one cannot be"
            " told from the other; cover one, or print it with another number"
        )
    return replace(board, tag=number)


def counted(counts: Counter[int]) -> str:
    """The numbers of tags with the number of images that show each."""
    most = counts.most_common(_NAMED)
    parts = [f"{number} in {count}" for number, count in sorted(most)]
    text = ", ".join(parts)
    if len(counts) > _NAMED:
        text += f" and {len(counts) - _NAMED} more"
    return f"{text} images"


def twice_notes(found: Iterable[Markers]) -> Strings:
    """A line for each number that is visible twice in an image."""
    counts = Counter[int]()
    for markers in found:
        counts.update(markers.twice.tolist())
    return tuple(
        f"marker {number} is visible twice in {count} images and not used there"
        for number, count in sorted(counts.items())
    )
