"""Tables of poses: a header that names the columns, and rows of numbers.

Columns are separated by semicolons, commas, tabs or blanks. Lines that start with # are ignored,
except that the last of them before the numbers may be the header, as in files of numpy and TUM.
`pose_header` lists the known column names. A table without a header has the numbers of its
convention, optionally preceded by a stamp, and a name before or after them.
"""

import csv
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evercal.recordings.poses.conventions import KNOWN_CONVENTIONS, ConventionError, PoseConvention
from evercal.recordings.poses.labels import in_unit, is_number, row_labels
from evercal.recordings.poses.pose_header import PoseHeader, pose_columns, pose_header

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PoseTable:
    """Poses as numbers in a convention."""

    numbers: Array
    """(n, convention.count)."""
    convention: PoseConvention
    names: tuple[str, ...] | None = None
    """(n,) image names, if there are any."""
    stamps_s: Array | None = None
    """(n,) seconds, if there are any."""


def read_pose_table(text: str, given: PoseConvention | None) -> PoseTable:
    """Read a table; without a given convention, the header defines it.

    Raises:
        ValueError: The text is no table of numbers, or its convention is not defined.
    """
    header, rows = _split(text)
    if not rows:
        raise ValueError("no line of numbers in it")
    if header is None:
        return _without_header(rows, given)
    for i, row in enumerate(rows):
        if len(row) != len(header.cells):
            raise ValueError(f"row {i + 1} has {len(row)} columns, the header {len(header.cells)}")
    convention, columns = pose_columns(header, given)
    cells = dict(zip(header.cells, zip(*rows, strict=True), strict=True))
    names, stamps = row_labels(cells, len(rows))
    numbers = np.array([[_number(row[c], i) for c in columns] for i, row in enumerate(rows)])
    return PoseTable(numbers, convention, names, stamps)


def _split(text: str) -> tuple[PoseHeader | None, list[list[str]]]:
    """The header, if there is one, and the cells of the rows."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    plain = [line for line in lines if not line.startswith("#")]
    if not plain:
        return None, []
    rows = [_cells(line) for line in plain]
    header = pose_header(rows[0])
    if header is not None:
        return header, rows[1:]
    before = lines[: lines.index(plain[0])]
    header = pose_header(_cells(before[-1].lstrip("# "))) if before else None
    return (header if header and len(header.cells) == len(rows[0]) else None), rows


def _cells(line: str) -> list[str]:
    separator = next((s for s in (";", ",", "\t") if s in line), None)
    if separator is None:
        return line.split()
    cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    cells = [cell.strip() for cell in (cells if cells[-1].strip() else cells[:-1])]
    if separator == ";":  # then the comma may be a decimal point
        points = [cell.replace(",", ".") for cell in cells]
        cells = [p if is_number(p) else c for p, c in zip(points, cells, strict=True)]
    return cells


def _without_header(rows: list[list[str]], given: PoseConvention | None) -> PoseTable:
    width = len(rows[0])
    if given is None:
        raise ConventionError(
            f"{width} columns without a header do not define a pose; write a header such as"
            f" x,y,z,qw,qx,qy,qz",
            f"NAME, one of {KNOWN_CONVENTIONS}, or tum",
        )
    words = [i for i, cell in enumerate(rows[0]) if not is_number(cell)]
    extra = width - given.count
    if len(words) > 1 or not len(words) <= extra <= len(words) + 1:
        raise ValueError(
            f"row 1 has {width} columns; {given.name} takes {given.count} ({given.meaning}),"
            f" optionally after a name and a stamp"
        )
    numbers = []
    for i, row in enumerate(rows):
        if len(row) != width:
            raise ValueError(f"row {i + 1} has {len(row)} columns, row 1 has {width}")
        numbers.append([_number(cell, i) for c, cell in enumerate(row) if c not in words])
    names = tuple(row[words[0]] for row in rows) if words else None
    table = np.array(numbers)
    stamps = in_unit(table[:, 0], None) if extra > len(words) else None
    back = np.flatnonzero(np.diff(table[:, 0]) < 0)
    # A misplaced number shows in quaternions and matrices, but not in angles.
    if stamps is not None and given.has_angles and back.size:
        raise ValueError(
            f"the first number of row {back[0] + 2} is smaller than the one before, so it is no"
            f" stamp; write a header that names the {width} columns"
        )
    return PoseTable(table[:, table.shape[1] - given.count :], given, names, stamps)


def _number(cell: str, row: int) -> float:
    try:
        return float(cell)
    except ValueError:
        raise ValueError(f"row {row + 1} holds {cell!r} where a number is expected") from None
