"""Files with one row for each image or time: cells of a table, and labels of its rows.

Labels are columns of a table, or lists of JSON, that hold image names and times; the first of
`_NAMES` and `_STAMPS` that is there is used. A column with nothing but names of image files may
have any name. In JSON lists beside the poses, names are in the plural: `images`, `stamps_s`.
"""

import csv
import re
from collections.abc import Iterable, Sequence
from pathlib import Path, PureWindowsPath
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evercal.bounds import bounds, require_at_most
from evercal.recordings.images import IMAGE_ENDINGS
from evercal.storage.text_files import named_errors, read_text
from evercal.typing import Array, Strings

Cells = NDArray[np.object_]
"""(n, k) str, each of its own length, or numbers."""
Names = Strings | None

_NAMES = (
    "image",
    "image_name",
    "image_file",
    "image_path",
    "img",
    "file",
    "filename",
    "file_name",
    "file_path",
    "filepath",
    "path",
    "name",
    "frame",
)
_STAMPS = (
    "stamp",
    "timestamp",
    "time_stamp",
    "time",
    "t",
)
"""Names of columns of times, the first of which is used."""
_UNIT = re.compile(
    r"(?<![\s_/])[\s_/]*[\s_/\[(]\s*(mm|cm|m|inch(?:es)?|(?:milli)?met(?:er|re)s?|deg(?:rees?)?"
    r"|rad(?:ians?)?|ns|us|ms|s)\s*[\])]?$|(?<!\s)\s*\[\s*\]$"
)
_SHORT = {"deg": "deg", "rad": "rad", "mil": "mm", "met": "m", "inc": "inch"}
"""Units by the first three letters of their names."""
_PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
"""Units of time in a second."""
_SINCE_1970 = {"ms": 1e11, "us": 1e14, "ns": 1e17}
"""Stamps above this are in a unit: times since 1970 are about 1.7e9 s."""
_EARLIEST_S = 1e9
"""Earliest time in the name of an image, seconds since 1970: the year 2001."""
_LATEST_S = 4e9
"""Latest time in the name of an image, seconds since 1970: the year 2096."""
_TIME = re.compile(r"\d+(\.\d+)?")
_DECIMAL_COMMA = re.compile(r"^([-+]?\d*),(\d+(?:[eE][-+]?\d+)?)$")


class LabelledRows(NamedTuple):
    """A table of numbers with one row for each image or time."""

    names: Names
    """(n,) image names, if there is such a column."""
    stamps_s: Array | None
    """(n,) seconds, if there is such a column."""
    columns: Strings
    values: Array
    """(n, columns) numbers of the other columns."""


def read_rows(path: Path, contents: str) -> LabelledRows:
    """Read a table whose first line names the columns; `contents` describes it in messages."""
    text = read_text(path, f"file with {contents}")
    with named_errors(path, contents):
        lines = [line for line in text.splitlines() if line[:1] != "#"]
        cells = table_cells(lines)
        header = cells[:1].ravel()
        rows = cells[1:]
        words = header.tolist()
        if not len(rows) or all(map(is_number, words)):
            raise ValueError(f"needs a line of column names, then rows of {contents}")
        names, stamps, others = row_labels(words, rows.T.tolist(), len(rows))
        columns = tuple(header[others])
        values = cell_numbers(rows[:, others], columns)
        return LabelledRows(names, stamps, columns, values)


def numbers_by_image(text: str, layout: str) -> dict[str, list[float]]:
    """Numbers of lines that begin with the name of an image, by that name."""
    cells = table_cells(text.splitlines())
    if not cells.size:
        return {}
    _, *words = layout.split()
    if cells.shape[1] != len(words) + 1:
        raise ValueError(f"its first line is not {layout!r}")
    numbers = cell_numbers(cells[:, 1:], words)
    return dict(zip(cells[:, 0], numbers.tolist(), strict=True))


def table_cells(lines: Sequence[str]) -> Cells:
    """(n, k) cells of lines of text; missing cells at the end of a line are empty.

    Semicolons, commas, tabs or blanks of the first line separate them. Other than between commas,
    the comma may be a decimal point.
    """
    first = next((line for line in lines if line.strip()), "")
    separator = separator_of(first)
    columns = first.count(separator) + 1
    if separator == " ":
        columns = len(first.split())
        lines = [line.replace("\t", " ") for line in lines]
    _require_few_cells(columns, len(lines))
    rows = _split(lines, separator)
    if not rows:
        return np.empty((0, 0), object)
    cells = text_cells([map(str.strip, row) for row in rows])
    if separator == ",":
        return cells
    if any(map(_has_point, cells.ravel().tolist())):
        return cells  # beside numbers with points, commas are those of thousands
    for index, cell in np.ndenumerate(cells):
        cells[index] = _DECIMAL_COMMA.sub(r"\1.\2", cell)
    return cells


def _has_point(cell: str) -> bool:
    return "." in cell and is_number(cell)


def separator_of(line: str) -> str:
    """What separates the cells of a line of text."""
    words = line.split()
    with_commas = [word for word in words if "," in word]
    separators = ";,\t"
    if len(words) > 1 and all(map(_DECIMAL_COMMA.match, with_commas)):
        separators = ";\t"
    for separator in separators:
        if separator in line:
            return separator
    return " "


def _split(lines: Sequence[str], separator: str) -> list[list[str]]:
    """Cells of each line, as many as the first line has."""
    stripped = []
    for line in lines:
        # Empty cells at the end of a line are missing cells.
        line = line.lstrip(" ").rstrip(f" \t\r\n{separator}")
        stripped.append(line + "\n")
    # The bound of `text_cells` on the length of a cell is stricter, and names its place.
    csv.field_size_limit(max(csv.field_size_limit(), bounds().text_bytes))
    # A cell whose quote is never closed swallows the line after the last one.
    stripped.append("end")
    reader = csv.reader(stripped, delimiter=separator, skipinitialspace=True)
    rows: list[list[str]] = []
    width = 0
    for row in reader:
        if not rows:
            width = len(row)
        _require_few_cells(width, len(lines))  # lines of one row come together
        if len(row) > width:
            raise ValueError(
                f"no table: line {reader.line_num} has {len(row)} cells, not {width}"
            )
        if row:
            missing = width - len(row)
            rows.append(row + [""] * missing)
    if rows.pop()[:1] != ["end"]:
        raise ValueError("no table: a quotation mark is not closed")
    return rows


def _require_few_cells(columns: int, rows: int) -> None:
    require_at_most(columns, "columns", "columns")
    require_at_most(columns * rows, "numbers", "cells")


def text_cells(rows: Iterable[Iterable[str]]) -> Cells:
    """(n, k) cells of rows."""
    cells = np.array([*map(list, rows)], object)
    lengths = [*map(len, cells.flat)]
    longest = max(lengths, default=0)
    most = bounds().cell_characters
    if longest > most:
        row, column = divmod(lengths.index(longest), cells.shape[1])
        where = f"row {row + 1}, column {column + 1}"
        problem = f"{longest:,} characters, at most {most:,} are read"
        raise ValueError(f"{where}: {problem}")
    return cells


def cell_numbers(cells: Cells, words: Sequence[str] = ()) -> Array:
    """Convert cells (n, k) to finite numbers; ValueError names the first other cell."""
    for (row, column), cell in np.ndenumerate(cells):
        if is_number(cell) and np.isfinite(float(cell)):
            continue
        name = repr(words[column]) if words else column + 1
        where = f"row {row + 1}, column {name}"
        problem = f"{str(cell)!r} is not a finite number"
        if "[" in str(cell):
            problem += "; write all poses with brackets, or none"
        raise ValueError(f"{where}: {problem}")
    return cells.astype(float)


def name_and_unit(cell: str) -> tuple[str, str | None]:
    """Split a column's name into its plain name and its unit."""
    require_at_most(len(cell), "name_characters", "characters of a name")
    name = re.sub(r"^(.*/)?((pose|transform|header)[._/])+", "", cell.strip().lower())
    unit = None
    match = _UNIT.search(re.sub("[°º]", " deg", name))
    if match:
        name = match.string[: match.start()]
        unit = match[1]
    if unit:
        unit = _SHORT.get(unit[:3], unit)
    name = re.sub(r"[\s./\[]+", "_", name.rstrip("]"))
    return name, unit


def plain_names(words: Sequence[str]) -> list[str]:
    """Names of columns without their units."""
    return [name_and_unit(word)[0] for word in words]


def row_labels(
    words: Sequence[str],
    columns: Sequence[Sequence[object]],
    count: int,
    plural: bool = False,
) -> tuple[Names, Array | None, list[int]]:
    """Image names and seconds of `count` rows, None if missing, and indices of other columns."""
    plain = plain_names(words)
    if plural:
        plain = [*map(_singular, plain)]
    stamp = _first_of(_STAMPS, plain)
    name = _first_of(_NAMES, plain)
    if name is None:
        name = _column_of_files(words, columns)
    names = None
    if name is not None:
        _require_whole(words[name], columns[name], count)
        names = tuple(map(str, columns[name]))
    stamps = None
    if stamp is not None:
        _require_whole(words[stamp], columns[stamp], count)
        times = number_array(columns[stamp], f"{words[stamp]!r}")
        stamps = in_unit(times, name_and_unit(words[stamp])[1])
    labels = {*_NAMES, *_STAMPS}
    others = [i for i, word in enumerate(plain) if word not in labels and i != name]
    return names, stamps, others


def _singular(name: str) -> str:
    """A name without its s; empty for other names."""
    return name[:-1] if name.endswith("s") else ""


def _first_of(names: Sequence[str], words: list[str]) -> int | None:
    """Index of the word that is the first of names, if any is there."""
    for name in names:
        if name in words:
            return words.index(name)
    return None


def _column_of_files(
    words: Sequence[str], columns: Sequence[Sequence[object]]
) -> int | None:
    """Index of the only column of nothing but names of image files, if there is one."""
    indices: list[int] = []
    names: list[str] = []
    for i, column in enumerate(columns):
        if column and all(map(_is_image, column)):
            indices.append(i)
            names.append(words[i])
    if len(indices) > 1:
        listed = " and ".join(names)
        raise ValueError(f"{listed} name image files; call the right one 'image'")
    return next(iter(indices), None)


def _is_image(cell: object) -> bool:
    return str(cell).lower().endswith(IMAGE_ENDINGS)


def _require_whole(word: str, column: Sequence[object], count: int) -> None:
    if len(column) != count:
        raise ValueError(f"{word!r} holds {len(column)} entries for {count} poses")
    if None in column:
        raise ValueError(
            f"some poses have {word!r}, others lack it; give it to all poses"
        )


def number_array(values: object, what: str) -> Array:
    """Convert nested lists to an array; ValueError if they are ragged or hold other things."""
    try:
        return np.array(values, float)
    except (TypeError, ValueError):
        raise ValueError(
            f"{what} is made of numbers and has the same shape everywhere"
        ) from None


def in_unit(stamps: Array, unit: str | None = None) -> Array:
    """Convert stamps (n,) to seconds from `s`, `ms`, `us` or `ns`, by their size if omitted."""
    middle = 0.0
    if stamps.size:
        middle = float(np.median(stamps))
    likely = "s"
    for name, size in _SINCE_1970.items():
        if middle > size:
            likely = name
    if not np.isfinite(stamps).all():
        raise ValueError("a stamp is inf or nan; leave such rows out")
    if stamps.ndim != 1 or (unit == "s" and likely != "s"):
        raise ValueError(
            f"a stamp of {middle:.4g} is not in seconds; call the column stamp_ns, stamp_us or"
            f" stamp_ms"
        )
    if unit not in _PER_SECOND:
        unit = likely
    return stamps / _PER_SECOND[unit]


def by_alias(table: str) -> dict[str, str]:
    """Names by alias, of lines `name: alias alias`."""
    names: dict[str, str] = {}
    for line in table.strip().splitlines():
        name, _, aliases = line.partition(":")
        names |= dict.fromkeys(aliases.split(), name)
    return names


def is_number(cell: object) -> bool:
    """Whether Python reads a cell as a number."""
    try:
        float(str(cell))
    except ValueError:
        return False
    return True


def times_in_names(names: Sequence[str]) -> Array | None:
    """(n,) seconds if the image names are times, else None.

    Times have a decimal point, or are whole milli-, micro- or nanoseconds since 1970. Frame numbers
    are neither: 000123.png was not taken at 123 s.
    """
    stems = [*map(without_ending, names)]
    if not stems or not all(map(_TIME.fullmatch, stems)):
        return None
    times = in_unit(np.array(stems, float))
    since_1970 = (times > _EARLIEST_S) & (times < _LATEST_S)
    if since_1970.all() or "." in "".join(stems):
        return times
    return None


def without_ending(name: str) -> str:
    """Name of an image without folder and image ending; `12.5` stays as it is."""
    path = PureWindowsPath(name)
    if path.suffix.lower() in IMAGE_ENDINGS:
        return path.stem
    return path.name


def same_numbers(first: Sequence[str], second: Sequence[str]) -> bool:
    """Whether names of two kinds end in the same numbers, as pose_1 and image-001.png."""
    numbers = [*map(last_number, first)]
    return None not in numbers and numbers == [*map(last_number, second)]


def last_number(name: str) -> int | None:
    """The last number in the name of an image."""
    match = re.search(r"(\d+)\D*$", without_ending(name))
    return match and int(match[1])
