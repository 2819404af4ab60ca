"""Gripper poses in a LeRobot dataset.

A pose is a feature whose names end in x, y, z and qx, qy, qz, qw, or wx, wy, wz for a rotation
vector; the first numbers of a feature in a convention that the user gives; or, with a URDF, the
joints of observation.state. `gripper_frame` selects the feature if several hold poses, or the arm,
such as left_ee, if one feature holds left_ee.x and right_ee.x.
"""

from pathlib import Path

from evercal.errors import InputError
from evercal.recordings.poses.conventions import (
    asking_for,
    pose_convention,
)
from evercal.recordings.poses.joint_tables import (
    arm_poses,
    joint_reading,
)
from evercal.recordings.poses.pose_units import checked_poses
from evercal.recordings.poses.robot_poses import RobotPoses
from evercal.recordings.read_options import ReadOptions
from evercal.robot.robot_model import RobotModel
from evercal.storage.text_files import named_errors, refuse_repeated
from evercal.typing import Array, Record

STATE = "observation.state"
"""Feature of the joints."""
_PARTS = {
    "xyzw": ("x", "y", "z", "qx", "qy", "qz", "qw"),
    "ur": ("x", "y", "z", "wx", "wy", "wz"),
}
"""Names of the numbers of a pose, by convention."""


def pose_feature(root: Path, info: Record, options: ReadOptions) -> str:
    """Name of the feature with the poses, or with the joints where there is a URDF."""
    features = info["features"]
    if options.urdf:
        return STATE
    if options.pose_convention is not None:
        column = options.gripper_frame or STATE
        if column not in features:
            names = ", ".join(features)
            raise InputError(
                f"{root}: no feature {column!r}; `gripper_frame` is one of {names}"
            )
        return column
    arm = options.gripper_frame
    observed = {}
    keys = []
    for key in features:
        if key.startswith("observation"):
            names = names_of(info, key)
            observed[key] = names
            is_chosen = arm is None or arm in (key, *_arms(names))
            if is_chosen and _convention_of(_parts(names)):
                keys.append(key)
    if STATE in keys:
        return STATE
    if len(keys) == 1:
        return keys[0]
    if keys:
        raise InputError(
            f"{root}: gripper poses are in {' and '.join(keys)}; give `gripper_frame`"
        )
    named = []
    for key, names in observed.items():
        if names and "image" not in key:
            named.append(f"{key}: {', '.join(names)}")
    raise InputError(
        f"{root}: no feature holds a pose (x, y, z and qx, qy, qz, qw or wx, wy, wz), there are"
        f" {'; '.join(named) or 'no named numbers'}; for joint angles give `urdf`, for a pose in"
        f" another form `pose_convention` and `gripper_frame` FEATURE"
    )


def feature_poses(
    root: Path,
    info: Record,
    column: str,
    values: Array,
    options: ReadOptions,
) -> tuple[RobotPoses, list[str]]:
    """Poses from the (n, k) values of a feature, and notes."""
    names = names_of(info, column)
    count = values.shape[1]
    needs_names = options.urdf or options.pose_convention is None
    if needs_names and len(names) != count:
        raise InputError(
            f"{root}: {column}: has {count} numbers and {len(names)} names"
        )
    if options.urdf:
        return _joint_poses(root, names, values, options)
    notes = []
    with named_errors(f"{root}: {column}", "poses"), asking_for("`pose_convention`"):
        if options.pose_convention is not None:
            convention = pose_convention(options.pose_convention)
            taken = convention.counts[-1]
            values = values[:, :taken]
            if taken < count:
                used = f" ({', '.join(names[:taken])})" if names else ""
                notes = [f"the first {taken} of its {count} numbers were taken{used}"]
        else:
            name, columns = _pose_columns(names, options.gripper_frame)
            convention = pose_convention(name)
            values = values[:, columns]
        poses = checked_poses(values, convention)
    notes = [f"gripper poses are {column}: {convention.meaning}", *notes]
    return RobotPoses(None, None, poses), notes


def _joint_poses(
    root: Path, names: list[str], values: Array, options: ReadOptions
) -> tuple[RobotPoses, list[str]]:
    assert options.urdf
    source = f"{root}: {STATE}"
    with named_errors(source, "names"):
        refuse_repeated(names, "rename the numbers")
    model = RobotModel(options.urdf, options.whole_robot, options.unchecked_joints)
    read = joint_reading(model, names, source, options)
    return arm_poses(model, read, values, source, options)


def _pose_columns(names: list[str], arm: str | None) -> tuple[str, list[int]]:
    """Name of the convention of a pose, and its columns."""
    arms = _arms(names)
    if arm not in arms:
        arm = None
    last = _parts(names, arm)
    convention = _convention_of(last)
    parts = _PARTS[convention]
    if any(last.count(part) > 1 for part in parts):
        remedy = "names that tell them apart in info.json"
        prefixes = [*filter(None, arms)]
        if prefixes:
            remedy = f"`gripper_frame` {' or '.join(prefixes)}"
        raise ValueError(f"holds several poses ({', '.join(names)}); give {remedy}")
    return convention, [last.index(part) for part in parts]


def _convention_of(parts: list[str]) -> str:
    """Name of the convention of a pose; empty if the numbers are none."""
    for convention, needed in _PARTS.items():
        if {*needed}.issubset(parts):
            return convention
    return ""


def _parts(names: list[str], arm: str | None = None) -> list[str]:
    """The last part of each name; empty for those of another arm."""
    parts = []
    for name in names:
        prefix, _, last = name.rpartition(".")
        parts.append(last if arm in (None, prefix) else "")
    return parts


def _arms(names: list[str]) -> list[str]:
    prefixes = dict.fromkeys(name.rpartition(".")[0] for name in names)
    return [arm for arm in prefixes if _convention_of(_parts(names, arm))]


def names_of(info: Record, column: str) -> list[str]:
    """Names of the numbers of a feature."""
    names = info["features"].get(column, {}).get("names") or []
    if isinstance(
        names, dict
    ):  # {"motors": [...]}, or several arms with the same names
        groups = {key: group for key, group in names.items() if isinstance(group, list)}
        names = []
        for key, group in groups.items():
            prefix = f"{key}." if len(groups) > 1 else ""
            names += [f"{prefix}{name}" for name in group]
    if len(names) == 1 and isinstance(names[0], list):  # some nest them once more
        names = names[0]
    return [str(name).removesuffix(".pos") for name in names]
