"""Gripper poses of a LeRobot dataset, from the features of its tables.

A pose is a feature whose names end in x, y, z and qx, qy, qz, qw, or wx, wy, wz for a rotation
vector; the first numbers of a feature in a convention that the user gives; or, with a URDF, the
joints of observation.state. `--gripper-frame` selects the feature if several hold poses, or the
arm, such as left_ee, if one feature holds left_ee.x and right_ee.x.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.conventions import (
    ConventionError,
    PoseConvention,
    check_units,
    pose_convention,
    poses_from_numbers,
)
from evercal.recordings.poses.kinematics import RobotModel, in_radians
from evercal.recordings.read_options import ReadOptions
from evercal.recordings.text_files import first_repeated

_STATE = "observation.state"
# Names of the numbers of a pose, by convention.
_PARTS = {"xyzw": ("x", "y", "z", "qx", "qy", "qz", "qw"), "ur": ("x", "y", "z", "wx", "wy", "wz")}


def pose_feature(root: Path, info: Mapping[str, Any], options: ReadOptions) -> str:
    """Name of the only feature with gripper poses or joint angles."""
    features = info["features"]
    if options.urdf is not None:
        return _STATE
    if options.pose_convention is not None:
        column = options.gripper_frame or _STATE
        if column not in features:
            names = ", ".join(features)
            raise InputError(f"{root}: no feature {column!r}; --gripper-frame is one of {names}")
        return column
    observed = {key: _names(info, key) for key in features if key.startswith("observation")}
    keys = [key for key, names in observed.items() if _convention_of(names)]
    if options.gripper_frame is not None:
        keys = [key for key in keys if options.gripper_frame in (key, *_arms(observed[key]))]
    if _STATE in keys or len(keys) == 1:
        return _STATE if _STATE in keys else keys[0]
    if keys:
        raise InputError(
            f"{root}: gripper poses are in {' and '.join(keys)}; name one with --gripper-frame"
        )
    named = {key: names for key, names in observed.items() if names and "image" not in key}
    listed = "; ".join(f"{key}: {', '.join(names)}" for key, names in named.items())
    raise InputError(
        f"{root}: no feature holds a pose (x, y, z and qx, qy, qz, qw or wx, wy, wz), there are"
        f" {listed or 'no named numbers'}; for joint angles give --urdf, for a pose in another form"
        f" --pose-convention and --gripper-frame FEATURE"
    )


def feature_poses(
    root: Path,
    info: Mapping[str, Any],
    column: str,
    values: NDArray[np.float64],
    options: ReadOptions,
) -> tuple[SE3, list[str]]:
    """Convert the numbers (n, k) of a feature to (n,) base_from_gripper, with notes."""
    names = _names(info, column)
    if options.urdf is not None:
        return _joint_poses(root, names, values, options)
    if options.base_frame is not None:
        raise InputError(f"{root}: --base-frame goes with --urdf only; leave it out")
    count, notes = values.shape[1], []
    try:
        if options.pose_convention is not None:
            convention = pose_convention(options.pose_convention)
            taken = convention.counts[-1]
            numbers = values[:, :taken]
            if taken < count:
                used = f" ({', '.join(names[:taken])})" if names else ""
                notes = [f"the first {taken} of its {count} numbers were taken{used}"]
        elif len(names) != count:
            raise ValueError(f"has {count} numbers and {len(names)} names")
        else:
            convention, columns = _pose_columns(names, options.gripper_frame)
            numbers = values[:, columns]
        poses = poses_from_numbers(numbers, convention)
        check_units(numbers, convention)
    except ConventionError as error:
        raise InputError(f"{root}: {column}: {error.naming('--pose-convention')}") from None
    except ValueError as error:
        raise InputError(f"{root}: {column}: {error}") from None
    return poses, [f"gripper poses are {column}: {convention.meaning}", *notes]


def _joint_poses(
    root: Path, names: list[str], stated: NDArray[np.float64], options: ReadOptions
) -> tuple[SE3, list[str]]:
    assert options.urdf is not None
    if len(names) != stated.shape[1]:
        count = stated.shape[1]
        raise InputError(f"{root}: {_STATE} has {count} numbers and {len(names)} names")
    repeated = first_repeated(names)
    if repeated is not None:
        raise InputError(f"{root}: {_STATE}: {repeated!r} names several numbers; rename them")
    model = RobotModel(options.urdf)
    values = in_radians(model, names, stated, [options.pose_convention] * len(names))
    source = f"{root}: {_STATE} (--pose-convention {options.pose_convention or 'rad'})"
    return model.poses(names, values, options.base_frame, options.gripper_frame, source)


def _pose_columns(names: list[str], arm: str | None) -> tuple[PoseConvention, list[int]]:
    """Convention of a feature's pose, and the columns of its numbers."""
    arms = _arms(names)
    chosen = [n if arm not in arms or n.rpartition(".")[0] == arm else "" for n in names]
    convention = _convention_of(chosen)
    assert convention is not None
    last = [name.rpartition(".")[2] for name in chosen]
    if any(last.count(part) > 1 for part in _PARTS[convention]):
        which = " or ".join(filter(None, arms))
        remedy = f"--gripper-frame {which}" if which else "names that tell them apart in info.json"
        raise ValueError(f"holds several poses ({', '.join(names)}); give {remedy}")
    return pose_convention(convention), [last.index(part) for part in _PARTS[convention]]


def _convention_of(names: list[str]) -> str | None:
    """The convention of a feature with these names, if it is a pose."""
    last = [name.rpartition(".")[2] for name in names]
    return next((c for c, parts in _PARTS.items() if all(p in last for p in parts)), None)


def _arms(names: list[str]) -> list[str]:
    """Prefixes of the names of whole poses, such as left_ee and right_ee."""
    prefixes = dict.fromkeys(name.rpartition(".")[0] for name in names)
    return [
        arm for arm in prefixes if _convention_of([n for n in names if n.rpartition(".")[0] == arm])
    ]


def _names(info: Mapping[str, Any], column: str) -> list[str]:
    """Names of the numbers of a feature, without `.pos`."""
    names = info["features"].get(column, {}).get("names") or []
    if isinstance(names, dict):  # {"motors": [...]}, or several arms with the same names
        groups = {key: group for key, group in names.items() if isinstance(group, list)}
        names = [
            f"{key}.{name}" if len(groups) > 1 else name
            for key, group in groups.items()
            for name in group
        ]
    return [str(name).removesuffix(".pos") for name in names]
