"""Tables of poses: columns with names, plain numbers, matrices, and robots' own notations.

Lines that start with # are ignored, except that the last of them before the numbers may be the
header, as in files of numpy and TUM. Rows without a header have the numbers of a convention,
optionally preceded by a stamp, and a name before or after them. Matrices may be blocks of 3 or 4
lines, with numpy's brackets or without. Notations are `p[...]` of Universal Robots and
`{X ..., C ...}` of KUKA.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evercal.bounds import require_at_most
from evercal.recordings.poses.conventions import (
    KNOWN_CONVENTIONS,
    UNITS,
    ConventionError,
    PoseConvention,
    matrix_convention,
    pose_convention,
)
from evercal.recordings.poses.row_files import (
    Cells,
    Names,
    cell_numbers,
    in_unit,
    is_number,
    name_and_unit,
    row_labels,
    table_cells,
)

Array = NDArray[np.float64]


class PoseTable(NamedTuple):
    """(n, k) numbers in a convention, with (n,) names and seconds if there are any."""

    numbers: Array
    convention: PoseConvention
    names: Names = None
    stamps_s: Array | None = None
    fixed: bool = False
    """Whether keys of the file state the poses themselves."""


class Columns(NamedTuple):
    """Columns that belong together."""

    prefixes: str
    """Words before the end of a name, between commas."""
    ends: Sequence[str]
    """End of the name of each column; after tvec_ and rvec_ also its index."""
    conventions: Sequence[str] = ()
    """Conventions that the columns of a rotation may hold."""
    ask: str = ""
    """Conventions to ask for; empty if the columns define the first one."""

    def names(self, index: int) -> set[str]:
        """Possible names of one column."""
        prefixes = self.prefixes.split(",")
        by_index = {f"{prefix}{index}" for prefix in prefixes if "vec_" in prefix}
        return {prefix + self.ends[index] for prefix in prefixes} | by_index


_GRID = [f"{row}{column}" for row in range(4) for column in range(4)]
HEADERS = {
    "position": Columns(",t,t_,p,pos_,position_,translation_,tvec_,p_rs_r_", "xyz"),
    "quaternion": Columns(
        "q,q_,quat_,quaternion_,orientation_,rotation_,q_rs_", "wxyz",
        ("wxyz", "xyzw", "tum", "abb"),
    ),
    "rotation vector": Columns("rotvec_,rvec_,rotation_vector_", "xyz", ("ur",)),
    "matrix": Columns("m", _GRID, ("matrix", "franka")),
    "3x4 matrix": Columns("m", _GRID[:12], ("matrix", "franka")),
    "W P R": Columns("", "wpr", ("fanuc",)),
    "angles": Columns(
        "r,r_,rot_,rotation_", "xyz", ("ur", "yaskawa", "staubli", "fanuc", "rpy"),
        "ur (rotation vector), yaskawa, staubli, fanuc or rpy",
    ),
    "roll pitch yaw": Columns(
        "", ("roll", "pitch", "yaw"), ("rpy", "yaskawa", "staubli", "fanuc", "kuka"),
        "rpy:rad or rpy:deg",
    ),
    "A B C": Columns("", "abc", ("kuka",), "kuka"),
    "q1 to q4": Columns("q", "1234", ("abb", "wxyz", "xyzw", "tum"), "abb, wxyz or xyzw"),
}  # fmt: skip
"""Columns of a position and of rotations; definite rotations come first."""
_AXES = {"quaternion": "wxyz", "angles": "xyz", "roll pitch yaw": "xyz"}
"""Columns that conventions order by axis; rx and roll rotate about x."""
_WORD = r'[^\s\[\](){}=,;:"]'
_NOTATION = re.compile(rf'(?:(?<!{_WORD})({_WORD}++)[\s=,;:"]+)?(p\[|\{{)([^\[\]{{}}]*)[\]}}]')
"""A word, if there is one, the bracket and what it holds. A word is read once, from its start."""

_Groups = dict[str, tuple[list[int], str | None]]
"""Columns and their unit, if stated, by key of `HEADERS`."""


def read_pose_table(text: str, given: PoseConvention | None) -> PoseTable:
    """Read a table; without a given convention, its header or notation defines it.

    ValueError, also of the functions below: this is no table, or its convention is not defined.
    """
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    plain = [line for line in lines if line[0] != "#"]
    comments = lines[: lines.index(plain[0])] if plain else []
    plain, given = _without_brackets(plain, given)
    rows = table_cells(plain)
    words = rows[0].tolist() if len(rows) else []
    if _is_header(words):
        rows = rows[1:]
    else:
        words = table_cells([line.lstrip("# ") for line in comments[-1:]]).ravel().tolist()
    if not len(rows):
        raise ValueError("no line of numbers in it")
    if len(words) == rows.shape[1] and _is_header(words):
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


def named_numbers(words: Sequence[str], rows: Cells, given: PoseConvention | None) -> PoseTable:
    """Numbers of rows (n, k) whose columns have names."""
    require_at_most(len(words), "columns", "columns")
    groups = _groups(words)
    names, stamps, others = row_labels(words, rows.T.tolist(), len(rows))
    convention = given or pose_convention(_defined(groups, words))
    columns = others if groups.keys() <= {"position"} else []
    position, length = groups.get("position", ([], None))
    for key, (rotation, unit) in groups.items():
        if convention.base not in HEADERS[key].conventions or columns:
            continue
        if convention.layout == "columns":
            rotation = np.reshape(rotation, (-1, 4)).T.ravel().tolist()
        elif key in _AXES and convention.layout != "vector":
            rotation = [rotation[_AXES[key].index(axis)] for axis in convention.layout.lower()]
        columns = rotation if convention.is_matrix else position + rotation
        if length is not None and not convention.has("m", "mm"):
            convention = replace(convention, **UNITS[length])
        if unit is not None and not convention.has("rad", "deg"):
            convention = replace(convention, **UNITS[unit])
    if len(columns) in convention.counts:
        numbers = cell_numbers(rows[:, columns], [words[column] for column in columns])
        return PoseTable(numbers, convention, names, stamps)
    raise ConventionError(
        f"the columns {', '.join(words)} are none of {convention.name} ({convention.meaning})",
        "of the columns, or leave it out if their names define it",
    )


def plain_numbers(numbers: Array, given: PoseConvention | None, names: Names = None) -> PoseTable:
    """Matrices (n, 4, 4) or (n, 3, 4), or numbers (n, k) or with stamps (n, 1 + k)."""
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
    # A misplaced number shows in quaternions and matrices, but not in angles.
    misplaced = stamps is not None and given.has_angles and (np.diff(stamps) < 0).any()
    if not count or misplaced:
        raise ValueError(
            f"rows have {width} numbers; {given.name} takes {' or '.join(map(str, given.counts))}"
            f" ({given.meaning}), optionally after a name and a stamp that increases"
        )
    return PoseTable(numbers[:, width - count :], given, names, stamps)


def _without_brackets(
    lines: list[str], given: PoseConvention | None
) -> tuple[list[str], PoseConvention | None]:
    """Lines of a table without brackets, and the convention that a robot's notation defines."""
    text = "\n".join(lines)
    found = _NOTATION.findall(text)
    # Units are in brackets, too, and KUKA has braces for other things.
    found = [each for each in found if re.search(r"\bX\s" if each[1] == "{" else ",", each[2])]
    if not found:
        if lines and re.search(r"\[\s*[-+.\d]", lines[0]):  # by numpy, which wraps long rows
            text = re.sub(r"\[[^\[\]]*\]", lambda row: row[0].replace("\n", " "), text)
            lines = re.sub(r'[\[\],;="]', " ", text).splitlines()
        return lines, given
    kinds = {bracket for _, bracket, _ in found}
    kinds |= set(re.findall(r"p?\[", text)) if "p[" in kinds else set()
    if len(kinds) > 1:
        raise ValueError(f"it mixes the brackets {' and '.join(sorted(kinds))}; use one notation")
    words = [word for word, *_ in found]
    named = all(words) and (len(found) == 1 or len({*words}) > 1)  # else a type, such as E6POS
    rows = []
    for word, bracket, inside in found:
        values = dict(re.findall(r"\b([XYZABC])\s+([^\s,]+)", inside))
        row = inside if bracket == "p[" else ",".join(values.get(key, "") for key in "XYZABC")
        rows.append(f"{word},{row}" if named else row)
    label = "" if not named else "stamp," if is_number(words[0]) else "image,"
    if "{" in kinds:
        return [label + "X,Y,Z,A,B,C", *rows], given or pose_convention("kuka")
    return [label + "x,y,z,rotvec_x,rotvec_y,rotvec_z", *rows], given


def _is_header(words: Sequence[str]) -> bool:
    numbers = [is_number(word) for word in words]
    return not all(numbers) and (not any(numbers) or bool(_groups(words)))


def _groups(words: Sequence[str]) -> _Groups:
    names, units = zip(*map(name_and_unit, words), strict=True)
    groups: _Groups = {}
    for key, group in HEADERS.items():
        found = [
            [column for column, name in enumerate(names) if name in group.names(i)]
            for i in range(len(group.ends))
        ]
        columns = [candidates[0] for candidates in found if candidates]
        # rotation_x belongs to a quaternion if there is a rotation_w.
        if not all(found) or any({*columns} & {*used} for used, _ in groups.values()):
            continue
        for repeated in (candidates for candidates in found if len(candidates) > 1):
            which = " and ".join(words[column] for column in repeated)
            raise ValueError(f"the columns {which} may both be the {key}'s; keep those of the pose")
        unit = units[columns[0]]
        if any(units[column] != unit for column in columns):
            raise ValueError(f"the columns {', '.join(words[c] for c in columns)} differ in unit")
        stated = unit in (("m", "mm") if key == "position" else ("rad", "deg"))
        groups[key] = columns, unit if stated else None
    return groups


def _defined(groups: _Groups, words: Sequence[str]) -> str:
    rotations = [key for key in groups if key != "position"]
    sure = [k for k in rotations if not HEADERS[k].ask or (k == "roll pitch yaw" and groups[k][1])]
    conventions = [HEADERS[key].conventions[0] for key in sure]
    if len(sure) == 1 and ("position" in groups or conventions == ["matrix"]):
        return conventions[0]
    if sure[1:]:
        raise ConventionError(f"the header names {' and '.join(sure)}", " or ".join(conventions))
    if rotations and not sure:
        columns = ", ".join(words[column] for column in groups[rotations[0]][0])
        problem = f"columns {columns} do not define a rotation"
        raise ConventionError(problem, HEADERS[rotations[0]].ask)
    raise ConventionError(
        f"the columns {', '.join(words)} name no known pose (such as x y z qw qx qy qz)",
        f"NAME, one of {KNOWN_CONVENTIONS}",
    )
