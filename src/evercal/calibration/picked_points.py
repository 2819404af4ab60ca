"""Tables of touched points, and of points that were picked in images."""

import csv
import io
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evercal.errors import InputError
from evercal.recordings.poses.row_files import is_number, table_cells
from evercal.storage import write_bytes
from evercal.storage.text_files import named_errors, read_text, refuse_repeated
from evercal.typing import Array

POINTS = "name, x, y, z"
"""Columns of touched points."""
PICKS = "image, name, u, v"
"""Columns of picks."""


class PickedPoint(NamedTuple):
    """A point in an image."""

    image: str
    """Path relative to the table."""
    point: str
    pixel: Array
    """(2,) x, y."""
    depth_m: float = np.nan
    """Measured depth."""


def read_points(path: Path) -> dict[str, Array]:
    """Touched points (3,) by name: lines of name, x, y, z in metres, base frame."""
    rows = _rows(path, 1, POINTS)
    with named_errors(path, "table of points"):
        refuse_repeated([name for (name,), _ in rows], "give each point one row")
    return {name: point for (name,), point in rows}


def read_picks(path: Path) -> list[PickedPoint]:
    """Points in images: lines of image, name, u, v in pixels."""
    rows = _rows(path, 2, PICKS)
    with named_errors(path, "table of points"):
        labels = [f"{name} in {image}" for (image, name), _ in rows]
        refuse_repeated(labels, "pick a point once in an image")
    return [PickedPoint(image, name, pixel) for (image, name), pixel in rows]


def write_picks(path: Path, rows: object, images: Collection[str]) -> int:
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


def _rows(path: Path, names: int, columns: str) -> list[tuple[list[str], Array]]:
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
