"""Tables of touched points, and of points that were picked in images."""

import csv
import io
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evercal.errors import InputError
from evercal.recordings.poses.row_files import (
    Names,
    cell_numbers,
    is_number,
    name_and_unit,
    row_labels,
    table_cells,
)
from evercal.storage import write_bytes
from evercal.storage.text_files import named_errors, read_text, refuse_repeated
from evercal.typing import Array, Strings

POINTS = "name, x, y, z"
"""Columns of touched points."""
PICKS = "image, name, u, v"
"""Columns of picks."""


_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
"""Metres by the unit of a column."""
_MOST_M = 50.0
"""Largest coordinate of a point; above, the unit is wrong."""
_TABLES = (".csv", ".txt", ".tsv", ".dat", ".xyz")


class PickedPoint(NamedTuple):
    """A point in an image."""

    image: str
    """Path relative to the table."""
    point: str
    pixel: Array
    """(2,) x, y."""
    depth_m: float = np.nan
    """Measured depth."""


def read_points(
    path: Path,
) -> dict[str, Array]:
    """Touched points (3,) by name: lines of name, x, y, z in metres, base frame."""
    rows = _rows(path, 1, POINTS)
    with named_errors(path, "table of points"):
        refuse_repeated([name for (name,), _ in rows], "give each point one row")
    _in_metres(path, np.stack([point for _, point in rows]))
    return {name: point for (name,), point in rows}


def read_positions(
    path: Path,
) -> tuple[Names, Array] | None:
    """Names, if any, and positions (n, 3) of a table without rotations; None for other files.

    Columns x, y and z, with a unit or in metres; or three numbers in a row, after a name.
    """
    if path.suffix.lower() not in _TABLES or not path.is_file():
        return None
    lines = read_text(path, "table of points").splitlines()
    with named_errors(path, "table of points"):
        cells = table_cells([line for line in lines if line[:1] not in ("#", "")])
        words = cells[:1].ravel().tolist()
        names = None
        columns = [*range(len(words))][-3:]
        parts: list[tuple[str, str | None]] = [("", None)] * 3
        if not any(map(is_number, words)):
            cells = cells[1:]
            names, _, columns = row_labels(words, cells.T.tolist(), len(cells))
            columns.sort(key=lambda i: name_and_unit(words[i])[0][-1:])
            parts = [name_and_unit(words[i]) for i in columns]
            if [name[-1:] for name, _ in parts] != [*"xyz"]:
                return None
        elif len(words) == 4 and not is_number(words[0]):
            names = tuple(cells[:, 0].tolist())
        elif len(words) != 3:
            return None
        numbers = cell_numbers(cells[:, columns], [words[i] for i in columns])
        points = numbers * [_METRES.get(unit or "m", np.nan) for _, unit in parts]
    return names, _in_metres(path, points)


def _in_metres(
    path: Path,
    points: Array,
) -> Array:
    """Points that are not in millimetres."""
    if not np.abs(points).max() < _MOST_M:
        raise InputError(
            f"{path}: a coordinate is {np.abs(points).max():.4g}; points are in metres, others take"
            " a table with columns x_mm, y_mm, z_mm"
        )
    return points


def paired_positions(
    first: Path,
    second: Path,
) -> tuple[Strings, Array, Array]:
    """Names and positions (n, 3) of two tables, by names that both have, else in order."""
    names = []
    values = []
    for path in (first, second):
        found = read_positions(path)
        if not found:
            raise InputError(
                f"{path}: expected a table of name, x, y, z, or of x, y, z"
            )
        names.append(found[0])
        values.append(found[1])
    if all(names):
        common = [name for name in names[0] if name in names[1]]
        if not common:
            raise InputError(
                f"{second}: names no point of {first}; its first is {names[1][0]}, the other's"
                f" {names[0][0]}"
            )
        rows = [[own.index(name) for name in common] for own in names]
        return tuple(common), values[0][rows[0]], values[1][rows[1]]
    counts = [*map(len, values)]
    if counts[0] != counts[1]:
        raise InputError(
            f"{second}: {counts[1]} points, {first} has {counts[0]}; give both one row for each"
            " point, or a column name"
        )
    rows = tuple(f"row {i + 1}" for i in range(counts[0]))
    return names[0] or names[1] or rows, values[0], values[1]


def read_picks(
    path: Path,
) -> list[PickedPoint]:
    """Points in images: lines of image, name, u, v in pixels."""
    rows = _rows(path, 2, PICKS)
    with named_errors(path, "table of points"):
        labels = [f"{name} in {image}" for (image, name), _ in rows]
        refuse_repeated(labels, "pick a point once in an image")
    return [PickedPoint(image, name, pixel) for (image, name), pixel in rows]


def write_picks(
    path: Path,
    rows: object,
    images: Collection[str],
) -> int:
    """Write rows of image, name, u, v that a page has sent, and return their number.

    Raises:
        ValueError: They are no picks in these images.
    """
    if not isinstance(rows, list) or not rows:
        raise ValueError("pick a point first")
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(PICKS.split(", "))
    for row in rows:
        image, name, u, v = row
        known = image in images and isinstance(name, str) and name.strip()
        if not known or not name.isprintable() or not np.isfinite([u, v]).all():
            raise ValueError("not all are named picks in these images")
        table.writerow([image, name, f"{float(u):.2f}", f"{float(v):.2f}"])
    write_bytes(path, text.getvalue().encode())
    return len(rows)


def _rows(
    path: Path,
    names: int,
    columns: str,
) -> list[tuple[list[str], Array]]:
    """Words and numbers of every line of a table of these columns; a header line is skipped."""
    lines = read_text(path, "table of points").splitlines()
    with named_errors(path, "table of points"):
        cells = table_cells([line for line in lines if line[:1] != "#"])
    rows = []
    for row in cells.tolist():
        try:
            values = np.array([*map(float, row[names:])])
        except ValueError:
            values = np.array([np.nan])
        if (
            len(row) == columns.count(",") + 1
            and all(row)
            and np.isfinite(values).all()
        ):
            rows.append((row[:names], values))
        elif rows or len(cells) == 1 or any(map(is_number, row)):
            raise InputError(f"{path}: expected {columns}, got {','.join(row)!r}")
    if not rows:
        raise InputError(f"{path}: no rows in it; expected {columns}")
    return rows
