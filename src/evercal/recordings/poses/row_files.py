"""CSV files with a header and one row for each image or time."""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.recordings.images import IMAGE_ENDINGS
from evercal.recordings.poses.labels import find_labels, in_unit, is_number
from evercal.recordings.text_files import read_text

_EARLIEST_S, _LATEST_S = 1e9, 4e9
"""The years 2001 and 2096 in seconds since 1970, the range of plausible times of recordings."""


@dataclass(frozen=True, eq=False)
class Rows:
    """A table of numbers with one row for each image or time."""

    names: tuple[str, ...] | None
    """(n,) image names, if there is such a column."""
    stamps_s: NDArray[np.float64] | None
    """(n,) seconds, if there is such a column."""
    columns: tuple[str, ...]
    """Names of the other columns."""
    values: NDArray[np.float64]
    """(n, columns) numbers."""


def read_rows(path: Path, contents: str) -> Rows:
    """Read a CSV file whose first line names the columns; `contents` describes it in messages.

    Raises:
        InputError: The file is missing, lacks a header or rows, or holds a cell that is not a
            finite number.
    """
    text = read_text(path, f"file with {contents}")
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    separator = ";" if lines and ";" in lines[0] else ","
    cells = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=separator)]
    if len(cells) < 2 or all(map(is_number, cells[0])):
        raise InputError(f"{path}: needs a line of column names, then rows of {contents}")
    header, *rows = cells
    labels = find_labels(header)
    others = [i for i in range(len(header)) if i not in labels.all]
    numbers = [*others] if labels.stamp is None else [*others, labels.stamp]
    values = np.empty((len(rows), len(numbers)))
    for i, row in enumerate(rows):
        if len(row) != len(header):
            raise InputError(
                f"{path}: row {i + 1} has {len(row)} cells, the header has {len(header)}"
            )
        for j, column in enumerate(numbers):
            values[i, j] = float(row[column]) if is_number(row[column]) else np.nan
            if not np.isfinite(values[i, j]):
                raise InputError(
                    f"{path}: row {i + 1}, column {header[column]!r}: {row[column]!r} is not a"
                    f" number"
                )
    stamps = None
    if labels.stamp is not None:
        try:
            stamps = (
                in_unit(values[:, -1], labels.unit) if labels.unit else in_seconds(values[:, -1])
            )
        except ValueError as error:
            raise InputError(f"{path}: {error}") from None
    names = None if labels.name is None else tuple(row[labels.name] for row in rows)
    return Rows(names, stamps, tuple(header[i] for i in others), values[:, : len(others)])


def in_seconds(stamps: NDArray[np.float64] | Sequence[float]) -> NDArray[np.float64]:
    """Convert times to seconds, with a unit inferred from their size.

    Times since 1970 are about 1.7e9 s, and a thousand, a million or a billion times as large in
    milli-, micro- or nanoseconds. Smaller numbers are seconds.
    """
    stamps = np.asarray(stamps, dtype=np.float64)
    middle = float(np.median(stamps)) if stamps.size else 0.0
    unit = next((u for size, u in ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3)) if middle > size), 1.0)
    return stamps * unit


def times_in_names(names: Sequence[str]) -> NDArray[np.float64] | None:
    """(n,) seconds if the image names are times, else None.

    Times have a decimal point, or are whole milli-, micro- or nanoseconds since 1970. Frame numbers
    are neither: 000123.png was not taken at 123 s.
    """
    stems = [without_ending(name) for name in names]
    if not stems or not all(re.fullmatch(r"\d+(\.\d+)?", stem) for stem in stems):
        return None
    times = in_seconds([float(stem) for stem in stems])
    since_1970 = ((times > _EARLIEST_S) & (times < _LATEST_S)).all()
    return times if since_1970 or any("." in stem for stem in stems) else None


def without_ending(name: str) -> str:
    """Name of an image without folder and image ending; `12.5` stays as it is."""
    path = PurePath(name)
    return path.stem if path.suffix.lower() in IMAGE_ENDINGS else path.name


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sorting key that puts `image-2` before `image-10`."""
    parts = re.findall(r"\d+|\D+", name)
    return tuple((0, int(p), p) if p.isdigit() else (1, 0, p) for p in parts)
