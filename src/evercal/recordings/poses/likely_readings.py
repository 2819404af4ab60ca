"""Readings of numbers whose convention is not stated: what is offered was tried before.

A reading fits if its rotations are rotations and its units are plausible, as when it is stated.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

from evercal.recordings.poses.conventions import (
    ConventionError,
    PoseConvention,
    pose_convention,
)
from evercal.recordings.poses.pose_units import checked_poses

if TYPE_CHECKING:
    from evercal.recordings.poses.pose_columns import PoseTable

USUAL = ("xyzw", "wxyz", "ur", "rpy", "kuka", "yaskawa")
"""Usual conventions, the likeliest first."""
WITHOUT_HEADER = (
    *USUAL,
    "qw,qx,qy,qz,x,y,z",
    "qw,qx,qy,qz,x,y,z,...",
    "qx,qy,qz,qw,x,y,z",
    "qx,qy,qz,qw,x,y,z,...",
    "x,y,z,qx,qy,qz,qw,...",
    "stamp,qw,qx,qy,qz,x,y,z",
    "stamp,qx,qy,qz,qw,x,y,z",
    "stamp,x,y,z,qx,qy,qz,qw,...",
)
"""The same, and columns of rows without a header."""
_UNITS = ("", ":m", ":mm", ":deg", ":rad", ":m:rad", ":mm:rad", ":mm:deg")
"""Units that a name implies, or may be followed by."""
_REMARKS = {
    "ur": "rotation vector",
    "kuka": "A about z",
    "mitsubishi": "A about x",
    "epson": "U about z",
    "yaskawa": "fixed axes x y z",
    "staubli": "moving axes x y z",
    "rpy": "roll, pitch, yaw",
    "abb": "q1 is w",
    "qw,qx,qy,qz,x,y,z": "with :inverse for world to camera, as of hloc and ACE",
}
"""What distinguishes a reading, by its name without units and dots."""

Read = Callable[[PoseConvention], "PoseTable"]
"""Reads numbers in a convention; ValueError if they are not of it."""


def undefined(
    problem: str, names: Sequence[str], read: Read, most: int = 2
) -> ValueError:
    """An error that offers the first readings that fit, or says what poses are."""
    offers: list[str] = []
    for name in _fitting(names, read):
        remark = _REMARKS.get(name.partition(":")[0].removesuffix(",..."))
        offers.append(f"{name} ({remark})" if remark else name)
        if len(offers) == most:
            break
    if offers:
        return ConventionError(problem, " or ".join(offers))
    return ValueError(
        f"{problem}, and none of the usual readings fits; write a position and a rotation, such as"
        f" columns x,y,z,qw,qx,qy,qz"
    )


def _fitting(names: Sequence[str], read: Read) -> Iterator[str]:
    """Names of readings that fit, one for each set of poses."""
    known = set()
    for unit in _UNITS:
        for name in names:
            with suppress(ValueError):
                table = read(pose_convention(name + unit))
                poses = checked_poses(table.numbers, table.convention)
                key = poses.matrix().round(6).tobytes()
                if key not in known:
                    known.add(key)
                    yield name + unit
