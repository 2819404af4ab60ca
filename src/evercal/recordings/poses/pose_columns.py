"""Which columns of a table hold a pose, by their names.

Columns with names define a convention, or leave it open between several, such as angles.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import chain, product
from typing import NamedTuple

import numpy as np

from evercal.bounds import require_at_most
from evercal.recordings.poses.conventions import (
    OF_COLUMNS,
    UNITS,
    ConventionError,
    Given,
    PoseConvention,
    pose_convention,
)
from evercal.recordings.poses.likely_readings import USUAL, undefined
from evercal.recordings.poses.row_files import (
    Cells,
    Names,
    cell_numbers,
    name_and_unit,
    plain_names,
    row_labels,
)
from evercal.robot.frame_names import UNKNOWN, FrameNames
from evercal.storage.text_files import few
from evercal.typing import Array


class PoseTable(NamedTuple):
    """Numbers of n poses."""

    numbers: Array
    """(n, k) in the convention."""
    convention: PoseConvention
    names: Names = None
    """(n,) names of images or rows, if there are any."""
    stamps_s: Array | None = None
    """(n,) seconds, if there are any."""
    fixed: bool = False
    """Whether keys of the file state the poses themselves."""
    frames: FrameNames = UNKNOWN
    """Names of the frames that messages of ROS state."""


class ColumnGroup(NamedTuple):
    """Columns that belong together: a position or a rotation."""

    prefixes: str
    """Words before the end of a name, between commas."""
    ends: Sequence[str]
    """End of the name of each column; after tvec_ and rvec_ also its index."""
    conventions: Sequence[str] = ()
    """Conventions that the columns of a rotation may hold."""
    ask: Sequence[str] = ()
    """Conventions to offer; empty if the columns define the first one."""
    axes: str = ""
    """Axis of each column, for conventions that order their numbers by axis."""

    def names(self, index: int) -> set[str]:
        """Possible names of one column."""
        names = set()
        for prefix in self.prefixes.split(","):
            names.add(prefix + self.ends[index])
            if self.ends == "xyz" and prefix.endswith("_"):
                names.add(f"{prefix}{index}")
        return names

    def candidates(self, words: Sequence[str]) -> list[list[int]]:
        """Columns of a table that may be each column of the group."""
        candidates = []
        for index in range(len(self.ends)):
            names = self.names(index)
            candidates.append([i for i, word in enumerate(words) if word in names])
        return candidates

    def ordered(self, columns: list[int], convention: PoseConvention) -> list[int]:
        """Columns of this rotation in the order of a convention; none if they do not hold it."""
        layout = convention.layout.lower()
        stated = convention.base in self.conventions
        if stated and layout == "columns":
            grid = np.reshape(columns, (-1, 4))
            return grid.T.ravel().tolist()
        generic = convention.base.startswith(("fixed_", "moving_"))
        same_axes = sorted(layout) == sorted(self.axes)
        if same_axes and (stated or generic):
            return [columns[self.axes.index(axis)] for axis in layout]
        if stated:
            return columns
        # Letters without an axis are in the order of the convention that is stated.
        by_axis = self.axes and (self.axes != "xyz" or len(set(layout)) == 3)
        if by_axis or len(layout) != len(columns):
            return []
        return columns if convention.has_angles else []


def _grid(digits: str) -> list[str]:
    return [row + column for row, column in product(digits, repeat=2)]


_GRID = _grid("0123")
_DOWN = np.arange(16).reshape(4, 4).T.ravel().astype(str).tolist()
_ANGLES = (
    "ur",
    "yaskawa",
    "staubli",
    "fanuc",
    "rpy",
)
_ORDERS = (
    "abb",
    "wxyz",
    "xyzw",
    "tum",
)
_Q = "q,q_,quat,quat_,quaternion_,orientation_,rotation_,q_rs_"
_R = "r,r_,rot_,rotation_,ori_"
HEADERS = {
    "position": ColumnGroup(
        ",t,t_,p,p_,pos_,position_,translation_,tvec_,p_rs_r_", "xyz"
    ),
    "quaternion": ColumnGroup(f"{_Q},{_R}", "wxyz", ("wxyz", *_ORDERS), axes="wxyz"),
    "rotation vector": ColumnGroup(
        "rotvec_,rvec_,rotation_vector_", "xyz", ("ur",), axes="-"
    ),
    "matrix": ColumnGroup("m", _GRID, ("matrix", "franka")),
    "3x4 matrix": ColumnGroup("m", _GRID[:12], ("matrix", "franka")),
    "O_T_EE": ColumnGroup("o_t_ee,o_t_ee_", _DOWN, ("matrix", "franka")),
    "RTDE": ColumnGroup("actual_tcp_pose_", "012345", ("ur",)),
    "rotation matrix": ColumnGroup(_R, _grid("012"), ("matrix",)),
    "matrix from r11": ColumnGroup(_R, _grid("123"), ("matrix",)),
    "W P R": ColumnGroup("", "wpr", ("fanuc",)),
    "O A T": ColumnGroup("", "oat", ("kawasaki",)),
    "q1 to q4": ColumnGroup(_Q, "1234", _ORDERS, ("abb", "wxyz", "xyzw")),
    "q0 to q3": ColumnGroup(_Q, "0123", _ORDERS, ("wxyz", "xyzw")),
    "angles": ColumnGroup(
        _R,
        "xyz",
        _ANGLES,
        ("ur", "rpy", "yaskawa", "staubli"),
        "xyz",
    ),
    "roll pitch yaw": ColumnGroup(
        "",
        ("roll", "pitch", "yaw"),
        ("rpy", "yaskawa", "staubli", "fanuc", "kuka"),
        ("rpy:rad", "rpy:deg"),
        "xyz",
    ),
    "alpha beta gamma": ColumnGroup(
        "", ("alpha", "beta", "gamma"), _ANGLES, ("staubli", "yaskawa"), "xyz"
    ),
    "A B C": ColumnGroup("", "abc", ("kuka",), ("kuka", "mitsubishi")),
    "U V W": ColumnGroup("", "uvw", ("kuka",), ("epson",)),
}
"""Columns of a position and of rotations; definite rotations come first."""
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

POSITIONS = (
    "are positions only, poses need rotations: add the columns of a quaternion, a rotation vector"
    " or angles"
)
"""What is missing in a table of points."""
_Groups = dict[str, list[int]]
"""Columns by key of `HEADERS`."""


def has_position(words: Sequence[str]) -> bool:
    """Whether columns of these names hold a position."""
    return "position" in groups_of(words)


def named_numbers(words: Sequence[str], rows: Cells, given: Given) -> PoseTable:
    """Numbers of rows (n, k) whose columns have names.

    ValueError, also of the functions below: the columns hold no pose, or their convention is not
    defined.
    """
    require_at_most(len(words), "columns", "columns")
    groups = groups_of(words)
    plain = plain_names(words)
    free = [*words]
    for column in chain.from_iterable(groups.values()):
        free[column] = ""
    names, stamps, others = row_labels(free, rows.T.tolist(), len(rows))
    if not given or given.base == OF_COLUMNS:
        name, problem, offers = _defined(groups, words)
        if problem:
            unknown = [i for i in others if free[i] and plain[i] not in _INDICES]
            if groups.keys() == {"position"} and not unknown:
                problem = f"the columns {', '.join(words)} {POSITIONS}"
                raise ValueError(problem)
            problem += f" (first row: {' '.join(map(str, rows[0, :8]))})"
            raise undefined(problem, offers, partial(named_numbers, words, rows))
        modifiers = given.name.split(":")[1:] if given else []
        given = pose_convention(":".join([name, *modifiers]))
    convention = given
    position = groups.pop("position", [])
    columns: list[int] = []
    for key, group in groups.items():
        columns = columns or HEADERS[key].ordered(group, convention)
    if not groups:
        others = [i for i in others if plain[i] not in _INDICES]
        if not position and not convention.is_matrix:
            position = others[:3]
        columns = [i for i in others if i not in position]
    header = np.array(words, object)
    convention = _in_units(convention, header[position].tolist(), "m", "mm")
    if convention.has_angles:
        convention = _in_units(convention, header[columns].tolist(), "rad", "deg")
    if not convention.is_matrix:
        columns = position + columns
    elif len(columns) == 9 and len(position) == 3:
        columns = np.c_[np.reshape(columns, (3, 3)), position].ravel().tolist()
    if len(columns) in convention.counts:
        numbers = cell_numbers(rows[:, columns], tuple(header[columns]))
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
    columns = f"the columns {', '.join(words)}"
    if len(units) > 1:
        raise ValueError(f"{columns} differ in unit")
    for unit in units - {None}:
        if unit not in known:
            raise ValueError(f"{columns} are in {unit}; write {' or '.join(known)}")
        if not convention.has(*known):
            return replace(convention, **UNITS[unit])
    return convention


def groups_of(words: Sequence[str]) -> _Groups:
    """Columns of `HEADERS` by their names, or by those after one beginning, such as `ee_`."""
    names = plain_names(words)
    groups = _matched(names, words)
    if groups:
        return groups
    beginnings = set()
    for position in HEADERS["position"].names(0):
        for name in names:
            if name.endswith(f"_{position}"):
                beginnings.add(name.removesuffix(position))
    poses: dict[str, _Groups] = {}
    for beginning in sorted(beginnings):
        ends = [
            name.removeprefix(beginning) if name.startswith(beginning) else ""
            for name in names
        ]
        groups = _matched(ends, words)
        if len(groups) > 1:
            poses[beginning] = groups
    if len(poses) > 1:
        raise ValueError(
            f"it holds poses of {' and '.join(poses)}; keep the columns of one"
        )
    return next(iter(poses.values()), {})


def _matched(names: Sequence[str], words: Sequence[str]) -> _Groups:
    header = np.array(words, object)
    groups: _Groups = {}
    used: set[int] = set()
    for key, group in HEADERS.items():
        candidates = group.candidates(names)
        if not all(candidates):
            continue
        columns = [first for first, *_ in candidates]
        # rotation_x belongs to a quaternion if there is a rotation_w.
        if not used.isdisjoint(columns):
            continue
        for repeated in candidates:
            if len(repeated) > 1:
                listed = " and ".join(header[repeated])
                raise ValueError(
                    f"the columns {listed} may both be the {key}'s; keep those of the pose"
                )
        groups[key] = columns
        used.update(columns)
    return groups


def _defined(groups: _Groups, words: Sequence[str]) -> tuple[str, str, Sequence[str]]:
    """The convention that columns define, or else why there is none, and what to offer."""
    definite = {}
    unclear = []
    for key, columns in groups.items():
        _, unit = name_and_unit(words[columns[0]])
        if key == "position":
            continue
        if HEADERS[key].ask and (key != "roll pitch yaw" or not unit):
            unclear.append(key)
        else:
            definite[key] = HEADERS[key].conventions[0]
    if len(definite) == 1:
        ((key, convention),) = definite.items()
        is_whole = len(groups[key]) in pose_convention(convention).counts
        if "position" in groups or is_whole:
            return convention, "", ()
    if len(definite) > 1:
        problem = f"the header names {' and '.join(definite)}"
        return "", problem, [*definite.values()]
    if unclear and not definite:
        key = unclear[0]
        columns = ", ".join(np.array(words, object)[groups[key]])
        problem = f"columns {columns} do not define a rotation"
        offers = HEADERS[key].ask
        _, unit = name_and_unit(words[groups[key][0]])
        if unit == "deg":  # robots state rotation vectors in radians
            offers = [name for name in offers if name != "ur"]
        return "", problem, offers
    problem = f"the columns {few(words, most=8)} name no known pose"
    return "", problem, USUAL
