"""`joint_slopes`: how offsets of an arm's joints move stated gripper poses."""

import numpy as np

from evercal.geometry import SE3
from evercal.robot.arm import Arm
from evercal.robot.inverse_kinematics import inverse_kinematics
from evercal.typing import Array

_SHOULDER = 0.3
"""Height of the shoulder of an unknown arm, as a share of the farthest gripper."""
_WRIST = 0.12
"""Length from its wrist to its gripper, likewise."""
_LINK = 0.56
"""Length of its two links, as a share of the farthest distance from shoulder to gripper."""


def joint_slopes(poses: SE3, arm: Arm | None) -> Array:
    """How each inner joint of an arm moves (n,) base_from_gripper: (n, 6, k).

    Translation and rotation in the axes of the gripper, for a radian, or a metre of a sliding
    joint; see `Arm.slopes`. The first and the last joint are left out: their offsets look like
    those of the base and of the mount. Without an arm, the four inner joints of a usual one.

    Raises:
        InputError: The arm does not reach a pose.
    """
    if arm is None:
        return _usual_slopes(poses)
    reached = inverse_kinematics(poses, arm)
    return reached.arm.slopes(reached.values)[:, :, 1:-1]


def _usual_slopes(poses: SE3) -> Array:
    """(n, 6, 4) of shoulder, elbow and two joints of the wrist, by its poses alone."""
    position = poses.translation_m
    forward = poses.rotation_matrix()[:, :, 2]
    reach = np.linalg.norm(position, axis=1).max()
    shoulder = np.array([0, 0, _SHOULDER * reach])
    wrist = position - _WRIST * reach * forward
    away = wrist - shoulder
    distance = np.linalg.norm(
        away,
        axis=1,
        keepdims=True,
    )
    link = _LINK * np.linalg.norm(position - shoulder, axis=1).max()
    link = np.maximum(link, 0.51 * distance)
    side = _unit(np.stack([-wrist[:, 1], wrist[:, 0], 0 * wrist[:, 0]], 1))
    up = np.cross(_unit(away), side)
    up *= np.where(
        up[:, 2:] < 0,
        -1,
        1,
    )
    elbow = shoulder + away / 2 + up * np.sqrt(link**2 - distance**2 / 4)
    fore = _unit(wrist - elbow)
    bend = np.cross(fore, forward)
    straight = (
        np.linalg.norm(
            bend,
            axis=1,
            keepdims=True,
        )
        < 0.05
    )
    bend = np.where(
        straight,
        side,
        _unit(bend),
    )
    axes = np.stack([side, side, fore, bend], 2)
    points = np.stack([np.broadcast_to(shoulder, wrist.shape), elbow, wrist, wrist], 2)
    shifts = np.cross(
        axes,
        position[:, :, None] - points,
        axis=1,
    )
    to_gripper = poses.rotation_matrix().swapaxes(1, 2)
    return np.concatenate([to_gripper @ shifts, to_gripper @ axes], 1)


def _unit(vectors: Array) -> Array:
    lengths = np.linalg.norm(
        vectors,
        axis=-1,
        keepdims=True,
    )
    return vectors / lengths.clip(1e-12)
