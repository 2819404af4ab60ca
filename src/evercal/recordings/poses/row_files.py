"""Files with one row for each image or time: cells of a table, and labels of its rows.

Labels are columns of a table, or lists of JSON, that hold image names and times; the first of
`_NAMES` and `_STAMPS` that is there is used. A column with nothing but names of image files may
have any name. In JSON lists beside the poses, names are in the plural: `images`, `stamps_s`.
"""

import csv
import math
import re
import zipfile
from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path, PureWindowsPath
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evercal.bounds import bounds, require_at_most
from evercal.recordings.images import IMAGE_ENDINGS
from evercal.storage.text_files import library_errors, named_errors, read_text
from evercal.typing import Array

Cells = NDArray[np.object_]
"""(n, k) str, each of its own length."""
Names = tuple[str, ...] | None

_NAMES = (
    "image", "image_name", "image_file", "image_path", "img", "file", "filename", "file_name",
    "file_path", "filepath", "path", "name", "frame",
)  # fmt: skip
_STAMPS = ("stamp", "timestamp", "time_stamp", "time", "t")
_UNIT = re.compile(
    r"(?<![\s_/])[\s_/]*[\s_/\[(]\s*(mm|cm|m|inch(?:es)?|(?:milli)?met(?:er|re)s?|deg(?:rees?)?"
    r"|rad(?:ians?)?|ns|us|ms|s)\s*[\])]?$|(?<!\s)\s*\[\s*\]$"
)
_SHORT = {"deg": "deg", "rad": "rad", "mil": "mm", "met": "m", "inc": "inch"}
"""Units by the first three letters of their names."""
_PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_EARLIEST_S = 1e9
_LATEST_S = 4e9  # 2001 and 2096 in seconds since 1970
_DECIMAL_COMMA = re.compile(r"^([-+]?\d*),(\d+(?:[eE][-+]?\d+)?)$")


class LabelledRows(NamedTuple):
    """A table of numbers with one row for each image or time."""

    names: Names
    """(n,) image names, if there is such a column."""
    stamps_s: Array | None
    """(n,) seconds, if there is such a column."""
    columns: tuple[str, ...]
    values: Array
    """(n, columns) numbers of the other columns."""


def read_rows(path: Path, contents: str) -> LabelledRows:
    """Read a table whose first line names the columns; `contents` describes it in messages."""
    text = read_text(path, f"file with {contents}")
    with named_errors(path, contents):
        cells = table_cells([line for line in text.splitlines() if line[:1] != "#"])
        if len(cells) < 2 or all(map(is_number, cells[0])):
            raise ValueError(f"needs a line of column names, then rows of {contents}")
        header = cells[0].tolist()
        rows = cells[1:]
        names, stamps, others = row_labels(header, rows.T.tolist(), len(rows))
        columns = tuple(header[i] for i in others)
        return LabelledRows(
            names, stamps, columns, cell_numbers(rows[:, others], columns)
        )


def table_cells(lines: Sequence[str]) -> Cells:
    """(n, k) cells of lines of text; missing cells at the end of a line are empty.

    Semicolons, commas, tabs or blanks of the first line separate them. Other than between commas,
    the comma may be a decimal point.
    """
    first = next((line for line in lines if line.strip()), "")
    separator = _separator(first)
    count = len(first.split()) if separator == " " else first.count(separator) + 1
    _require_few_cells(count, len(lines))
    if separator == " ":
        lines = [line.replace("\t", " ") for line in lines]
    # Empty cells at the end of a line are missing cells.
    stripped = (line.lstrip(" ").rstrip(f" \t\r\n{separator}") + "\n" for line in lines)
    # The bound below on the length of a cell is stricter, and names its place.
    csv.field_size_limit(max(csv.field_size_limit(), bounds().text_bytes))
    # A cell whose quote is never closed swallows the line after the last one.
    rows = csv.reader(
        chain(stripped, ["end"]), delimiter=separator, skipinitialspace=True
    )
    cells: list[list[str]] = []
    for row in rows:
        width = len(cells[0]) if cells else len(row)
        _require_few_cells(width, len(lines))  # lines of one row come together
        if len(row) > width:
            raise ValueError(
                f"no table: line {rows.line_num} has {len(row)} cells, not {width}"
            )
        if row:
            cells.append([*row, *[""] * (width - len(row))])
    if cells.pop()[:1] != ["end"]:
        raise ValueError("no table: a quotation mark is not closed")
    if not cells:
        return np.empty((0, 0), dtype=object)
    cells = [[cell.strip() for cell in row] for row in cells]
    # Beside numbers with points, commas are those of thousands.
    if separator != "," and not any(
        "." in cell and is_number(cell) for row in cells for cell in row
    ):
        cells = [[_DECIMAL_COMMA.sub(r"\1.\2", cell) for cell in row] for row in cells]
    return text_cells(cells)


def _separator(line: str) -> str:
    words = line.split()
    if words[1:] and all(
        "," not in word or _DECIMAL_COMMA.match(word) for word in words
    ):
        return next((s for s in (";", "\t") if s in line), " ")
    return next((s for s in (";", ",", "\t") if s in line), " ")


def _require_few_cells(columns: int, rows: int) -> None:
    require_at_most(columns, "columns", "columns")
    require_at_most(columns * rows, "numbers", "cells")


def text_cells(rows: Iterable[Iterable[str]]) -> Cells:
    """(n, k) cells of rows."""
    cells = np.array([list(row) for row in rows], dtype=object)
    lengths = [len(cell) for cell in cells.flat]
    longest = max(lengths, default=0)
    if longest > (most := bounds().cell_characters):
        row, column = divmod(lengths.index(longest), cells.shape[1])
        where = f"row {row + 1}, column {column + 1}"
        raise ValueError(f"{where}: {longest:,} characters, at most {most:,} are read")
    return cells


def cell_numbers(cells: Cells, words: Sequence[str] = ()) -> Array:
    """Convert cells (n, k) to finite numbers; ValueError names the first other cell."""
    for (row, column), cell in np.ndenumerate(cells):
        if not is_number(cell) or not np.isfinite(float(cell)):
            name = repr(words[column]) if words else column + 1
            hint = "; write all poses with brackets, or none" * ("[" in cell)
            problem = f"{str(cell)!r} is not a finite number{hint}"
            raise ValueError(f"row {row + 1}, column {name}: {problem}")
    return cells.astype(np.float64)


def name_and_unit(cell: str) -> tuple[str, str | None]:
    """Split a column's name into its plain name and its unit."""
    require_at_most(len(cell), "name_characters", "characters of a name")
    name = re.sub(r"^(.*/)?((pose|transform|header)[._/])+", "", cell.strip().lower())
    match = _UNIT.search(re.sub("[°º]", " deg", name))
    unit = match.group(1) if match else None
    name = match.string[: match.start()] if match else name
    return re.sub(r"[\s./\[]+", "_", name.rstrip("]")), _SHORT.get(
        (unit or "")[:3], unit
    )


def row_labels(
    words: Sequence[str],
    columns: Sequence[Sequence[object]],
    count: int,
    plural: bool = False,
) -> tuple[Names, Array | None, list[int]]:
    """Image names and seconds of `count` rows, None if missing, and indices of other columns."""
    plain = [name_and_unit(word)[0] for word in words]
    if plural:
        plain = [word.removesuffix("s") if word.endswith("s") else "" for word in plain]
    stamp = next((plain.index(word) for word in _STAMPS if word in plain), None)
    name = next((plain.index(word) for word in _NAMES if word in plain), None)
    if name is None:
        files = [
            i
            for i, column in enumerate(columns)
            if column
            and all(str(cell).lower().endswith(IMAGE_ENDINGS) for cell in column)
        ]
        if len(files) > 1:
            found = " and ".join(words[i] for i in files)
            raise ValueError(f"{found} name image files; call the right one 'image'")
        name = files[0] if files else None
    for i in (i for i in (name, stamp) if i is not None):
        if len(columns[i]) != count:
            raise ValueError(
                f"{words[i]!r} holds {len(columns[i])} entries for {count} poses"
            )
        if None in columns[i]:
            raise ValueError(
                f"some poses have {words[i]!r}, others lack it; give it to all poses"
            )
    others = [
        i for i, word in enumerate(plain) if word not in _NAMES + _STAMPS and i != name
    ]
    names = None if name is None else tuple(map(str, columns[name]))
    stamps = None
    if stamp is not None:
        times = number_array(columns[stamp], f"{words[stamp]!r}")
        stamps = in_unit(times, name_and_unit(words[stamp])[1])
    return names, stamps, others


def number_array(values: object, what: str) -> Array:
    """Convert nested lists to an array; ValueError if they are ragged or hold other things."""
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(
            f"{what} is made of numbers and has the same shape everywhere"
        ) from None


def arrays_as_lists(path: Path) -> Any:
    """An array of NPY as lists, or arrays of NPZ or MAT by name; InputError for damaged files."""
    with path.open("rb") as file, library_errors(f"{path}: no readable arrays"):
        if path.suffix.lower() == ".mat":
            return _matlab(file)
        if zipfile.is_zipfile(file):
            with zipfile.ZipFile(file) as archive:
                for entry in archive.infolist():
                    with archive.open(entry) as member:
                        _require_few_numbers(member)
        else:
            file.seek(0)
            _require_few_numbers(file)
        file.seek(0)
        loaded = np.load(file, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return loaded.tolist()
        return {key: loaded[key].tolist() for key in loaded.files}


def _matlab(file: IO[bytes]) -> dict[str, Any]:
    from scipy.io import loadmat, whosmat

    kinds = re.compile("double|single|u?int(8|16|32|64)")
    shapes = {
        name: shape for name, shape, kind in whosmat(file) if kinds.fullmatch(kind)
    }
    require_at_most(sum(map(math.prod, shapes.values())), "numbers", "numbers")
    file.seek(0)
    loaded = loadmat(file, variable_names=[*shapes])
    return {name: loaded[name].tolist() for name in shapes}


def _require_few_numbers(file: IO[bytes]) -> None:
    """Check the shape that an array states, before its numbers are read."""
    version = np.lib.format.read_magic(file)
    read = {(1, 0): np.lib.format.read_array_header_1_0}.get(
        version, np.lib.format.read_array_header_2_0
    )
    shape, _, dtype = read(file)
    if dtype.hasobject:
        raise ValueError("Python objects; save arrays of numbers")
    require_at_most(
        math.prod(shape) * max(dtype.itemsize, 8) // 8, "numbers", "numbers"
    )


def in_unit(stamps: Array, unit: str | None = None) -> Array:
    """Convert stamps (n,) to seconds from `s`, `ms`, `us` or `ns`, by their size if omitted.

    Times since 1970 are about 1.7e9 s. Numbers far larger are in a smaller unit.
    """
    middle = float(np.median(stamps)) if stamps.size else 0.0
    sizes = {"ns": 1e17, "us": 1e14, "ms": 1e11}
    likely = next((name for name, size in sizes.items() if middle > size), "s")
    if not np.isfinite(stamps).all():
        raise ValueError("a stamp is inf or nan; leave such rows out")
    if stamps.ndim != 1 or (unit == "s" and likely != "s"):
        raise ValueError(
            f"a stamp of {middle:.4g} is not in seconds; call the column stamp_ns, stamp_us or"
            f" stamp_ms"
        )
    return stamps / _PER_SECOND.get(unit or likely, _PER_SECOND[likely])


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
    stems = [without_ending(name) for name in names]
    if not stems or not all(re.fullmatch(r"\d+(\.\d+)?", stem) for stem in stems):
        return None
    times = in_unit(np.array(stems, dtype=np.float64))
    since_1970 = ((times > _EARLIEST_S) & (times < _LATEST_S)).all()
    return times if since_1970 or any("." in stem for stem in stems) else None


def without_ending(name: str) -> str:
    """Name of an image without folder and image ending; `12.5` stays as it is."""
    path = PureWindowsPath(name)
    return path.stem if path.suffix.lower() in IMAGE_ENDINGS else path.name


def same_numbers(first: Sequence[str], second: Sequence[str]) -> bool:
    """Whether names of two kinds end in the same numbers, as pose_1 and image-001.png."""
    numbers = [
        re.findall(r"(\d+)\D*$", without_ending(name)) for name in (*first, *second)
    ]
    plain = [int(each[0]) if each else -1 for each in numbers]
    return -1 not in plain and plain[: len(first)] == plain[len(first) :]
