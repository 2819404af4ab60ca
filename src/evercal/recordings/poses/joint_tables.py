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
from evercal.robot.joint_map import JointMap
from evercal.robot.joint_names import joints_by_column
from evercal.robot.robot_model import ArmPoses, RobotModel
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
    links = model.chosen_links(options.base_frame, options.gripper_frame)
    if not model.read_arm(*links, read.joints, path).joints:
        raise InputError(
            f"{model.path}: no joint moves {links[1]} against {links[0]}; name other links"
        )
    moved = arm_poses(model, read, rows.values, path, options)
    return poses_of_arm(moved, rows), moved.notes


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
    sizes = in_radians(model, named, np.ones((1, len(named))), units)[0]
    read = JointMap.of_columns(named, columns, sizes)
    if options.joint_map:
        read = JointMap.read(options.joint_map).with_others(read, source)
    return read


def arm_poses(
    model: RobotModel,
    read: JointMap,
    values: Array,
    source: PathLike,
    options: ReadOptions,
) -> ArmPoses:
    """Poses of an arm, from columns (n, m)."""
    links = options.base_frame, options.gripper_frame
    moved = model.poses(read.joints, read.values(values), *links, source)
    own = read.of(moved.arm.joints)
    renamed = []
    for i, joint in enumerate(own.joints):
        columns = [own.columns[j] for j in np.flatnonzero(own.matrix[i])]
        if joint not in columns and f"{joint}_deg" not in columns:
            renamed.append(f"{joint} from {' and '.join(columns)}")
    if renamed:
        moved.notes.append(f"values of joints by other names: {', '.join(renamed)}")
    return moved._replace(arm=replace(moved.arm, read=own))


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
