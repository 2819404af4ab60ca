"""Tables of joint values, and the gripper poses that a URDF makes of them.

A CSV table has a column for each joint of the URDF; JSON has `joint_names` and `positions`. Values
are radians, or degrees if a name ends in `_deg`, and metres for prismatic joints.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from evercal.errors import InputError
from evercal.recordings.poses.pose_track import times_around
from evercal.recordings.poses.robot_poses import RobotPoses
from evercal.recordings.poses.row_files import LabelledRows, read_rows, row_labels
from evercal.robot.robot_model import ArmPoses, RobotModel
from evercal.storage.text_files import (
    library_errors,
    named_errors,
    read_json,
    refuse_repeated,
)
from evercal.typing import Array, BoolArray

_UNITS = ("deg", "rad", "m")
"""Endings of the names of columns."""
_STILL_RAD = 0.001
"""Motion of a joint over a gap, radians or metres, below which it stands still."""
_JSON = (
    "an object with 'joint_names', 'positions' and optionally 'images' or 'stamps_s'"
)


def read_joint_poses(
    path: Path,
    model: RobotModel,
    base: str | None = None,
    gripper: str | None = None,
    unit: str | None = None,
) -> tuple[RobotPoses, list[str]]:
    """Read joint angles and compute gripper poses, with notes.

    `unit` is "rad" or "deg" of angles whose column states no unit; radians if omitted.
    """
    rows = read_joints(path)
    base, gripper = model.chosen_links(base, gripper)
    names = []
    units = []
    for column in rows.columns:
        joint, _, ending = column.rpartition("_")
        if (
            model.has_joint(column)
            or not model.has_joint(joint)
            or ending not in _UNITS
        ):
            joint = column
            ending = unit
        names.append(joint)
        units.append(ending)
    if not model.read_arm(base, gripper, names, path).joints:
        raise InputError(
            f"{model.path}: no joint moves {gripper} against {base}; name other links"
        )
    with named_errors(path, "joint angles"):
        refuse_repeated(filter(model.has_joint, names), "keep one column of each joint")
    values = in_radians(model, names, rows.values, units)
    moved = model.poses(names, values, base, gripper, path)
    return poses_of_arm(moved, rows), moved.notes


def poses_of_arm(moved: ArmPoses, rows: LabelledRows | None = None) -> RobotPoses:
    """Poses of an arm with their joint values, and with the names and times of rows."""
    names = rows and rows.names
    stamps_s = rows and rows.stamps_s
    return RobotPoses(
        names,
        stamps_s,
        moved.poses,
        arm=moved.arm,
        joints=moved.joints,
        frames=moved.frames,
    )


def in_radians(
    model: RobotModel, names: Sequence[str], values: Array, units: Sequence[str | None]
) -> Array:
    """Convert angles in degrees to radians and leave other values (n, k) as they are."""
    in_degrees = []
    for name, unit in zip(names, units, strict=True):
        if unit not in (None, *_UNITS):
            raise InputError(f"`pose_convention` {unit}: joint angles are rad or deg")
        in_degrees.append(unit == "deg" and model.rotates(name))
    return np.where(in_degrees, np.deg2rad(values), values)


def interpolate(
    times_s: Array, positions: Array, stamps_s: Array
) -> tuple[Array, BoolArray]:
    """Interpolate (n,) positions of a joint at (m,) seconds, and whether each is valid.

    Jumps by full rotations are removed. Validity is that of `PoseTrack.at`.
    """
    times, first = np.unique(times_s, return_index=True)
    values = np.unwrap(positions[first])
    valid = (stamps_s >= times[0]) & (stamps_s <= times[-1])
    if len(times) > 1:
        after, close = times_around(times, stamps_s)
        motion = values[after] - values[after - 1]
        valid &= close | (np.abs(motion) < _STILL_RAD)
    return np.interp(stamps_s, times, values), valid


def read_joints(path: Path) -> LabelledRows:
    """Read a table of joint values."""
    if path.suffix.lower() == ".csv":
        return read_rows(path, "joint angles")
    data = read_json(path, "file of joint angles", f"give {_JSON}")
    with library_errors(f"{path}: give {_JSON}"):
        columns = tuple(map(str, data["joint_names"]))
        values = np.array(data["positions"], float)
        lists = {key: value for key, value in data.items() if isinstance(value, list)}
        names, stamps, _ = row_labels(
            [*lists], [*lists.values()], len(values), plural=True
        )
        if values.shape != (len(values), len(columns)) or not np.isfinite(values).all():
            raise ValueError(
                "'positions' are rows of finite numbers, one for each joint"
            )
        return LabelledRows(names, stamps, columns, values)
