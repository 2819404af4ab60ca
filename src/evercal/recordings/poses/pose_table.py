"""Tables of poses: lines of numbers behind a header that says which column is what.

Columns are parted by semicolons, commas, tabs or blanks. Lines that start with # are passed over,
but the last of them before the numbers may be the header, as numpy and TUM write it. The names of
columns that are known stand in `pose_header`. A table without a header has the numbers of its
convention, behind a stamp, and with a name before or after them, where there are more columns.
"""

import csv
import io
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evercal.recordings.poses.conventions import PoseConvention, known_conventions
from evercal.recordings.poses.labels import image_column, seconds
from evercal.recordings.poses.pose_header import PoseHeader, is_number, meant, pose_header

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PoseTable:
    """Poses as they stand in a file."""

    numbers: Array
    """(n, convention.count)."""
    convention: PoseConvention
    """How they are meant."""
    names: tuple[str, ...] | None
    """(n,) of the rows."""
    stamps_s: Array | None
    """(n,) seconds."""


def read_pose_table(text: str, given: PoseConvention | None) -> PoseTable:
    """Reads a table.

    Args:
        text: of the file.
        given: how the numbers are meant; None if the header says it.

    Raises:
        ValueError: No table of numbers, or one that does not say how its poses are meant.
    """
    header, rows = _split(text)
    if not rows:
        raise ValueError("no line of numbers in it")
    if header is None:
        return _without_header(rows, given)
    for i, row in enumerate(rows):
        if len(row) != header.width:
            raise ValueError(f"row {i + 1} has {len(row)} columns, the header {header.width}")
    convention, columns = meant(header, given)
    names = None if header.name is None else tuple(row[header.name] for row in rows)
    if names is None:
        cells = dict(zip(header.cells, zip(*rows, strict=True), strict=True))
        named = image_column(cells)
        names = None if named is None else cells[named]
    stamps = None
    if header.stamp is not None:
        column = np.array([_number(row[header.stamp], i) for i, row in enumerate(rows)])
        stamps = seconds(column, header.stamp_unit)
    numbers = np.array([[_number(row[c], i) for c in columns] for i, row in enumerate(rows)])
    return PoseTable(numbers, convention, names, stamps)


def _split(text: str) -> tuple[PoseHeader | None, list[list[str]]]:
    """The header, if there is one, and the cells of the lines of numbers."""
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
    return (header if header and header.width == len(rows[0]) else None), rows


def _cells(line: str) -> list[str]:
    for separator in (";", ",", "\t"):
        if separator in line:
            cells = next(csv.reader(io.StringIO(line), delimiter=separator, skipinitialspace=True))
            cells = cells[:-1] if cells and not cells[-1].strip() else cells
            cells = [cell.strip() for cell in cells]
            if separator == ";":  # then the comma may be a decimal point
                points = [cell.replace(",", ".") for cell in cells]
                return [p if is_number(p) else c for p, c in zip(points, cells, strict=True)]
            return cells
    return line.split()


def _without_header(rows: list[list[str]], given: PoseConvention | None) -> PoseTable:
    width = len(rows[0])
    if given is None:
        raise ValueError(
            f"{width} columns without a header do not say how they are meant; write a header such"
            f" as x,y,z,qw,qx,qy,qz or give --convention, one of {known_conventions()}, or tum"
        )
    names, numbers = None, []
    words = [i for i, cell in enumerate(rows[0]) if not is_number(cell)]
    extra = width - given.count
    if len(words) > 1 or not len(words) <= extra <= len(words) + 1:
        raise ValueError(
            f"row 1 has {width} columns; {given.name} takes {given.count} ({given.meaning}),"
            f" and a name and a stamp before them where they are known"
        )
    for i, row in enumerate(rows):
        if len(row) != width:
            raise ValueError(f"row {i + 1} has {len(row)} columns, row 1 has {width}")
        numbers.append([_number(cell, i) for c, cell in enumerate(row) if c not in words])
    if words:
        names = tuple(row[words[0]] for row in rows)
    table = np.array(numbers)
    stamps = seconds(table[:, 0], None) if extra > len(words) else None
    back = np.flatnonzero(np.diff(table[:, 0]) < 0)
    # A number behind the pose instead shows in quaternions and matrices, but not in angles.
    if stamps is not None and given.has_angles and back.size:
        raise ValueError(
            f"the first number of row {back[0] + 2} is smaller than the one before, so it is no"
            f" stamp; write a header that says what the {width} columns are"
        )
    return PoseTable(table[:, table.shape[1] - given.count :], given, names, stamps)


def _number(cell: str, row: int) -> float:
    try:
        return float(cell)
    except ValueError:
        raise ValueError(f"row {row + 1} holds {cell!r} where a number is expected") from None
