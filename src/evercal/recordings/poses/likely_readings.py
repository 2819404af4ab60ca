"""Readings of numbers whose convention is not stated: what is offered was tried before.

A reading fits if its rotations are rotations and its units are plausible, as when it is stated.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from typing import Any

from evercal.recordings.poses.conventions import (
    ConventionError,
    PoseConvention,
    pose_convention,
)
from evercal.recordings.poses.pose_units import checked_poses
from evercal.recordings.poses.row_files import by_alias

USUAL = ("xyzw", "wxyz", "ur", "rpy", "kuka", "yaskawa")
"""Usual conventions, the likeliest first."""
_COLUMNS = """
qw,qx,qy,qz,x,y,z qw,qx,qy,qz,x,y,z,... qx,qy,qz,qw,x,y,z qx,qy,qz,qw,x,y,z,...
x,y,z,qx,qy,qz,qw,... x,y,z,qw,qx,qy,qz,... stamp,qw,qx,qy,qz,x,y,z stamp,qx,qy,qz,qw,x,y,z
stamp,x,y,z,qx,qy,qz,qw,... stamp,x,y,z,qw,qx,qy,qz,...
"""
WITHOUT_HEADER = (*USUAL, *_COLUMNS.split())
"""The same, and columns of rows without a header."""
_UNITS = ("", ":m", ":mm", ":deg", ":rad", ":m:rad", ":mm:rad", ":mm:deg")
"""Units that a name implies, or may be followed by."""
_REMARKS = by_alias("""
rotation vector: ur
A about z: kuka
A about x: mitsubishi
U about z: epson
fixed axes x y z: yaskawa
moving axes x y z: staubli
roll, pitch, yaw: rpy
q1 is w: abb
for world to camera append inverse, as for hloc and ACE: qw,qx,qy,qz,x,y,z qw,qx,qy,qz,x,y,z,...
""")
"""What distinguishes a reading, by its name without units."""

Read = Callable[[PoseConvention], Any]
"""Reads a `PoseTable` of numbers in a convention; ValueError if they are not of it."""


def undefined(problem: str, names: Sequence[str], read: Read) -> ValueError:
    """An error that offers the first readings that fit, or says what poses are."""
    offers: list[str] = []
    for name in islice(_fitting(names, read), 2):
        remark = _REMARKS.get(name.partition(":")[0])
        offers.append(f"{name} ({remark})" if remark else name)
    if offers:
        return ConventionError(problem, " or ".join(offers))
    return ValueError(
        f"{problem}, and no usual reading fits; write a position and a rotation, such as columns"
        f" x,y,z,qw,qx,qy,qz (joint values belong into joints.csv beside a URDF)"
    )


def _fitting(names: Sequence[str], read: Read) -> Iterator[str]:
    """Names of readings that fit, one for each set of poses."""
    known = set()
    for unit in _UNITS:
        for name in names:
            with suppress(ValueError):
                table = read(pose_convention(name + unit))
                # Without units in its name, its units are checked.
                implied = replace(table.convention, name=table.convention.base)
                poses = checked_poses(table.numbers, implied)
                key = poses.matrix().round(6).tobytes()
                if key not in known:
                    known.add(key)
                    yield name + unit
