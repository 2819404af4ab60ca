"""Tables of poses: columns with names, plain numbers, matrices, and robots' own notations.

Lines that start with #, % or // are ignored, except that the last of them before the numbers may be
the header, as in files of numpy and TUM. Rows without a header have the numbers of a convention,
optionally preceded by a stamp, and a name before or after them. Matrices may be blocks of 3 or 4
lines, with numpy's brackets or without. Notations are `p[...]` of Universal Robots and
`{X ..., C ...}` of KUKA.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

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
from evercal.typing import Array


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
    axes: str = ""
    """Axis of each column, for conventions that order their numbers by axis."""

    def names(self, index: int) -> set[str]:
        """Possible names of one column."""
        prefixes = self.prefixes.split(",")
        by_index = {
            f"{p}{index}" for p in prefixes if self.ends == "xyz" and p.endswith("_")
        }
        return {prefix + self.ends[index] for prefix in prefixes} | by_index

    def ordered(self, columns: list[int], convention: PoseConvention) -> list[int]:
        """Columns of this rotation in the order of a convention; none if they do not hold it."""
        layout = convention.layout.lower()
        stated = convention.base in self.conventions
        generic = convention.base.startswith(("fixed_", "moving_"))
        if layout == "columns" and stated:
            return np.reshape(columns, (-1, 4)).T.ravel().tolist()
        if self.axes and sorted(layout) == sorted(self.axes) and (stated or generic):
            return [columns[self.axes.index(axis)] for axis in layout]
        # Letters without an axis are in the order of the convention that is stated.
        free = not self.axes or (self.axes == "xyz" and len({*layout}) < 3)
        free = free and convention.has_angles and len(layout) == len(columns)
        return columns if stated or free else []


_GRID = [f"{row}{column}" for row in range(4) for column in range(4)]
_DOWN = [str(4 * column + row) for row in range(4) for column in range(4)]
_GRID_3 = [f"{row}{column}" for row in range(3) for column in range(3)]
_ANGLES = ("ur", "yaskawa", "staubli", "fanuc", "rpy")
_ORDERS = ("abb", "wxyz", "xyzw", "tum")
_Q = "q,q_,quat,quat_,quaternion_,orientation_,rotation_,q_rs_"
_R = "r,r_,rot_,rotation_"
HEADERS = {
    "position": Columns(",t,t_,p,p_,pos_,position_,translation_,tvec_,p_rs_r_", "xyz"),
    "quaternion": Columns(_Q, "wxyz", ("wxyz", *_ORDERS), axes="wxyz"),
    "rotation vector": Columns("rotvec_,rvec_,rotation_vector_", "xyz", ("ur",), axes="-"),
    "matrix": Columns("m", _GRID, ("matrix", "franka")),
    "3x4 matrix": Columns("m", _GRID[:12], ("matrix", "franka")),
    "O_T_EE": Columns("o_t_ee,o_t_ee_", _DOWN, ("matrix", "franka")),
    "RTDE": Columns("actual_tcp_pose_", "012345", ("ur",)),
    "rotation matrix": Columns(_R, _GRID_3, ("matrix",)),
    "matrix from r11": Columns(_R, [f"{int(at) + 11}" for at in _GRID_3], ("matrix",)),
    "W P R": Columns("", "wpr", ("fanuc",)),
    "O A T": Columns("", "oat", ("kawasaki",)),
    "q1 to q4": Columns(_Q, "1234", _ORDERS, "abb, wxyz or xyzw"),
    "q0 to q3": Columns(_Q, "0123", _ORDERS, "wxyz or xyzw"),
    "angles": Columns(
        _R, "xyz", _ANGLES, "ur (rotation vector), yaskawa, staubli, fanuc or rpy", "xyz"
    ),
    "roll pitch yaw": Columns(
        "", ("roll", "pitch", "yaw"), ("rpy", "yaskawa", "staubli", "fanuc", "kuka"),
        "rpy:rad or rpy:deg", "xyz",
    ),
    "A B C": Columns("", "abc", ("kuka",), "kuka (A about z) or mitsubishi (A about x)"),
    "U V W": Columns("", "uvw", ("kuka",), "epson (U about z)"),
}  # fmt: skip
"""Columns of a position and of rotations; definite rotations come first."""
_COMMENTS = ("#", "%", "//")
_INDICES = (
    "",
    "index",
    "idx",
    "id",
    "no",
    "nr",
    "i",
    "n",
    "number",
    "row",
    "pose",
    "sample",
)
"""Columns that only count."""
_WORD = r'[^\s\[\](){}=,;:"]'
_NOTATIONS = {
    "Translation: [": (
        r"(?:At time (\S+)\s+)?- Translation: \[([^\[\]]*)\]\s+- Rotation: in Quaternion[^\[\n]*"
        r"\[([^\[\]]*)\](?:\n(?!At time |- Translation).*)*",
        "x,y,z,qx,qy,qz,qw",
    ),
    "robtarget [": (
        r"()\[\s*\[([^\[\],]*(?:,[^\[\],]*){2})\]\s*,\s*\[([^\[\],]*(?:,[^\[\],]*){3})\]"
        r"\s*,\s*\[[^\[\]]*\]\s*,\s*\[[^\[\]]*\]\s*\]",
        "x_mm,y_mm,z_mm,qw,qx,qy,qz",
    ),
    "P[": (r"()\bP\[\d[^\[\]\n]*\]\s*\{([^{}]*)\}()", "X,Y,Z,W,P,R"),
    "p[": (rf'(?:(?<!{_WORD})({_WORD}++)[\s=,;:"]+)?p\[([^\[\]{{}}]*)\]()',
           "x,y,z,rotvec_x,rotvec_y,rotvec_z"),
    "{": (rf'(?:(?<!{_WORD})({_WORD}++)[\s=,;:"]+)?\{{([^\[\]{{}}]*\bX\s+[-+.\d][^\[\]{{}}]*)\}}()',
          "X,Y,Z,A,B,C"),
}  # fmt: skip
"""By how it begins: a pose as a pattern of a name or stamp and two parts, and its columns.

They are tf2_echo of ROS, RAPID of ABB, LS of FANUC, URScript and KRL of KUKA. A word is read once,
from its start."""

_Groups = dict[str, list[int]]
"""Columns by key of `HEADERS`."""


def read_pose_table(text: str, given: PoseConvention | None) -> PoseTable:
    """Read a table; without a given convention, its header or notation defines it.

    ValueError, also of the functions below: this is no table, or its convention is not defined.
    """
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    plain = [line for line in lines if not line.startswith(_COMMENTS)]
    comments = lines[: lines.index(plain[0])] if plain else []
    plain, given = _without_brackets(plain, given)
    rows = table_cells(plain)
    words = rows[0].tolist() if len(rows) else []
    if _is_header(words):
        rows = rows[1:]
    else:
        words = (
            table_cells([line.lstrip("#%/ ") for line in comments[-1:]])
            .ravel()
            .tolist()
        )
    if not len(rows):
        raise ValueError("no line of numbers in it")
    if len(words) == rows.shape[1] and _is_header(words):
        return named_numbers(words, rows, given)
    same = [
        i
        for i, cell in enumerate(rows[0])
        if {cell} == {*rows[1:, i]} and not is_number(cell)
    ]
    rows = np.delete(rows, same, axis=1)  # such as a frame
    texts = [i for i, cell in enumerate(rows[0].tolist()) if not is_number(cell)]
    numbers = cell_numbers(np.delete(rows, texts[:1], axis=1))
    if texts or numbers.shape[1] != 4:
        names = tuple(rows[:, texts[0]].tolist()) if texts else None
        return plain_numbers(numbers, given, names)
    whole = (numbers == (0, 0, 0, 1)).all(1).any() or (
        given and given.layout == "columns"
    )
    height = 3 if len(numbers) % 3 == 0 and not whole else 4
    if len(numbers) % height:
        raise ValueError(f"{len(numbers)} rows of 4 numbers are no 4x4 or 3x4 matrices")
    return plain_numbers(numbers.reshape(-1, height, 4), given)


def has_position(words: Sequence[str]) -> bool:
    """Whether columns of these names hold a position."""
    return "position" in _groups(words)


def named_numbers(
    words: Sequence[str], rows: Cells, given: PoseConvention | None
) -> PoseTable:
    """Numbers of rows (n, k) whose columns have names."""
    require_at_most(len(words), "columns", "columns")
    groups = _groups(words)
    used = {column for columns in groups.values() for column in columns}
    free = ["" if i in used else word for i, word in enumerate(words)]
    names, stamps, others = row_labels(free, rows.T.tolist(), len(rows))
    convention = given or pose_convention(_defined(groups, words))
    position = groups.pop("position", [])
    ordered = [HEADERS[key].ordered(groups[key], convention) for key in groups]
    columns = next(filter(None, ordered), [])
    if not groups:
        others = [i for i in others if name_and_unit(words[i])[0] not in _INDICES]
        position = position or others[: 0 if convention.is_matrix else 3]
        columns = [i for i in others if i not in position]
    convention = _in_units(convention, [words[i] for i in position], "m", "mm")
    if convention.has_angles:
        convention = _in_units(convention, [words[i] for i in columns], "rad", "deg")
    if not convention.is_matrix:
        columns = position + columns
    elif len(columns) == 9 and len(position) == 3:
        columns = np.c_[np.reshape(columns, (3, 3)), position].ravel().tolist()
    if len(columns) in convention.counts:
        numbers = cell_numbers(rows[:, columns], [words[column] for column in columns])
        return PoseTable(numbers, convention, names, stamps)
    raise ConventionError(
        f"the columns {', '.join(words)} are none of {convention.name} ({convention.meaning})",
        f"of the columns, or name them as {convention.meaning.split(',')[0]!r}",
    )


def _in_units(
    convention: PoseConvention, words: Sequence[str], *known: str
) -> PoseConvention:
    """The convention in the unit that columns state, unless its own name has one."""
    units = {name_and_unit(word)[1] for word in words}
    if len(units) > 1:
        raise ValueError(f"the columns {', '.join(words)} differ in unit")
    unit = units.pop() if units else None
    if unit is None:
        return convention
    if unit not in known:
        problem = f"the columns {', '.join(words)} are in {unit}"
        raise ValueError(f"{problem}; write {' or '.join(known)}")
    return convention if convention.has(*known) else replace(convention, **UNITS[unit])


def plain_numbers(
    numbers: Array, given: PoseConvention | None, names: Names = None
) -> PoseTable:
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
    ros = width - 2 in given.counts and not (numbers[:, :2] // [4e9, 1e9]).any()
    if ros and not (numbers[:, :2] % 1).any() and numbers[:, 0].min() > 1e9:
        numbers = np.c_[numbers[:, :2] @ [1, 1e-9], numbers[:, 2:]]
        width = width - 1
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
    kinds = [
        kind for kind, (pattern, _) in _NOTATIONS.items() if re.search(pattern, text)
    ]
    if len(kinds) > 1:
        raise ValueError(
            f"it mixes the brackets {' and '.join(sorted(kinds))}; use one notation"
        )
    if not kinds:
        return _without_lists(lines), given
    pattern, header = _NOTATIONS[kinds[0]]
    for line in re.sub(pattern, " ", text).splitlines():
        cells = [*filter(None, re.split(r"[^\w.+#-]+", line))]
        numbers = sum(map(is_number, cells))
        if numbers > 2 and 2 * numbers > len(cells) and ":=" not in line:
            raise ValueError(
                f"{line.strip()[:60]!r} is beside poses in {kinds[0]}; use one notation"
            )
    found = re.findall(pattern, text)
    words = [word for word, *_ in found]
    # Else a type, such as E6POS.
    named = all(words) and (len(found) == 1 or len({*words}) > 1)
    rows = []
    for word, first, second in found:
        row = f"{first},{second}" if second else first
        if header[0] == "X":
            values = dict(re.findall(r"\b([XYZABCWPR])[\s=]+([^\s,]+)", first))
            row = ",".join(values.get(key, "") for key in header.split(","))
        rows.append(f"{word},{row}" if named else row)
    label = "" if not named else "stamp," if is_number(words[0]) else "image,"
    return [label + header, *rows], given or (
        pose_convention("kuka") if kinds[0] == "{" else None
    )


def _without_lists(lines: list[str]) -> list[str]:
    """Lines without the brackets of numpy, Python and robots' functions, such as XY(...)."""
    # Titles.
    lines = [re.sub(r"^[^\[\]]*[:=]\s*(?=$|\[\[)", "", line) for line in lines]
    lines = [line for line in lines if line]
    cut = next((s for s in ";,\t" if s in "".join(lines[:1])), " ")
    label = re.compile(r"^([^\s,;:=]+)\s*(?::\s|=)\s*(?=[-+.\d])")  # P1 = 412.0
    lines = [label.sub(rf"\1{cut}", line) for line in lines]
    if not lines or not re.search(r"((?<!\w)\[|[({])\s*[-+.\d]", lines[0]):
        return lines
    text = re.sub(r"\b\w+\(", "(", "\n".join(lines))
    # Wrapped by numpy.
    text = re.sub(r"\[[^\[\]]*\]", lambda row: row[0].replace("\n", " "), text)
    return re.sub(r'[\[\](){},;="]|:(?=\s)', " ", text).splitlines()


def _is_header(words: Sequence[str]) -> bool:
    numbers = [is_number(word) for word in words]
    return not all(numbers) and (not any(numbers) or bool(_groups(words)))


def _groups(words: Sequence[str]) -> _Groups:
    """Columns by their names, or by those after one beginning, such as `ee_`."""
    names = [name_and_unit(word)[0] for word in words]
    if groups := _matched(names, words):
        return groups
    ends = [f"_{x}" for x in HEADERS["position"].names(0)]
    starts = {
        name.removesuffix(x[1:]) for name in names for x in ends if name.endswith(x)
    }
    rests = {
        s: [n[len(s) :] if n.startswith(s) else "" for n in names]
        for s in sorted(starts)
    }
    found = {s: groups for s in rests if len(groups := _matched(rests[s], words)) > 1}
    if len(found) > 1:
        raise ValueError(
            f"it holds poses of {' and '.join(found)}; keep the columns of one"
        )
    return next(iter(found.values()), {})


def _matched(names: Sequence[str], words: Sequence[str]) -> _Groups:
    groups: _Groups = {}
    for key, group in HEADERS.items():
        found = [
            [column for column, name in enumerate(names) if name in group.names(i)]
            for i in range(len(group.ends))
        ]
        columns = [candidates[0] for candidates in found if candidates]
        # rotation_x belongs to a quaternion if there is a rotation_w.
        if not all(found) or any({*columns} & {*used} for used in groups.values()):
            continue
        for repeated in (candidates for candidates in found if len(candidates) > 1):
            which = " and ".join(words[column] for column in repeated)
            raise ValueError(
                f"the columns {which} may both be the {key}'s; keep those of the pose"
            )
        groups[key] = columns
    return groups


def _defined(groups: _Groups, words: Sequence[str]) -> str:
    rotations = [key for key in groups if key != "position"]
    stated = {key: name_and_unit(words[groups[key][0]])[1] for key in rotations}
    sure = [
        k
        for k in rotations
        if not HEADERS[k].ask or (k == "roll pitch yaw" and stated[k])
    ]
    conventions = [HEADERS[key].conventions[0] for key in sure]
    whole = sure and len(groups[sure[0]]) in pose_convention(conventions[0]).counts
    if len(sure) == 1 and ("position" in groups or whole):
        return conventions[0]
    if sure[1:]:
        raise ConventionError(
            f"the header names {' and '.join(sure)}", " or ".join(conventions)
        )
    if rotations and not sure:
        columns = ", ".join(words[column] for column in groups[rotations[0]])
        problem = f"columns {columns} do not define a rotation"
        raise ConventionError(problem, HEADERS[rotations[0]].ask)
    raise ConventionError(
        f"the columns {', '.join(words)} name no known pose (such as x y z qw qx qy qz)",
        f"NAME, one of {KNOWN_CONVENTIONS}",
    )
