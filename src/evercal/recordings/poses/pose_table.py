"""Tables of poses: columns with names, plain numbers, matrices, and robots' own notations.

Lines that start with # are ignored, except that the last of them before the numbers may be the
header, as in files of numpy and TUM. Rows without a header have the numbers of a convention,
optionally preceded by a stamp, and a name before or after them. Matrices may be blocks of 3 or 4
lines. Brackets hold a pose or a row of a matrix each: `[...]` of numpy, `p[...]` of Universal
Robots, `{X ..., C ...}` of KUKA.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evercal.recordings.poses.conventions import (
    KNOWN_CONVENTIONS,
    UNITS,
    ConventionError,
    PoseConvention,
    matrix_convention,
    pose_convention,
)
from evercal.recordings.poses.row_files import (
    cell_numbers,
    in_unit,
    is_number,
    name_and_unit,
    row_labels,
    table_cells,
)

Array = NDArray[np.float64]
Names = tuple[str, ...] | None


class PoseTable(NamedTuple):
    """(n, k) numbers in a convention, with (n,) names and seconds if there are any."""

    numbers: Array
    convention: PoseConvention
    names: Names = None
    stamps_s: Array | None = None
    fixed: bool = False
    """Whether keys of the file state all of the convention."""


class Columns(NamedTuple):
    """Columns that belong together."""

    prefixes: Sequence[str]
    ends: Sequence[str]
    """Rest of the name of each column; after tvec_ and rvec_ also its index."""
    conventions: Sequence[str] = ()
    """Conventions that the columns of a rotation may hold."""
    ask: str = ""
    """Conventions to ask for; empty if the columns define the first one."""


_GRID = [f"{row}{column}" for row in range(4) for column in range(4)]
HEADERS = {
    "position": Columns(("", "t", "t_", "p", "pos_", "position_", "translation_", "tvec_"), "xyz"),
    "quaternion": Columns(
        ("q", "q_", "quat_", "quaternion_", "orientation_", "rotation_"),
        "wxyz",
        ("wxyz", "xyzw", "tum", "abb"),
    ),
    "rotation vector": Columns(("rotvec_", "rvec_", "rotation_vector_"), "xyz", ("ur",)),
    "matrix": Columns(("m",), _GRID, ("matrix", "franka")),
    "3x4 matrix": Columns(("m",), _GRID[:12], ("matrix", "franka")),
    "W P R": Columns(("",), "wpr", ("fanuc",)),
    "angles": Columns(
        ("r", "r_", "rot_", "rotation_"),
        "xyz",
        ("ur", "yaskawa", "staubli", "fanuc", "rpy"),
        "ur (rotation vector), yaskawa, staubli, fanuc or rpy",
    ),
    "roll pitch yaw": Columns(
        ("",),
        ("roll", "pitch", "yaw"),
        ("rpy", "yaskawa", "staubli", "fanuc", "kuka"),
        "rpy:rad or rpy:deg",
    ),
    "A B C": Columns(("",), "abc", ("kuka",), "kuka"),
    "q1 to q4": Columns(("q",), "1234", ("abb", "wxyz", "xyzw", "tum"), "abb, wxyz or xyzw"),
}
"""Columns of a position and of rotations; those that define a rotation come first."""
_AXES = {"quaternion": "wxyz", "angles": "xyz", "roll pitch yaw": "xyz"}
"""Columns that conventions order by axis; rx and roll rotate about x."""
_BRACKETS = re.compile(r'(?:([^\s\[\](){}=,;:"]+)[\s=,;:"]+)?(p?\[|\{)([^\[\]{}]*)[\]}]')
_NOTATIONS = {"[": "", "p[": "x,y,z,rotvec_x,rotvec_y,rotvec_z", "{": "X,Y,Z,A,B,C"}


class _Header(NamedTuple):
    groups: dict[str, list[int]]
    """Columns by key of `HEADERS`."""
    units: dict[str, str]
    """`m` or `mm` of the position, `rad` or `deg` of angles, if the header states them."""


def read_pose_table(text: str, given: PoseConvention | None) -> PoseTable:
    """Read a table; without a given convention, its header or notation defines it.

    Raises:
        ValueError: The text is no table of numbers, or its convention is not defined.
    """
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    plain = [line for line in lines if not line.startswith("#")]
    if not plain:
        raise ValueError("no line of numbers in it")
    comments = lines[: lines.index(plain[0])]
    plain, given = _without_brackets(plain, given)
    cells = table_cells(plain)
    words, rows = cells[0].tolist(), cells[1:]
    if _header(words) is None:
        words, rows = table_cells([c.lstrip("# ") for c in comments[-1:]]).ravel().tolist(), cells
    if not len(rows):
        raise ValueError("no line of numbers in it")
    if len(words) == rows.shape[1] and _header(words) is not None:
        return named_numbers(words, rows, given)
    texts = [i for i, cell in enumerate(rows[0].tolist()) if not is_number(cell)]
    numbers = cell_numbers(np.delete(rows, texts[:1], axis=1))
    if texts or numbers.shape[1] != 4:
        return plain_numbers(numbers, given, tuple(rows[:, texts[0]].tolist()) if texts else None)
    whole = (numbers == (0, 0, 0, 1)).all(1).any() or (given and given.layout == "columns")
    height = 3 if len(numbers) % 3 == 0 and not whole else 4
    if len(numbers) % height:
        raise ValueError(f"{len(numbers)} rows of 4 numbers are no 4x4 or 3x4 matrices")
    return plain_numbers(numbers.reshape(-1, height, 4), given)


def named_numbers(
    words: Sequence[str], rows: NDArray[np.str_], given: PoseConvention | None
) -> PoseTable:
    """Numbers of rows (n, k) whose columns have names.

    Raises:
        ValueError: The names are ambiguous or contradict the given convention, or a cell is no
            number.
    """
    header = _header(words) or _Header({}, {})
    names, stamps, others = row_labels(words, rows.T.tolist(), len(rows))
    convention = given or pose_convention(_defined(header, words))
    for key, columns in header.groups.items():
        if convention.layout == "columns":
            columns = np.reshape(columns, (-1, 4)).T.ravel().tolist()
        elif key in _AXES and convention.layout != "vector":
            columns = [columns[_AXES[key].find(axis)] for axis in convention.layout.lower()]
        if not convention.is_matrix:
            columns = [*header.groups.get("position", ()), *columns]
        if convention.base in HEADERS[key].conventions and len(columns) in convention.counts:
            for part, final in (("position", ("m", "mm")), (key, ("rad", "deg"))):
                if part in header.units and not convention.has(*final):
                    convention = replace(convention, **UNITS[header.units[part]])
            chosen = cell_numbers(rows[:, columns], [words[column] for column in columns])
            return PoseTable(chosen, convention, names, stamps)
    if header.groups.keys() <= {"position"} and len(others) in convention.counts:
        return PoseTable(cell_numbers(rows[:, others]), convention, names, stamps)
    raise ConventionError(
        f"the columns {', '.join(words)} are none of {convention.name} ({convention.meaning})",
        "of the columns, or leave it out if their names define it",
    )


def plain_numbers(numbers: Array, given: PoseConvention | None, names: Names = None) -> PoseTable:
    """Matrices (n, 4, 4) or (n, 3, 4), or numbers (n, k) or with stamps (n, 1 + k).

    Raises:
        ValueError: They do not fit the convention, or none is given and they do not define it.
    """
    if numbers.ndim != 2:
        given = given or pose_convention("matrix")
        if numbers.shape[1:] not in ((4, 4), (3, 4)) or not given.is_matrix:
            raise ValueError(
                f"poses are (n, 4, 4), (n, 3, 4) or (n, k) numbers, got {numbers.shape} for"
                f" {given.name} ({given.meaning})"
            )
        numbers = numbers.reshape(len(numbers), -1)
    width = numbers.shape[1]
    if given is None and width in (12, 13, 16, 17):
        given = matrix_convention(numbers[:, width % 4 :])
    if given is None:
        raise ConventionError(
            f"{width} columns without a header do not define a pose; write a header such as"
            f" x,y,z,qw,qx,qy,qz",
            f"NAME, one of {KNOWN_CONVENTIONS}",
        )
    count = next((count for count in given.counts if 0 <= width - count <= 1), 0)
    stamps = in_unit(numbers[:, 0]) if count and width > count else None
    back = np.flatnonzero(np.diff(numbers[:, 0]) < 0)
    # A misplaced number shows in quaternions and matrices, but not in angles.
    if not count or (stamps is not None and given.has_angles and back.size):
        raise ValueError(
            f"rows have {width} numbers; {given.name} takes {' or '.join(map(str, given.counts))}"
            f" ({given.meaning}), optionally after a name and a stamp that increases"
        )
    return PoseTable(numbers[:, width - count :], given, names, stamps)


def _without_brackets(
    lines: list[str], given: PoseConvention | None
) -> tuple[list[str], PoseConvention | None]:
    """Lines of a table with a line for each bracket, and the convention that a notation defines."""
    found: list[list[str]] = []
    kinds: set[str] = set()
    for word, bracket, inside in _BRACKETS.findall("\n".join(lines)):
        values = dict(re.findall(r"\b([XYZABC])\s+([^\s,]+)", inside))
        numbers = [values.get(key, "") for key in "XYZABC"]
        numbers = numbers if bracket == "{" else inside.replace(",", " ").split()
        if len(numbers) > 3 and all(map(is_number, numbers)):
            found.append([word, *numbers])
            kinds.add(bracket)
    if len(kinds) > 1:
        raise ValueError(f"it mixes the brackets {' and '.join(sorted(kinds))}; use one notation")
    words = [word for word, *_ in found]
    named = all(words) and (len(found) == 1 or len({*words}) > 1)  # else E6POS or nothing
    rows = [",".join(row if named else row[1:]) for row in found]
    given = given or (pose_convention("kuka") if "{" in kinds else None)
    header = _NOTATIONS[kinds.pop()] if found else ""
    label = "" if not named else "stamp," if is_number(found[0][0]) else "image,"
    return ([label + header, *rows] if header else rows or lines), given


def _header(words: Sequence[str]) -> _Header | None:
    """Interpret the cells of a first line, or return None if they are numbers.

    Raises:
        ValueError: The columns of a group differ in unit, or a column is ambiguous.
    """
    names = [name_and_unit(word) for word in words]
    header, used = _Header({}, {}), set[int]()
    for key, group in HEADERS.items():
        found: list[list[int]] = []
        for k, end in enumerate(group.ends):
            some = {prefix + end for prefix in group.prefixes}
            some |= {f"{prefix}{k}" for prefix in group.prefixes if prefix.endswith("vec_")}
            found.append([column for column, (name, _) in enumerate(names) if name in some])
        columns = [candidates[0] for candidates in found if candidates]
        # rotation_x belongs to a quaternion if there is a rotation_w.
        if not all(found) or used & {*columns}:
            continue
        for repeated in (candidates for candidates in found if len(candidates) > 1):
            which = " and ".join(words[column] for column in repeated)
            raise ValueError(f"the columns {which} may both be the {key}'s; keep those of the pose")
        used |= {*columns}
        units = {names[column][1] for column in columns}
        if len(units) > 1:
            raise ValueError(f"the columns {', '.join(words[c] for c in columns)} differ in unit")
        header.groups[key] = columns
        if (unit := units.pop()) in (("m", "mm") if key == "position" else ("rad", "deg")):
            header.units[key] = str(unit)
    numbers = [is_number(word) for word in words]
    return None if all(numbers) or (not header.groups and any(numbers)) else header


def _defined(header: _Header, words: Sequence[str]) -> str:
    """Name of the only convention that the columns define."""
    rotations = [key for key in header.groups if key != "position"]
    stated = header.units.keys() & {"roll pitch yaw"}
    sure = [key for key in rotations if not HEADERS[key].ask or key in stated]
    conventions = [HEADERS[key].conventions[0] for key in sure]
    if len(sure) == 1 and ("position" in header.groups or conventions == ["matrix"]):
        return conventions[0]
    if sure[1:]:
        raise ConventionError(f"the header names {' and '.join(sure)}", " or ".join(conventions))
    if rotations and not sure:
        columns = ", ".join(words[column] for column in header.groups[rotations[0]])
        ask = HEADERS[rotations[0]].ask
        raise ConventionError(f"columns {columns} do not define a rotation", ask)
    raise ConventionError(
        f"the columns {', '.join(words)} name no known pose (such as x y z qw qx qy qz)",
        f"NAME, one of {KNOWN_CONVENTIONS}",
    )
