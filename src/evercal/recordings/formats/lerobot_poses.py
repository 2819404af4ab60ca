"""Where the gripper was at the frames of a LeRobot dataset, from the features of its tables.

Poses come from a feature whose names hold x, y, z and qx, qy, qz, qw, or wx, wy, wz for a rotation
vector (`ee.x` and `x` alike), in metres and radians; or from the first numbers of observation.state
in a convention that is given; or with a URDF from the joints of observation.state (`elbow.pos` is
the joint elbow), in radians unless the convention deg is given. `--gripper-frame` names the feature
where several hold poses, or the arm, left_ee, where one feature holds left_ee.x and right_ee.x.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.conventions import (
    PoseConvention,
    doubt,
    pose_convention,
    poses_from_numbers,
)
from evercal.recordings.poses.joint_states import in_radians
from evercal.recordings.poses.kinematics import RobotModel
from evercal.recordings.read_options import ReadOptions

_STATE = "observation.state"
# By convention: how the numbers of a pose are called.
_CALLED = {"xyzw": ("x", "y", "z", "qx", "qy", "qz", "qw"), "ur": ("x", "y", "z", "wx", "wy", "wz")}


def pose_feature(root: Path, info: Mapping[str, Any], options: ReadOptions) -> str:
    """The feature that says where the arm was."""
    if options.urdf is not None:
        return _STATE
    if options.pose_convention is not None:
        column = options.gripper_frame or _STATE
        if column not in info["features"]:
            has = ", ".join(info["features"])
            raise InputError(f"{root}: no feature {column!r}; --gripper-frame names one of {has}")
        return column
    keys = [key for key in info["features"] if key.startswith("observation")]
    found = [key for key in keys if _called(_names(info, key))]
    if options.gripper_frame is not None:
        wanted = options.gripper_frame
        found = [k for k in found if wanted in (k, *_arms(_names(info, k)))]
    if _STATE in found or len(found) == 1:
        return _STATE if _STATE in found else found[0]
    if found:
        raise InputError(
            f"{root}: gripper poses are in {' and '.join(found)}; name one with --gripper-frame"
        )
    has = "; ".join(
        f"{key}: {', '.join(_names(info, key))}"
        for key in info["features"]
        if key.startswith("observation") and _names(info, key) and "image" not in key
    )
    raise InputError(
        f"{root}: no feature holds a pose (x, y, z and qx, qy, qz, qw or wx, wy, wz), there are"
        f" {has or 'no named numbers'}; for joint angles give --urdf, for a pose in another form"
        f" --pose-convention and --gripper-frame FEATURE"
    )


def feature_poses(
    root: Path,
    info: Mapping[str, Any],
    column: str,
    values: NDArray[np.float64],
    options: ReadOptions,
) -> tuple[SE3, list[str]]:
    """(n,) base_from_gripper and what was taken."""
    names = _names(info, column)
    if options.urdf is not None:
        return _joint_poses(root, names, values, options)
    if options.base_frame is not None:
        raise InputError(f"{root}: --base-frame goes with --urdf only; leave it out")
    count, notes = values.shape[1], []
    try:
        if options.pose_convention is not None:
            convention = pose_convention(options.pose_convention)
            numbers = values[:, : convention.count]
            if convention.count < count:
                taken = f" ({', '.join(names[: convention.count])})" if names else ""
                notes = [f"the first {convention.count} of its {count} numbers were taken{taken}"]
        elif len(names) != count:
            raise ValueError(f"has {count} numbers and {len(names)} names")
        else:
            convention, columns = _pose_columns(names, options.gripper_frame)
            numbers = values[:, columns]
        poses, why = poses_from_numbers(numbers, convention), doubt(numbers, convention)
    except ValueError as error:
        raise InputError(f"{root}: {column}: {error}") from None
    if why is not None:
        raise InputError(f"{root}: {column}: {why}")
    return poses, [f"gripper poses are {column}: {convention.meaning}", *notes]


def _joint_poses(
    root: Path, names: list[str], stated: NDArray[np.float64], options: ReadOptions
) -> tuple[SE3, list[str]]:
    """Forward kinematics of observation.state."""
    assert options.urdf is not None
    if len(names) != stated.shape[1]:
        count = stated.shape[1]
        raise InputError(f"{root}: {_STATE} has {count} numbers and {len(names)} names")
    twice = [name for i, name in enumerate(names) if name in names[:i]]
    if twice:
        raise InputError(f"{root}: {_STATE}: {twice[0]!r} names several numbers; name each apart")
    model = RobotModel(options.urdf)
    base = options.base_frame or model.base_link
    gripper = options.gripper_frame or model.end_link()
    values = in_radians(model, names, stated, [options.pose_convention] * len(names))
    try:
        poses = model.base_from_gripper(names, values, base, gripper)
    except InputError as error:
        raise InputError(f"{root}: {_STATE}: {error} (or say --pose-convention deg)") from None
    notes = [f"gripper poses are those of {gripper} in {base}, from {options.urdf.name}"]
    return poses, notes + model.beyond_limits(names, values)


def _pose_columns(names: list[str], arm: str | None) -> tuple[PoseConvention, list[int]]:
    """How a feature's pose is meant, and where its numbers stand.

    Raises:
        ValueError: The names are those of several poses and `arm` is none of them.
    """
    arms = _arms(names)
    chosen = [n if arm not in arms or n.rpartition(".")[0] == arm else "" for n in names]
    called = _called(chosen)
    assert called is not None
    last = [name.rpartition(".")[2] for name in chosen]
    if any(last.count(part) > 1 for part in _CALLED[called]):
        which = " or ".join(filter(None, arms))
        todo = f"--gripper-frame {which}" if which else "names that tell them apart in info.json"
        raise ValueError(f"holds several poses ({', '.join(names)}); give {todo}")
    return pose_convention(called), [last.index(part) for part in _CALLED[called]]


def _called(names: list[str]) -> str | None:
    """The convention that a feature's names speak of, if it is a pose."""
    last = [name.rpartition(".")[2] for name in names]
    return next((c for c, parts in _CALLED.items() if all(p in last for p in parts)), None)


def _arms(names: list[str]) -> list[str]:
    """What stands before the names of whole poses, such as left_ee and right_ee."""
    before = dict.fromkeys(name.rpartition(".")[0] for name in names)
    return [arm for arm in before if _called([n for n in names if n.rpartition(".")[0] == arm])]


def _names(info: Mapping[str, Any], column: str) -> list[str]:
    """What the numbers of a feature are called, without prefixes and `.pos`."""
    names = info["features"].get(column, {}).get("names") or []
    if isinstance(names, dict):  # {"motors": [...]}, or several arms with the same names
        groups = {key: group for key, group in names.items() if isinstance(group, list)}
        names = [
            f"{key}.{name}" if len(groups) > 1 else name
            for key, group in groups.items()
            for name in group
        ]
    return [str(name).removesuffix(".pos") for name in names]
