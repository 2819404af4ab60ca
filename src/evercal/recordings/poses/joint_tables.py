"""Tables of joint values, and the gripper poses that a URDF makes of them.

A CSV table has a column for each joint of the URDF; JSON has `joint_names` and `positions`. Values
are radians, or degrees if a name ends in `_deg`, and metres for prismatic joints.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from evercal.errors import InputError
from evercal.recordings.poses.pose_track import times_around
from evercal.recordings.poses.robot_poses import RobotPoses
from evercal.recordings.poses.row_files import (
    LabelledRows,
    is_number,
    read_rows,
    row_labels,
)
from evercal.recordings.read_options import ReadOptions
from evercal.robot.joint_map import UNITS, JointMap
from evercal.robot.joint_names import joints_by_column
from evercal.robot.robot_model import RobotModel
from evercal.storage.text_files import (
    library_errors,
    named_errors,
    read_json,
    refuse_repeated,
)
from evercal.typing import Array, BoolArray, PathLike

_UNITS = ("deg", "rad", "m")
"""Endings of the names of columns."""
_STILL_RAD = 0.001
"""Motion of a joint over a gap, radians or metres, below which it stands still."""
_JSON = (
    "an object with 'joint_names', 'positions' and optionally 'images' or 'stamps_s'"
)


def read_joint_poses(
    path: Path, model: RobotModel, options: ReadOptions | None = None
) -> tuple[RobotPoses, list[str]]:
    """Read joint angles and compute gripper poses, with notes."""
    options = options or ReadOptions()
    rows = read_joints(path)
    read = joint_reading(model, rows.columns, path, options)
    poses, notes = arm_poses(model, read, rows.values, path, options)
    return replace(poses, names=rows.names, stamps_s=rows.stamps_s), notes


def joint_reading(
    model: RobotModel, columns: Sequence[str], source: PathLike, options: ReadOptions
) -> JointMap:
    """Joints, and the columns that their values are made of."""
    names: list[str] = []
    units: list[str | None] = []
    for column in columns:
        joint, _, ending = column.rpartition("_")
        if model.has_joint(column) or not joint or ending not in _UNITS:
            joint = column
            ending = options.pose_convention
        names.append(joint)
        units.append(ending)
    links = model.chosen_links(options.base_frame, options.gripper_frame)
    joints = model.arm(*links).joints
    if model.whole:
        joints = model.drivers()
    numbers = [float(column) for column in columns if is_number(column)]
    # Motors may be numbered; other numbers are the first row.
    if len(numbers) == len(columns) and np.any(np.diff(numbers) != 1):
        raise InputError(
            f"{source}: its rows have no names of joints; write them as its first line, in the"
            f" order of the columns; {model.path} has {','.join(joints)}"
        )
    found = joints_by_column(names, joints, not model.whole)
    named = [found.get(name, name) for name in names]
    with named_errors(str(source), "joint angles"):
        refuse_repeated(filter(model.has_joint, named), "keep one column of each joint")
    read = JointMap.of_columns(named, columns, radians_per(model, named, units))
    if options.joint_map:
        read = JointMap.read(options.joint_map).with_others(read, source)
    return read


def arm_poses(
    model: RobotModel,
    read: JointMap,
    values: Array,
    source: PathLike,
    options: ReadOptions,
) -> tuple[RobotPoses, list[str]]:
    """Poses of an arm from columns (n, m), with notes."""
    links = model.chosen_links(options.base_frame, options.gripper_frame)
    moved = model.poses(read.joints, read.values(values), *links, source)
    if not moved.arm.joints:
        raise InputError(
            f"{model.path}: no joint moves {links[1]} against {links[0]}; name other links"
        )
    own = read.of(moved.arm.joints)
    renamed = []
    for joint, row in zip(own.joints, own.matrix, strict=True):
        columns = [own.columns[i] for i in np.flatnonzero(row)]
        if joint not in columns and f"{joint}_deg" not in columns:
            renamed.append(f"{joint} from {' and '.join(columns)}")
    if renamed:
        moved.notes.append(f"values of joints by other names: {', '.join(renamed)}")
    poses = RobotPoses(
        None,
        None,
        moved.poses,
        arm=replace(moved.arm, read=own),
        joints=moved.joints,
        frames=moved.frames,
    )
    return poses, moved.notes


def radians_per(
    model: RobotModel, names: Sequence[str], units: Sequence[str | None]
) -> Array:
    """(k,) factors of values of joints: to radians where angles are in degrees, else 1."""
    in_degrees = []
    for name, unit in zip(names, units, strict=True):
        if unit not in (None, *_UNITS):
            raise InputError(f"`pose_convention` {unit}: joint angles are rad or deg")
        in_degrees.append(unit == "deg" and model.rotates(name))
    return np.where(in_degrees, UNITS["deg"], 1.0)


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
