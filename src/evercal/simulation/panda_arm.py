"""Kinematics of a Panda-like arm without extras: forward, inverse, and random poses over a table.

Link lengths and joint limits are those of Franka's documentation (Denavit-Hartenberg parameters in
Craig's convention). The gripper frame is the flange.
"""

import numpy as np
from numpy.random import default_rng

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.typing import Array

LINKS = np.array(
    [
        (0.0, 0.333, 0.0),
        (0.0, 0.0, -np.pi / 2),
        (0.0, 0.316, np.pi / 2),
        (0.0825, 0.0, np.pi / 2),
        (-0.0825, 0.384, -np.pi / 2),
        (0.0, 0.0, np.pi / 2),
        (0.088, 0.0, np.pi / 2),
        (0.0, 0.107, 0.0),
    ]
)
"""(8, 3) a, d and alpha of each joint and of the flange, metres and radians."""
_JOINTS_RAD = np.array(
    [
        (-2.8973, 2.8973, 0.0),
        (-1.7628, 1.7628, -0.785),
        (-2.8973, 2.8973, 0.0),
        (-3.0718, -0.0698, -2.356),
        (-2.8973, 2.8973, 0.0),
        (-0.0175, 3.7525, 1.571),
        (-2.8973, 2.8973, 0.785),
    ]
)
"""(7, 3) lower limit, upper limit and ready position of each joint, radians."""
LOW_RAD = _JOINTS_RAD[:, 0]
"""(7,) lower limits of the joint angles, radians."""
HIGH_RAD = _JOINTS_RAD[:, 1]
"""(7,) upper limits of the joint angles, radians."""
HOME_RAD = _JOINTS_RAD[:, 2]
"""(7,) joint angles of Franka's ready position, radians."""

_REACHED_M = 1e-6
"""Distance from the target position below which it is reached, metres."""
_REACHED_RAD = 1e-6
"""Angle from the target rotation below which it is reached, radians."""
_CONVERGED = 1e-8
"""Largest error, metres or radians, at which the iteration ends."""
_STEPS = 60
"""Maximum number of steps from one start."""
_STARTS = 12
"""Number of starts: the current joint angles, the ready position, and random ones."""
_DAMPING = 1e-6
"""Damping of the least-squares step, added to the diagonal."""
_LONGEST_STEP_RAD = 0.5
"""Maximum change of a joint angle in a step, radians."""


def joint_frames(joints_rad: Array) -> Array:
    """(8, 4, 4) frames of the seven joints and of the flange in the base, for joint angles (7,)."""
    frames = np.zeros((8, 4, 4))
    current = np.eye(4)
    angles = np.append(joints_rad, 0.0)
    for i, (a, d, alpha) in enumerate(LINKS):
        c = np.cos(angles[i])
        s = np.sin(angles[i])
        ca = np.cos(alpha)
        sa = np.sin(alpha)
        step = np.array(
            [
                [c, -s, 0, a],
                [s * ca, c * ca, -sa, -d * sa],
                [s * sa, c * sa, ca, d * ca],
                [0, 0, 0, 1],
            ]
        )
        current = current @ step
        frames[i] = current
    return frames


def base_from_flange(joints_rad: Array) -> SE3:
    """Pose of the flange for joint angles (7,)."""
    frames = joint_frames(joints_rad)
    return SE3.from_matrix(frames[-1])


def joints_for(
    base_from_gripper: SE3,
    start_rad: Array,
    seed: int = 0,
) -> Array:
    """Joint angles (7,) that bring the flange to a pose, near `start_rad` if possible.

    Damped least squares (Nakamura and Hanafusa 1986) with random restarts.
    """
    rng = default_rng(seed)
    starts = [np.asarray(start_rad, float), HOME_RAD]
    for _ in range(len(starts), _STARTS):
        starts.append(rng.uniform(LOW_RAD, HIGH_RAD))
    nearest = np.inf
    for start in starts:
        joints, metres, radians = _descend(base_from_gripper, start)
        if metres < _REACHED_M and radians < _REACHED_RAD:
            return joints
        nearest = min(nearest, metres)
    x, y, z = base_from_gripper.translation_m
    raise InputError(
        f"the arm does not reach x {x:.3f}, y {y:.3f}, z {z:.3f} m"
        f" with this rotation (nearest {1000 * nearest:.0f} mm off);"
        " choose a pose nearer to the middle of its workspace"
    )


def _descend(target: SE3, start: Array) -> tuple[Array, float, float]:
    """Joint angles, and the remaining distance in metres and radians."""
    joints = start.copy()
    error = np.full(6, np.inf)
    for _ in range(_STEPS):
        frames = joint_frames(joints)
        flange = SE3.from_matrix(frames[-1])
        shift = target.translation_m - flange.translation_m
        turn = (target @ flange.inverse()).log()[3:]
        error = np.concatenate([shift, turn])
        if np.abs(error).max() < _CONVERGED:
            break
        axes = frames[:7, :3, 2]
        origins = frames[:7, :3, 3]
        levers = frames[-1, :3, 3] - origins
        jacobian = np.hstack([np.cross(axes, levers), axes]).T
        damped = jacobian @ jacobian.T
        damped += _DAMPING * np.eye(6)
        step = jacobian.T @ np.linalg.solve(damped, error)
        longest = max(np.abs(step).max(), 1e-12)
        step *= min(1.0, _LONGEST_STEP_RAD / longest)
        joints = np.clip(joints + step, LOW_RAD, HIGH_RAD)
    metres = float(np.linalg.norm(error[:3]))
    radians = float(np.linalg.norm(error[3:]))
    return joints, metres, radians
