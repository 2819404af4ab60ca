"""Files with one row for each image or time: labels of the rows, and CSV files with a header.

Labels are columns of a table, or keys of JSON, that hold image names and times. Names are
case-insensitive, and times may have a unit (`stamp_ns`, `time [ms]`). If there are several
candidates, the first of the list is used. A column with nothing but names of image files may have
any name. In JSON lists beside the poses, names are in the plural: `images`, `stamps_s`.
"""

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.recordings.images import IMAGE_ENDINGS
from evercal.recordings.text_files import read_text

_NAMES = (
    "image", "image_name", "image_file", "image_path", "img", "file", "filename", "file_name",
    "file_path", "filepath", "path", "name", "frame",
)  # fmt: skip
_STAMPS = ("stamp", "timestamp", "time_stamp", "time", "t")
_UNIT = re.compile(r"[\s_]*[\s_\[(](mm|m|degrees|deg|radians|rad|ns|us|ms|s)[\])]?$|\s*\[\s*\]$")
_SHORT = {"degrees": "deg", "radians": "rad"}
_PER_SECOND = {"ms": 1e3, "us": 1e6, "ns": 1e9}
_LATEST_S = 1e11  # the year 5138: a larger stamp is not in seconds


@dataclass(frozen=True)
class Labels:
    """Positions of the labels in a list of columns or keys."""

    name: int | None
    stamp: int | None
    unit: str | None
    """`s`, `ms`, `us` or `ns` of the times, if stated."""
    all: frozenset[int]
    """All columns or keys with the name of a label."""


def find_labels(words: Sequence[str], plural: bool = False) -> Labels:
    """Find labels among names of columns, or among plural keys of JSON lists."""
    positions: dict[str, int] = {}
    for i, word in enumerate(words):
        name, _ = name_and_unit(word)
        if not plural or name.endswith("s"):
            positions.setdefault(name[:-1] if plural else name, i)
    stamp = next((positions[n] for n in _STAMPS if n in positions), None)
    return Labels(
        name=next((positions[n] for n in _NAMES if n in positions), None),
        stamp=stamp,
        unit=None if stamp is None else name_and_unit(words[stamp])[1],
        all=frozenset(i for n, i in positions.items() if n in _NAMES + _STAMPS),
    )


def name_and_unit(cell: str) -> tuple[str, str | None]:
    """Split a column's name into its plain name and its unit."""
    name = re.sub(r"^(pose|transform)[._/]", "", cell.strip().lower())
    match = _UNIT.search(name)
    unit = match.group(1) if match else None
    name = name[: match.start()] if match else name
    return re.sub(r"[\s.]+", "_", name), _SHORT.get(unit or "", unit)


def _image_column(columns: Mapping[str, Sequence[object]]) -> str | None:
    """Name of the only column with nothing but names of image files, if there is one."""
    names = [
        name
        for name, cells in columns.items()
        if cells and all(str(cell).lower().endswith(IMAGE_ENDINGS) for cell in cells)
    ]
    if len(names) > 1:
        raise ValueError(f"{' and '.join(names)} name image files; call the right one 'image'")
    return names[0] if names else None


def row_labels(
    columns: Mapping[str, Sequence[object]], count: int, plural: bool = False
) -> tuple[tuple[str, ...] | None, NDArray[np.float64] | None]:
    """Image names and seconds of `count` rows, each None if there is no such column.

    Raises:
        ValueError: A column is incomplete, a time is no number, or the columns are ambiguous.
    """
    keys = [*columns]
    labels = find_labels(keys, plural)
    name, stamp = (None if i is None else keys[i] for i in (labels.name, labels.stamp))
    name = name or _image_column(columns)
    for key in filter(None, (name, stamp)):
        if len(columns[key]) != count:
            raise ValueError(f"{key!r} holds {len(columns[key])} entries for {count} poses")
        if None in columns[key]:
            raise ValueError(f"some poses have {key!r}, others lack it; give it to all poses")
    seconds = None
    if stamp is not None:
        seconds = in_unit(number_array(columns[stamp], f"{stamp!r}"), labels.unit)
    return None if name is None else tuple(map(str, columns[name])), seconds


def number_array(values: object, what: str) -> NDArray[np.float64]:
    """Convert nested lists to an array.

    Raises:
        ValueError: The lists are ragged or hold something other than numbers.
    """
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{what} is made of numbers and has the same shape everywhere") from None


def in_unit(stamps: NDArray[np.float64], unit: str | None) -> NDArray[np.float64]:
    """Convert stamps (n,) to seconds from `s`, `ms`, `us` or `ns`; seconds if omitted.

    Raises:
        ValueError: The unit is omitted, and the numbers are too large for seconds.
    """
    if unit in _PER_SECOND:
        return stamps / _PER_SECOND[unit]
    if stamps.ndim != 1 or np.abs(stamps).max(initial=0.0) > _LATEST_S:
        raise ValueError(
            f"a stamp of {np.abs(stamps).max(initial=0.0):.4g} is not in seconds; call the column"
            f" stamp_ns, stamp_us or stamp_ms"
        )
    return stamps


def is_number(cell: str) -> bool:
    """Whether Python reads a cell as a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


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
