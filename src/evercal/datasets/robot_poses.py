"""Gripper poses from a file: a CSV with a header, one row for each image."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from evercal.datasets.row_files import read_rows
from evercal.errors import InputError
from evercal.geometry import SE3

_COLUMNS = ("x_m", "y_m", "z_m", "rotvec_x", "rotvec_y", "rotvec_z")


@dataclass(frozen=True, eq=False)
class RobotPoses:
    """Poses of the gripper in the robot's base."""

    names: tuple[str, ...] | None
    """The image of every pose; None where the file does not say."""
    stamps_s: NDArray[np.float64] | None
    """(n,) seconds; None where the file does not say."""
    poses: SE3
    """(n,) base_from_gripper."""


def read_robot_poses(path: str | os.PathLike[str], convention: str | None = None) -> RobotPoses:
    """Reads gripper poses.

    Args:
        path: a CSV with the columns x_m, y_m, z_m and rotvec_x, rotvec_y, rotvec_z (radians), and
            one for the image's name or the time, if there is one.
        convention: None; no other is known.

    Raises:
        InputError: missing, or not of this kind.
    """
    path = Path(path)
    if convention is not None or path.suffix.lower() != ".csv":
        raise InputError(f"{path}: only a CSV with the columns {', '.join(_COLUMNS)} can be read")
    rows = read_rows(path, "gripper poses")
    if rows.columns != _COLUMNS:
        raise InputError(
            f"{path}: columns are {', '.join(_COLUMNS)}, got {', '.join(rows.columns)}"
        )
    turn = Rotation.from_rotvec(rows.values[:, 3:]).as_quat(scalar_first=True)
    return RobotPoses(rows.names, rows.stamps_s, SE3(turn, rows.values[:, :3]))
