"""Gripper poses from joint angles and a URDF.

    joints.csv                                   joints.json
        image,panda_joint1,panda_joint2,...          {"joint_names": ["panda_joint1", ...],
        image-1.png,0.12,-0.5,...                     "positions": [[0.12, -0.5, ...], ...],
                                                      "images": ["image-1.png", ...]}

The columns are the URDF's joint names; radians, or degrees where a name ends in `_deg`, metres for
joints that slide. An image or a time column (`stamp_s`; in JSON `stamps_s`) says which image a row
belongs to; without either they go in order.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.recordings.poses.kinematics import RobotModel
from evercal.recordings.poses.labels import labels_of_lists
from evercal.recordings.poses.pose_track import MAX_GAP_S
from evercal.recordings.poses.robot_poses import RobotPoses
from evercal.recordings.poses.row_files import Rows, read_rows

_UNITS = ("deg", "rad", "m")
_STILL_RAD = 0.001
_JSON = "an object with 'joint_names', 'positions' and, if known, 'images' or 'stamps_s'"


def read_joint_poses(
    path: Path,
    model: RobotModel,
    base: str | None = None,
    gripper: str | None = None,
    unit: str | None = None,
) -> tuple[RobotPoses, list[str]]:
    """Reads joint angles and makes gripper poses of them.

    Args:
        path: a CSV or JSON as above.
        model: the arm.
        base: link; the root of the URDF if None.
        gripper: link; the only end of the URDF if None.
        unit: "rad" or "deg", of angles whose column does not say; radians if None.

    Returns:
        The poses with names or times of the rows, and notes: the frames taken, doubtful angles.

    Raises:
        InputError: a file that cannot be read, a link or joint that is missing, degrees that are
            not called so.
    """
    rows = read_joints(path)
    base, gripper = base or model.base_link, gripper or model.end_link()
    needed = model.joints_between(base, gripper)
    if not needed:
        raise InputError(f"{model.path}: no joint moves {gripper} against {base}; name other links")
    names, values = _plain_columns(path, rows, model, unit)
    try:
        poses = model.base_from_gripper(names, values, base, gripper)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    used = [names.index(name) for name in needed]
    notes = [f"gripper poses are those of {gripper} in {base}, from {model.path.name}"]
    notes += model.beyond_limits(needed, values[:, used])
    return RobotPoses(rows.names, rows.stamps_s, poses), notes


def _plain_columns(
    path: Path, rows: Rows, model: RobotModel, unit: str | None
) -> tuple[list[str], NDArray[np.float64]]:
    """Joint names without their units, and (n, columns) values in radians and metres."""
    names, stated = [], []
    for column in rows.columns:
        plain, _, ending = column.rpartition("_")
        says = ending in _UNITS and not model.has_joint(column) and model.has_joint(plain)
        names.append(plain if says else column)
        stated.append(ending if says else None)
    twice = [name for i, name in enumerate(names) if name in names[:i] and model.has_joint(name)]
    if twice:
        raise InputError(f"{path}: several columns are of joint {twice[0]}; keep one of them")
    return names, in_radians(model, names, rows.values, [s or unit for s in stated])


def in_radians(
    model: RobotModel,
    names: Sequence[str],
    values: NDArray[np.float64],
    units: Sequence[str | None],
) -> NDArray[np.float64]:
    """Angles that are stated in degrees in radians; other values as they are.

    Args:
        model: tells which joints turn.
        names: of the joints.
        values: (n, joints).
        units: of each joint: "deg", "rad", "m" or None.

    Raises:
        InputError: another unit.
    """
    strange = next((unit for unit in units if unit not in (None, *_UNITS)), None)
    if strange is not None:
        raise InputError(f"--pose-convention {strange}: joint angles are rad or deg")
    turned = [u == "deg" and t for u, t in zip(units, model.turning(names), strict=True)]
    return np.where(turned, np.deg2rad(values), values)


def interpolate(
    times_s: NDArray[np.float64], positions: NDArray[np.float64], stamps_s: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """One joint between its known positions.

    Args:
        times_s: (n,) of the positions, in any order.
        positions: (n,) radians or metres; a jump by a whole turn is none.
        stamps_s: (m,) seconds.

    Returns:
        (m,) positions and (m,) whether each is known: not beyond the ends, and not in a gap of more
        than `MAX_GAP_S` over which the joint moved.
    """
    times, first = np.unique(times_s, return_index=True)
    values = np.unwrap(positions[first])
    known = (stamps_s >= times[0]) & (stamps_s <= times[-1])
    if len(times) > 1:
        after = np.searchsorted(times, stamps_s).clip(1, len(times) - 1)
        short = times[after] - times[after - 1] <= MAX_GAP_S
        still = np.abs(values[after] - values[after - 1]) < _STILL_RAD
        exact = (stamps_s == times[after]) | (stamps_s == times[after - 1])
        known &= short | still | exact
    return np.interp(stamps_s, times, values), known


def read_joints(path: Path) -> Rows:
    """The table of joint values.

    Raises:
        InputError: missing or not of this kind.
    """
    if path.suffix.lower() == ".csv":
        return read_rows(path, "joint angles")
    try:
        data = json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise InputError(f"{path}: not valid JSON ({error}); give {_JSON}") from None
    try:
        columns = tuple(str(name) for name in data["joint_names"])
        values = np.array(data["positions"], dtype=np.float64)
        names, times = labels_of_lists(data, len(values))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: {type(error).__name__} {error}; give {_JSON}") from None
    rows = len(values)
    if values.shape != (rows, len(columns)) or not rows or not np.isfinite(values).all():
        raise InputError(
            f"{path}: 'positions' is a list of rows of {len(columns)} numbers, one for each of"
            f" 'joint_names'"
        )
    return Rows(names, times, columns, values)
