"""What the columns of a table of poses are, by their names.

These names are known, in any case, with or without a unit behind them (`x_mm`, `rx [deg]`):

    position         x  tx  px  pos_x  position_x  translation_x  pose.position.x
    quaternion       qw  q_w  quat_w  quaternion_w  orientation_w  rotation_w
    rotation vector  rotvec_x  rvec_x  rotation_vector_x
    matrix           m00 ... m33 (row, column)
    angles           rx  rot_x  rotation_x;  roll pitch yaw;  A B C;  W P R
    four numbers     q1 q2 q3 q4
    others           image, file, name, ...;  stamp, time, t, ...: see `labels`

The first four say how the rotation is meant, and so do W P R (FANUC) and roll pitch yaw with a
unit. The other ones mean different things to different robots and need a convention.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from evercal.recordings.poses.conventions import PoseConvention, known_conventions, pose_convention
from evercal.recordings.poses.labels import find_labels, name_and_unit


@dataclass(frozen=True)
class PoseHeader:
    """Which columns hold what."""

    cells: tuple[str, ...]
    """What the columns are called."""
    groups: dict[str, tuple[int, ...]]
    """Columns by what they are: `position`, `quaternion` (w x y z), `angles` (x y z), ..."""
    units: dict[str, str]
    """`m`, `mm`, `rad` or `deg` of the groups of which the header says it."""
    name: int | None
    """Column of the names."""
    stamp: int | None
    """Column of the stamps."""
    stamp_unit: str | None
    """`s`, `ms`, `us` or `ns` if the header says it."""

    @property
    def width(self) -> int:
        """How many columns."""
        return len(self.cells)

    @property
    def rotations(self) -> list[str]:
        """The groups that tell a rotation."""
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
"""By group: for each of its numbers, the names that its column may have."""
_MEANT = {"quaternion": "wxyz", "rotation_vector": "ur", "matrix": "matrix", "wpr": "fanuc"}
"""Convention of the groups that need none."""
_OPEN = {
    "angles": "ur (rotation vector), yaskawa, staubli, fanuc or rpy",
    "roll_pitch_yaw": "rpy:rad or rpy:deg",
    "abc": "kuka",
    "q1234": "abb, wxyz or xyzw",
}
"""Conventions that the other groups may be meant in."""


def pose_header(cells: Sequence[str]) -> PoseHeader | None:
    """Reads the cells of a first line; None if they are numbers, a row and no header.

    Raises:
        ValueError: The columns of one group differ in unit, or several groups may be meant.
    """
    numbers = [is_number(cell) for cell in cells]
    names, units = zip(*(name_and_unit(cell) for cell in cells), strict=True)
    groups: dict[str, tuple[int, ...]] = {}
    stated: dict[str, str] = {}
    for group, aliases in _ALIASES.items():
        columns = [[i for i, name in enumerate(names) if name in some] for some in aliases]
        found = tuple(column[0] for column in columns if column)
        # rotation_x is of a quaternion where there is a rotation_w.
        if len(found) < len(columns) or (group == "angles" and "quaternion" in groups):
            continue
        alike = next((column for column in columns if len(column) > 1), None)
        if alike is not None:
            raise ValueError(
                f"the columns {' and '.join(cells[c] for c in alike)} may both be the {group}'s;"
                f" keep those of the pose"
            )
        if len({units[column] for column in found}) > 1:
            raise ValueError(f"the columns {', '.join(cells[c] for c in found)} differ in unit")
        groups[group] = found
        if units[found[0]] in ("m", "mm", "rad", "deg"):
            stated[group] = units[found[0]]
    if all(numbers) or (not groups and any(numbers)):
        return None
    labels = find_labels(cells)
    return PoseHeader(tuple(cells), groups, stated, labels.name, labels.stamp, labels.unit)


def is_number(cell: str) -> bool:
    """Whether Python reads it as a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def meant(header: PoseHeader, given: PoseConvention | None) -> tuple[PoseConvention, list[int]]:
    """The convention of a table and the columns in its order.

    Args:
        header: of the table.
        given: what the user says; None to go by the header alone.

    Raises:
        ValueError: The header leaves open what is meant, or contradicts what is given.
    """
    if given is None:
        group = _clear_group(header)
        convention = _by_name(header, group)
        return convention, _columns(header, group, convention) or []
    if not header.rotations:
        rest = [i for i in range(header.width) if i not in (header.name, header.stamp)]
        if len(rest) != given.count:
            raise ValueError(
                f"the header names no rotation that is known, and its {len(rest)} columns are not"
                f" the {given.count} of {given.name} ({given.meaning})"
            )
        return given, rest
    for group in header.rotations:
        columns = _columns(header, group, given)
        if columns is not None and len(columns) == given.count:
            _refuse_other_units(header, group, given)
            return given, columns
    raise ValueError(
        f"the header has no columns for {given.name} ({given.meaning}); give the convention that"
        f" the file is written in, or none if its header says it"
    )


def _clear_group(header: PoseHeader) -> str:
    """The one group that says how a rotation is meant."""
    clear = [group for group in header.rotations if group in _MEANT]
    clear += ["roll_pitch_yaw"] if "roll_pitch_yaw" in header.units else []
    vague = [group for group in header.rotations if group in _OPEN]
    if len(clear) > 1:
        raise ValueError(f"the header names {' and '.join(clear)}; say which with --convention")
    if not clear and vague:
        what = ", ".join(vague[0]) if vague[0] == "abc" else vague[0].replace("_", " ")
        raise ValueError(
            f"columns of {what} do not say how they are meant; give --convention {_OPEN[vague[0]]}"
        )
    if not clear or ("position" not in header.groups and clear != ["matrix"]):
        raise ValueError(
            f"the header names no pose that is known (such as x y z qw qx qy qz); mend it or give"
            f" --convention, one of {known_conventions()}"
        )
    return clear[0]


def _by_name(header: PoseHeader, group: str) -> PoseConvention:
    """The convention of a clear group, with the header's units."""
    words = [_MEANT.get(group, "rpy")]
    words += [unit for unit in (header.units.get("position"),) if unit in ("m", "mm")]
    if group in ("rotation_vector", "roll_pitch_yaw", "wpr"):
        words += [unit for unit in (header.units.get(group),) if unit in ("rad", "deg")]
    found = pose_convention(":".join(words))
    # What a header says is still doubted: it may have been copied from another file.
    return replace(found, length_stated=False, angle_stated=False)


def _columns(header: PoseHeader, group: str, convention: PoseConvention) -> list[int] | None:
    """Columns in the order of a convention; None if the group holds no such rotation."""
    columns = header.groups[group]
    layout, base = convention.layout, convention.name.split(":")[0]
    found: list[int] | None = None
    if group == "matrix" and layout in ("rows", "columns"):
        grid = np.array(columns).reshape(4, 4)
        return (grid if layout == "rows" else grid.T).ravel().tolist()
    if group == "quaternion" and layout in ("wxyz", "xyzw"):
        found = [*columns] if layout == "wxyz" else [*columns[1:], columns[0]]
    elif (
        (group == "q1234" and layout in ("wxyz", "xyzw"))
        or (group in ("rotation_vector", "angles") and layout == "rotation_vector")
        or (group, base) in (("abc", "kuka"), ("wpr", "fanuc"))
    ):
        found = [*columns]
    elif group in ("angles", "roll_pitch_yaw") and layout == "euler":
        # By their axes: rx and roll turn about x. KUKA's A turns about z, but who wrote its angles
        # under rx ry rz may have meant either.
        if (group, base) == ("angles", "kuka"):
            return None
        found = [columns["xyz".index(axis)] for axis in convention.euler.lower()]
    return None if found is None else [*header.groups.get("position", ()), *found]


def _refuse_other_units(header: PoseHeader, group: str, given: PoseConvention) -> None:
    length = "mm" if given.metres_per_unit < 1.0 else "m"
    angle = "deg" if given.degrees else "rad"
    checks = []
    if not given.length_stated:
        checks.append((header.units.get("position"), length, ("m", "mm")))
    if given.has_angles and not given.angle_stated:
        checks.append((header.units.get(group), angle, ("rad", "deg")))
    for said, implied, units in checks:
        if said in units and said != implied:
            raise ValueError(
                f"the header says {said} and --convention {given.name} means {implied};"
                f" give --convention {given.name}:{said} if the header is right"
            )
