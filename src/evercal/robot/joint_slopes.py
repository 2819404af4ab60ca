"""`joint_slopes`: how offsets of an arm's inner joints move stated gripper poses."""

from itertools import product

import numpy as np

from evercal.geometry import SE3, norms, unit_vectors
from evercal.robot.arm import Arm
from evercal.robot.inverse_kinematics import inverse_kinematics
from evercal.typing import Array

_SHOULDERS = (0.15, 0.4)
"""Heights of the shoulder of an unknown arm, as shares of the farthest gripper."""
_WRISTS = (0.0, 0.2)
"""Lengths from its wrist to its gripper, likewise."""
_LINKS = (0.53, 0.8)
"""Lengths of its two links, as shares of the farthest distance from shoulder to gripper."""
_HEADINGS = (1, 0.3, 0.3, 1, 0.3, 1, 1, 0.3)
"""How far its plane turns with the wrist, for each combination of these; an arm of seven axes has
a plane of its own."""
_WEIGHTS = np.array([1, 1, 1, 1, 0.7, 0.5, 0.5, 0.3])
"""Axes that only some arms have count less."""


def joint_slopes(poses: SE3, arm: Arm | None) -> Array:
    """How each inner joint of an arm moves (n,) base_from_gripper: (n, 6, k).

    Translation and rotation in the axes of the gripper, for a radian, or a metre of a sliding
    joint; see `Arm.slopes`. The first and the last joint are left out: their offsets look like
    those of the base and of the mount. The bases and tools that may be meant, and without an arm
    the proportions of eight usual ones, stand side by side: k is several times the number of
    joints, and together they move the gripper as much as one of them.

    Raises:
        InputError: The arm does not reach most poses.
    """
    if not arm:
        kinds = zip(
            product(
                _SHOULDERS,
                _WRISTS,
                _LINKS,
            ),
            _HEADINGS,
            strict=True,
        )
        slopes = [
            _usual(
                poses,
                *lengths,
                heading,
            )
            for lengths, heading in kinds
        ]
    else:
        answers = inverse_kinematics(poses, arm)
        slopes = [at.arm.slopes(at.values)[:, :, 1:-1] for at in answers]
    return np.concatenate(slopes, 2) / np.sqrt(len(slopes))


def _usual(
    poses: SE3,
    height: float,
    tool: float,
    link: float,
    heading: float,
) -> Array:
    """(n, 6, 8) of the joints that stand as an arm of these proportions would at its poses."""
    position = poses.translation_m
    gripper = poses.rotation_matrix()
    forward = gripper[:, :, 2]
    reach = norms(position).max()
    shoulder = np.zeros_like(position)
    shoulder[:, 2] = height * reach
    wrist = position - tool * reach * forward
    turn = wrist[:, 0] + 1j * wrist[:, 1]
    middle = np.angle(turn.sum())
    azimuth = middle + heading * np.angle(turn * np.exp(-1j * middle))
    zero = np.zeros_like(azimuth)
    ahead = np.stack([np.cos(azimuth), np.sin(azimuth), zero], 1)
    side = np.cross(np.eye(3)[2], ahead)
    away = wrist - shoulder
    half = norms(away)[:, None] / 2
    longest = norms(position - shoulder).max()
    link_m = np.maximum(link * longest, 1.02 * half)
    up = unit_vectors(np.cross(away, side))
    up *= np.sign(up[:, 2:])
    elbow = shoulder + away / 2 + up * np.sqrt(link_m**2 - half**2)
    upper = unit_vectors(elbow - shoulder)
    fore = unit_vectors(wrist - elbow)
    hinge = unit_vectors(np.cross(upper, fore))
    bend = unit_vectors(np.cross(fore, forward))
    across = unit_vectors(np.cross(side, forward))
    axes = [side, hinge, fore, bend, upper, side, across, ahead]
    points = [shoulder, elbow, wrist, wrist, shoulder, wrist, wrist, shoulder]
    turns = np.stack(axes, 2) * _WEIGHTS
    shifts = np.cross(
        turns,
        position[:, :, None] - np.stack(points, 2),
        axis=1,
    )
    back = gripper.swapaxes(1, 2)
    return np.concatenate([back @ shifts, back @ turns], 1)
