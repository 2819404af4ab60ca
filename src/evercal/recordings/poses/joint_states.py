"""Gripper poses from joint angles and a URDF.

A CSV table has a column for each joint of the URDF; JSON has `joint_names` and `positions`. Values
are radians, or degrees if a name ends in `_deg`, and metres for prismatic joints.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.recordings.poses.kinematics import RobotModel
from evercal.recordings.poses.pose_track import MAX_GAP_S
from evercal.recordings.poses.robot_poses import RobotPoses
from evercal.recordings.poses.row_files import Rows, read_rows, row_labels
from evercal.recordings.text_files import read_json

_UNITS = ("deg", "rad", "m")
_STILL_RAD = 0.001
_JSON = "an object with 'joint_names', 'positions' and optionally 'images' or 'stamps_s'"


def read_joint_poses(
    path: Path,
    model: RobotModel,
    base: str | None = None,
    gripper: str | None = None,
    unit: str | None = None,
) -> tuple[RobotPoses, list[str]]:
    """Read joint angles and compute gripper poses, with notes.

    `unit` is "rad" or "deg" of angles whose column states no unit; radians if omitted. Links are
    chosen by `RobotModel.chosen_links`.
    """
    rows = read_joints(path)
    base, gripper = model.chosen_links(base, gripper)
    if not model.joints_between(base, gripper):
        raise InputError(f"{model.path}: no joint moves {gripper} against {base}; name other links")
    names, values = _plain_columns(path, rows, model, unit)
    try:
        poses, notes = model.poses(names, values, base, gripper)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return RobotPoses(rows.names, rows.stamps_s, poses), notes


def _plain_columns(
    path: Path, rows: Rows, model: RobotModel, unit: str | None
) -> tuple[list[str], NDArray[np.float64]]:
    """Joint names without their units, and (n, columns) values in radians and metres."""
    names, units = [], []
    for column in rows.columns:
        plain, _, ending = column.rpartition("_")
        stated = ending in _UNITS and not model.has_joint(column) and model.has_joint(plain)
        names.append(plain if stated else column)
        units.append(ending if stated else unit)
    repeated = [name for i, name in enumerate(names) if name in names[:i] and model.has_joint(name)]
    if repeated:
        raise InputError(f"{path}: several columns are of joint {repeated[0]}; keep one of them")
    return names, in_radians(model, names, rows.values, units)


def in_radians(
    model: RobotModel,
    names: Sequence[str],
    values: NDArray[np.float64],
    units: Sequence[str | None],
) -> NDArray[np.float64]:
    """Convert angles in degrees to radians and leave other values (n, k) as they are."""
    other = next((unit for unit in units if unit not in (None, *_UNITS)), None)
    if other is not None:
        raise InputError(f"--pose-convention {other}: joint angles are rad or deg")
    degrees = [u == "deg" and model.rotates(name) for u, name in zip(units, names, strict=True)]
    return np.where(degrees, np.deg2rad(values), values)


def interpolate(
    times_s: NDArray[np.float64], positions: NDArray[np.float64], stamps_s: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Interpolate (n,) positions of a joint at (m,) seconds; jumps by full rotations are removed.

    The second array tells whether each is valid: between the ends, and not in a gap of more than
    `MAX_GAP_S` over which the joint moved.
    """
    times, first = np.unique(times_s, return_index=True)
    values = np.unwrap(positions[first])
    valid = (stamps_s >= times[0]) & (stamps_s <= times[-1])
    if len(times) > 1:
        after = np.searchsorted(times, stamps_s).clip(1, len(times) - 1)
        short = times[after] - times[after - 1] <= MAX_GAP_S
        still = np.abs(values[after] - values[after - 1]) < _STILL_RAD
        exact = (stamps_s == times[after]) | (stamps_s == times[after - 1])
        valid &= short | still | exact
    return np.interp(stamps_s, times, values), valid


def read_joints(path: Path) -> Rows:
    """Read a table of joint values."""
    if path.suffix.lower() == ".csv":
        return read_rows(path, "joint angles")
    data: dict[str, Any] = read_json(path, "file of joint angles", f"give {_JSON}")
    try:
        columns = tuple(str(name) for name in data["joint_names"])
        values = np.array(data["positions"], dtype=np.float64)
        lists = {key: value for key, value in data.items() if isinstance(value, list)}
        names, times, _ = row_labels([*lists], [*lists.values()], len(values), plural=True)
        if values.shape != (len(values), len(columns)) or not np.isfinite(values).all():
            raise ValueError("'positions' are rows of finite numbers, one for each joint")
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: {type(error).__name__} {error}; give {_JSON}") from None
    return Rows(names, times, columns, values)
