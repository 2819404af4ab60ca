"""Tables of poses: columns with names, plain numbers, matrices, and robots' own notations.

Lines that start with #, % or // are ignored, except that the last of them before the numbers may be
the header, as in files of numpy and TUM. Rows without a header have the numbers of a convention,
optionally preceded by a stamp, and a name before or after them. Matrices may be blocks of 3 or 4
lines, with numpy's brackets or without.
"""

from collections.abc import Sequence

import numpy as np

from evercal.recordings.poses.conventions import Given
from evercal.recordings.poses.plain_rows import plain_numbers
from evercal.recordings.poses.pose_columns import (
    PoseTable,
    groups_of,
    named_numbers,
)
from evercal.recordings.poses.pose_notations import without_brackets
from evercal.recordings.poses.row_files import (
    Cells,
    cell_numbers,
    is_number,
    table_cells,
)
from evercal.typing import Array

_COMMENTS = ("#", "%", "//")


def read_pose_table(text: str, given: Given) -> PoseTable:
    """Read a table; without a given convention, its header or notation defines it.

    ValueError: this is no table, or its convention is not defined.
    """
    plain = []
    comments = []
    for line in map(str.strip, text.splitlines()):
        if line and not line.startswith(_COMMENTS):
            plain.append(line)
        elif line and not plain:
            comments.append(line)
    plain, given = without_brackets(plain, given)
    rows = table_cells(plain)
    words = rows[:1].ravel().tolist()
    has_header = _is_header(words)
    if has_header:
        rows = rows[1:]
    if not len(rows):
        raise ValueError("no line of numbers in it")
    if given and given.columns:
        return _without_header(rows, given)
    if not has_header:
        last_comment = [line.lstrip("#%/ ") for line in comments[-1:]]
        words = table_cells(last_comment).ravel().tolist()
    if len(words) == rows.shape[1] and _is_header(words):
        return named_numbers(words, rows, given)
    return _without_header(rows, given)


def _is_header(words: Sequence[str]) -> bool:
    numbers = [*map(is_number, words)]
    if all(numbers):
        return False
    return not any(numbers) or bool(groups_of(words))


def _without_header(rows: Cells, given: Given) -> PoseTable:
    """Poses of rows (n, k) of numbers, perhaps with names, or of matrices in 3 or 4 rows each."""
    constant = []  # such as a frame
    texts = []
    for i, (first, *others) in enumerate(rows.T.tolist()):
        if is_number(first):
            continue
        if {first} == {*others}:
            constant.append(i)
        else:
            texts.append(i)
    numbers = cell_numbers(np.delete(rows, constant + texts[:1], axis=1))
    if texts:
        return plain_numbers(numbers, given, tuple(rows[:, texts[0]].tolist()))
    if numbers.shape[1] == 4:
        numbers = _blocks(numbers, given)
    return plain_numbers(numbers, given)


def _blocks(rows: Array, given: Given) -> Array:
    """(n, 3 or 4, 4) matrices of rows of four numbers."""
    height = 4
    if len(rows) % 3 == 0:
        last_rows = (rows == (0, 0, 0, 1)).all(1)
        in_columns = given is not None and given.layout == "columns"
        if not in_columns and not last_rows.any():
            height = 3
    if len(rows) % height:
        raise ValueError(
            f"{len(rows)} rows of 4 numbers are no 4x4 or 3x4 matrices, and times with positions"
            f" lack the rotations of poses"
        )
    return rows.reshape(-1, height, 4)
