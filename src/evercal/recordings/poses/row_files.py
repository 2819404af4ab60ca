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
from evercal.recordings.poses.labels import find_labels, in_unit
from evercal.recordings.poses.pose_header import is_number

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
    """Read a CSV file whose first line names the columns.

    Args:
        path: The file.
        contents: What it holds, for messages.

    Raises:
        InputError: The file is missing, lacks a header or rows, or holds a cell that is not a
            finite number.
    """
    header, *lines = _read_lines(path, contents)
    labels = find_labels(header)
    if all(is_number(word) for word in header):
        raise InputError(
            f"{path}: the first line names no columns; write a header, then {contents}"
        )
    if not lines:
        raise InputError(f"{path}: holds a header and no rows; add {contents}")
    for row, words in enumerate(lines):
        if len(words) != len(header):
            raise InputError(
                f"{path}: row {row + 1} has {len(words)} cells, the header has {len(header)}"
            )
    others = [i for i in range(len(header)) if i not in labels.all]
    columns = [[_number(path, row, header[i], w[i]) for row, w in enumerate(lines)] for i in others]
    stamps = None
    if labels.stamp is not None:
        column = header[labels.stamp]
        cells = [_number(path, row, column, w[labels.stamp]) for row, w in enumerate(lines)]
        try:
            stamps = in_unit(np.array(cells), labels.unit) if labels.unit else in_seconds(cells)
        except ValueError as error:
            raise InputError(f"{path}: {error}") from None
    return Rows(
        None if labels.name is None else tuple(words[labels.name] for words in lines),
        stamps,
        tuple(header[i] for i in others),
        np.array(columns).reshape(len(others), len(lines)).T,
    )


def _read_lines(path: Path, contents: str) -> list[list[str]]:
    """Stripped cells of a CSV file without empty lines and comments (#)."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{path}: missing; expected a file with {contents}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; expected {contents}") from None
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if not lines:
        raise InputError(f"{path}: empty; expected {contents}")
    separator = ";" if ";" in lines[0] else ","
    return [[word.strip() for word in row] for row in csv.reader(lines, delimiter=separator)]


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


def _number(path: Path, row: int, column: str, word: str) -> float:
    value = float(word) if is_number(word) else np.nan
    if not np.isfinite(value):
        raise InputError(f"{path}: row {row + 1}, column {column!r}: {word!r} is not a number")
    return value
