"""Rows that belong to images: a CSV with a header, its name and time columns told apart."""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.recordings.images import IMAGE_ENDINGS
from evercal.recordings.poses.labels import find_labels, seconds
from evercal.recordings.poses.pose_header import is_number

_EARLIEST_S, _LATEST_S = 1e9, 4e9
"""The years 2001 and 2096, in seconds since 1970: between them lie the times of recordings."""


@dataclass(frozen=True, eq=False)
class Rows:
    """A table of numbers, each row of it for one image or one moment."""

    names: tuple[str, ...] | None
    """The image of every row; None without such a column."""
    stamps_s: NDArray[np.float64] | None
    """(n,) seconds; None without such a column."""
    columns: tuple[str, ...]
    """What the other columns are called."""
    values: NDArray[np.float64]
    """(n, columns) numbers."""


def read_rows(path: Path, what: str) -> Rows:
    """Reads a CSV whose first line names the columns.

    Args:
        path: the file.
        what: it holds, for the messages.

    Raises:
        InputError: missing, without a header or rows, or a cell that is not a finite number.
    """
    header, *lines = read_lines(path, what)
    labels = find_labels(header)
    name, stamp = labels.name, labels.stamp
    if all(is_number(word) for word in header):
        raise InputError(f"{path}: the first line names no columns; write a header, then {what}")
    if not lines:
        raise InputError(f"{path}: holds a header and no rows; it is to hold {what}")
    others = [i for i in range(len(header)) if i not in labels.all]
    values = np.empty((len(lines), len(others)))
    stamps = np.empty(len(lines))
    for row, words in enumerate(lines):
        if len(words) != len(header):
            raise InputError(
                f"{path}: row {row + 1} has {len(words)} cells, the header has {len(header)}"
            )
        for column, i in enumerate(others):
            values[row, column] = _number(path, row, header[i], words[i])
        if stamp is not None:
            stamps[row] = _number(path, row, header[stamp], words[stamp])
    if stamp is not None:
        try:
            stamps = seconds(stamps, labels.unit) if labels.unit else in_seconds(stamps)
        except ValueError as error:
            raise InputError(f"{path}: {error}") from None
    return Rows(
        None if name is None else tuple(words[name] for words in lines),
        None if stamp is None else stamps,
        tuple(header[i] for i in others),
        values,
    )


def read_lines(path: Path, what: str) -> list[list[str]]:
    """The cells of a CSV, stripped; empty lines and comments (#) are passed over.

    Raises:
        InputError: missing, not text, or empty.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{path}: missing; it is to hold {what}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; it is to hold {what}") from None
    kept = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    separator = ";" if kept and ";" in kept[0] else ","
    lines = [[word.strip() for word in row] for row in csv.reader(kept, delimiter=separator)]
    if not lines:
        raise InputError(f"{path}: empty; it is to hold {what}")
    return lines


def in_seconds(stamps: NDArray[np.float64] | Sequence[float]) -> NDArray[np.float64]:
    """Times in seconds from times whose unit shows in their size.

    Times since 1970 are about 1.7e9 s; counts of milli-, micro- and nanoseconds since then are a
    thousand, a million and a thousand million times as large. Smaller numbers are seconds.
    """
    stamps = np.asarray(stamps, dtype=np.float64)
    middle = float(np.median(stamps)) if stamps.size else 0.0
    unit = next((u for size, u in ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3)) if middle > size), 1.0)
    return stamps * unit


def times_in_names(names: Sequence[str]) -> NDArray[np.float64] | None:
    """(n,) seconds that the names of images are; None where they are frame numbers or words.

    Times have a decimal point, or count whole milli-, micro- or nanoseconds since 1970. Frame
    numbers have neither, so 000123.png is no image taken at 123 s.
    """
    stems = [without_ending(name) for name in names]
    if not stems or not all(re.fullmatch(r"\d+(\.\d+)?", stem) for stem in stems):
        return None
    times = in_seconds([float(stem) for stem in stems])
    since_1970 = ((times > _EARLIEST_S) & (times < _LATEST_S)).all()
    return times if since_1970 or any("." in stem for stem in stems) else None


def without_ending(name: str) -> str:
    """The name of an image without its folder and ending; what follows the point of 12.5 stays."""
    path = PurePath(name)
    return path.stem if path.suffix.lower() in IMAGE_ENDINGS else path.name


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """A sorting key with which `image-2` comes before `image-10`."""
    parts = re.findall(r"\d+|\D+", name)
    return tuple((0, int(p), p) if p.isdigit() else (1, 0, p) for p in parts)


def _number(path: Path, row: int, column: str, word: str) -> float:
    value = float(word) if is_number(word) else np.nan
    if not np.isfinite(value):
        raise InputError(f"{path}: row {row + 1}, column {column!r}: {word!r} is not a number")
    return value
