"""Tables of poses: a header that names the columns, and rows of numbers.

Columns are separated by semicolons, commas, tabs or blanks. Lines that start with # are ignored,
except that the last of them before the numbers may be the header, as in files of numpy and TUM. A
table without a header has the numbers of its convention, optionally preceded by a stamp, and a name
before or after them.

Names of columns are case-insensitive and may have a unit (`x_mm`, `rx [deg]`); docs/formats.md
lists them. Quaternions, rotation vectors, matrices, W P R (FANUC), and roll pitch yaw with a unit
define the rotation. The others differ between robots and need a convention.
"""

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from evercal.recordings.poses.conventions import (
    KNOWN_CONVENTIONS,
    ConventionError,
    PoseConvention,
    pose_convention,
)
from evercal.recordings.poses.row_files import (
    Labels,
    find_labels,
    in_unit,
    is_number,
    name_and_unit,
    row_labels,
)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PoseHeader:
    """Columns of a pose table by their meaning."""

    cells: tuple[str, ...]
    groups: dict[str, tuple[int, ...]]
    """Columns by group: `position`, `quaternion` (w x y z), `angles` (x y z), ..."""
    units: dict[str, str]
    """`m` or `mm` of the position, `rad` or `deg` of angles, if the header states them."""
    labels: Labels
    """Columns of image names and times."""

    @property
    def rotations(self) -> list[str]:
        """Groups that hold a rotation."""
        return [group for group in self.groups if group != "position"]


_ALIASES: dict[str, tuple[tuple[str, ...], ...]] = {
    "position": tuple(
        (a, f"t{a}", f"t_{a}", f"p{a}", f"pos_{a}", f"position_{a}", f"translation_{a}")
        for a in "xyz"
    ),
    "quaternion": tuple(
        (f"q{a}", f"q_{a}", f"quat_{a}", f"quaternion_{a}", f"orientation_{a}", f"rotation_{a}")
        for a in "wxyz"
    ),
    "rotation_vector": tuple((f"rotvec_{a}", f"rvec_{a}", f"rotation_vector_{a}") for a in "xyz"),
    "matrix": tuple((f"m{row}{column}",) for row in range(4) for column in range(4)),
    "angles": tuple((f"r{a}", f"r_{a}", f"rot_{a}", f"rotation_{a}") for a in "xyz"),
    "roll_pitch_yaw": (("roll",), ("pitch",), ("yaw",)),
    "abc": (("a",), ("b",), ("c",)),
    "wpr": (("w",), ("p",), ("r",)),
    "q1234": (("q1",), ("q2",), ("q3",), ("q4",)),
}
"""By group: the possible column names of each of its numbers."""
_UNITS = {"position": ("m", "mm"), "quaternion": (), "matrix": (), "q1234": ()}
"""Units of the groups that are not angles."""
_DEFINED = {"quaternion": "wxyz", "rotation_vector": "ur", "matrix": "matrix", "wpr": "fanuc"}
"""Convention of the groups that define a rotation."""
_AMBIGUOUS = {
    "angles": "ur (rotation vector), yaskawa, staubli, fanuc or rpy",
    "roll_pitch_yaw": "rpy:rad or rpy:deg",
    "abc": "kuka",
    "q1234": "abb, wxyz or xyzw",
}
"""Possible conventions of the other groups."""


def pose_header(cells: Sequence[str]) -> PoseHeader | None:
    """Interpret the cells of a first line, or return None if they are numbers.

    Raises:
        ValueError: The columns of a group differ in unit, or a column is ambiguous.
    """
    numbers = [is_number(cell) for cell in cells]
    names, units = zip(*(name_and_unit(cell) for cell in cells), strict=True)
    groups: dict[str, tuple[int, ...]] = {}
    stated: dict[str, str] = {}
    for group, aliases in _ALIASES.items():
        candidates = [[i for i, name in enumerate(names) if name in some] for some in aliases]
        # rotation_x belongs to a quaternion if there is a rotation_w.
        if not all(candidates) or (group == "angles" and "quaternion" in groups):
            continue
        repeated = next((columns for columns in candidates if len(columns) > 1), None)
        if repeated is not None:
            raise ValueError(
                f"the columns {' and '.join(cells[c] for c in repeated)} may both be the"
                f" {group}'s; keep those of the pose"
            )
        columns = tuple(candidate[0] for candidate in candidates)
        if len({units[column] for column in columns}) > 1:
            raise ValueError(f"the columns {', '.join(cells[c] for c in columns)} differ in unit")
        groups[group] = columns
        if units[columns[0]] in _UNITS.get(group, ("rad", "deg")):
            stated[group] = units[columns[0]]
    if all(numbers) or (not groups and any(numbers)):
        return None
    return PoseHeader(tuple(cells), groups, stated, find_labels(cells))


def pose_columns(
    header: PoseHeader, given: PoseConvention | None
) -> tuple[PoseConvention, list[int]]:
    """Convention of a table, as given or by the header, and its columns in that order.

    Raises:
        ValueError: The header is ambiguous, or contradicts the given convention.
    """
    if given is None:
        group = _defined_group(header)
        convention = _convention_of(header, group)
        return convention, _columns(header, group, convention) or []
    if not header.rotations:
        labels = (header.labels.name, header.labels.stamp)
        rest = [i for i in range(len(header.cells)) if i not in labels]
        if len(rest) != given.count:
            raise ValueError(
                f"the header names no known rotation, and its {len(rest)} columns are not"
                f" the {given.count} of {given.name} ({given.meaning})"
            )
        return given, rest
    for group in header.rotations:
        columns = _columns(header, group, given)
        if columns is not None and len(columns) == given.count:
            _check_units(header, group, given)
            return given, columns
    raise ValueError(
        f"the header has no columns for {given.name} ({given.meaning}); give the convention of"
        f" the file, or no convention if its header defines it"
    )


def _defined_group(header: PoseHeader) -> str:
    """The only group that defines a rotation."""
    defined = [group for group in header.rotations if group in _DEFINED]
    defined += ["roll_pitch_yaw"] if "roll_pitch_yaw" in header.units else []
    ambiguous = [group for group in header.rotations if group in _AMBIGUOUS]
    if len(defined) > 1:
        names = [_DEFINED.get(group, "rpy") for group in defined]
        raise ConventionError(f"the header names {' and '.join(defined)}", " or ".join(names))
    if not defined and ambiguous:
        group = ambiguous[0]
        names = ", ".join(header.cells[column] for column in header.groups[group])
        raise ConventionError(f"columns {names} do not define a rotation", _AMBIGUOUS[group])
    if not defined or ("position" not in header.groups and defined != ["matrix"]):
        raise ConventionError(
            "the header names no known pose (such as x y z qw qx qy qz)",
            f"NAME, one of {KNOWN_CONVENTIONS}",
        )
    return defined[0]


def _convention_of(header: PoseHeader, group: str) -> PoseConvention:
    """Convention of a group that defines a rotation, with the header's units."""
    units = (header.units.get("position"), header.units.get(group))
    name = ":".join([_DEFINED.get(group, "rpy"), *filter(None, units)])
    # The numbers are still checked: a header may have been copied from another file.
    return replace(pose_convention(name), length_stated=False, angle_stated=False)


def _columns(header: PoseHeader, group: str, convention: PoseConvention) -> list[int] | None:
    """Columns in the order of a convention, or None if the group holds no such rotation."""
    layout, base = convention.layout, convention.name.split(":")[0]
    fits = {
        "matrix": layout in ("rows", "columns"),
        "quaternion": layout in ("wxyz", "xyzw"),
        "q1234": layout in ("wxyz", "xyzw"),
        "rotation_vector": layout == "rotation_vector",
        # KUKA's A rotates about z, and KUKA angles under rx ry rz may be in either order.
        "angles": convention.has_angles and base != "kuka",
        "roll_pitch_yaw": layout == "euler",
        "abc": base == "kuka",
        "wpr": base == "fanuc",
    }
    if not fits[group]:
        return None
    columns = header.groups[group]
    if group == "matrix":
        grid = np.array(columns).reshape(4, 4)
        return (grid if layout == "rows" else grid.T).ravel().tolist()
    if group == "quaternion" and layout == "xyzw":
        columns = (*columns[1:], columns[0])
    elif group in ("angles", "roll_pitch_yaw") and layout == "euler":
        # rx and roll rotate about x.
        columns = tuple(columns["xyz".index(axis)] for axis in convention.euler.lower())
    return [*header.groups.get("position", ()), *columns]


def _check_units(header: PoseHeader, group: str, given: PoseConvention) -> None:
    """Raise if the header states another unit than a convention implies."""
    length = "mm" if given.metres_per_unit < 1.0 else "m"
    angle = "deg" if given.degrees else "rad"
    for stated, implied, final in (
        (header.units.get("position"), length, given.length_stated),
        (header.units.get(group), angle, given.angle_stated or not given.has_angles),
    ):
        if stated not in (None, implied) and not final:
            raise ConventionError(
                f"the header says {stated} and the convention {given.name} means {implied}",
                f"{given.name}:{stated} if the header is right",
            )


@dataclass(frozen=True, eq=False)
class PoseTable:
    """Poses as numbers in a convention."""

    numbers: Array
    """(n, convention.count)."""
    convention: PoseConvention
    names: tuple[str, ...] | None = None
    """(n,) image names, if there are any."""
    stamps_s: Array | None = None
    """(n,) seconds, if there are any."""


def read_pose_table(text: str, given: PoseConvention | None) -> PoseTable:
    """Read a table; without a given convention, the header defines it.

    Raises:
        ValueError: The text is no table of numbers, or its convention is not defined.
    """
    header, rows = _split(text)
    if not rows:
        raise ValueError("no line of numbers in it")
    if header is None:
        return _without_header(rows, given)
    for i, row in enumerate(rows):
        if len(row) != len(header.cells):
            raise ValueError(f"row {i + 1} has {len(row)} columns, the header {len(header.cells)}")
    convention, columns = pose_columns(header, given)
    cells = dict(zip(header.cells, zip(*rows, strict=True), strict=True))
    names, stamps = row_labels(cells, len(rows))
    numbers = np.array([[_number(row[c], i) for c in columns] for i, row in enumerate(rows)])
    return PoseTable(numbers, convention, names, stamps)


def _split(text: str) -> tuple[PoseHeader | None, list[list[str]]]:
    """The header, if there is one, and the cells of the rows."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    plain = [line for line in lines if not line.startswith("#")]
    if not plain:
        return None, []
    rows = [_cells(line) for line in plain]
    header = pose_header(rows[0])
    if header is not None:
        return header, rows[1:]
    before = lines[: lines.index(plain[0])]
    header = pose_header(_cells(before[-1].lstrip("# "))) if before else None
    return (header if header and len(header.cells) == len(rows[0]) else None), rows


def _cells(line: str) -> list[str]:
    separator = next((s for s in (";", ",", "\t") if s in line), None)
    if separator is None:
        return line.split()
    cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    cells = [cell.strip() for cell in (cells if cells[-1].strip() else cells[:-1])]
    if separator == ";":  # then the comma may be a decimal point
        points = [cell.replace(",", ".") for cell in cells]
        cells = [p if is_number(p) else c for p, c in zip(points, cells, strict=True)]
    return cells


def _without_header(rows: list[list[str]], given: PoseConvention | None) -> PoseTable:
    width = len(rows[0])
    if given is None:
        raise ConventionError(
            f"{width} columns without a header do not define a pose; write a header such as"
            f" x,y,z,qw,qx,qy,qz",
            f"NAME, one of {KNOWN_CONVENTIONS}, or tum",
        )
    words = [i for i, cell in enumerate(rows[0]) if not is_number(cell)]
    extra = width - given.count
    if len(words) > 1 or not len(words) <= extra <= len(words) + 1:
        raise ValueError(
            f"row 1 has {width} columns; {given.name} takes {given.count} ({given.meaning}),"
            f" optionally after a name and a stamp"
        )
    numbers = []
    for i, row in enumerate(rows):
        if len(row) != width:
            raise ValueError(f"row {i + 1} has {len(row)} columns, row 1 has {width}")
        numbers.append([_number(cell, i) for c, cell in enumerate(row) if c not in words])
    names = tuple(row[words[0]] for row in rows) if words else None
    table = np.array(numbers)
    stamps = in_unit(table[:, 0], None) if extra > len(words) else None
    back = np.flatnonzero(np.diff(table[:, 0]) < 0)
    # A misplaced number shows in quaternions and matrices, but not in angles.
    if stamps is not None and given.has_angles and back.size:
        raise ValueError(
            f"the first number of row {back[0] + 2} is smaller than the one before, so it is no"
            f" stamp; write a header that names the {width} columns"
        )
    return PoseTable(table[:, table.shape[1] - given.count :], given, names, stamps)


def _number(cell: str, row: int) -> float:
    try:
        return float(cell)
    except ValueError:
        raise ValueError(f"row {row + 1} holds {cell!r} where a number is expected") from None
