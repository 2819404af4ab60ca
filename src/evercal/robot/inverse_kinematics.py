"""`inverse_kinematics`: joint values of stated gripper poses; tool and base are not known."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3, norms, pose_distance
from evercal.robot.arm import Arm
from evercal.typing import Array, BoolArray

_STARTS = 48
"""Postures from which the middle pose is solved."""
_BRANCHES = 8
"""Solutions of the middle pose that are followed to other poses."""
_FOLLOWED = 30
"""Poses that decide which branch is taken."""
_STEPS = 20
_LONGEST_STEP = 0.5
_DAMPING = 1e-6
_LEVER_M = 0.3
"""A rotation of one radian counts as so much translation."""
_WEIGHTS = np.array([1.0] * 3 + [_LEVER_M] * 3)
_REACHED_M = 0.02
"""Real arms differ from their maker's numbers."""
_TURN = 2 * np.pi
_SLACK = 0.05
"""Radians or metres by which a joint may exceed its limits."""
_REST_WEIGHT = 0.1
"""Distance of a branch from the usual posture, as a share of the motion between poses."""
_MOST = 0.9
"""Share of the poses that are reached, at least; the others are slips, or at the limits."""


class Reached(NamedTuple):
    """Joint values that reach the stated poses."""

    arm: Arm
    """With a tool that may be meant; its base may be higher than the stated one."""
    values: Array
    """(n, k) joint values."""


def inverse_kinematics(poses: SE3, arm: Arm) -> list[Reached]:
    """Joint values of (n,) base_from_gripper, for each base and tool that may be meant.

    They are of one branch; the order of the poses does not matter.

    Raises:
        InputError: The arm reaches less than most of them within its limits.
    """
    answers: list[Reached] = []
    lost = 0
    for height_m, tool_m in arm.assumed:
        lifted = SE3.from_translation([0, 0, height_m]) @ poses
        tool = SE3.from_translation([0, 0, tool_m]).matrix()
        longer = replace(arm, last=arm.last @ tool)
        if answers:
            values, reached = _iterate(
                longer,
                lifted,
                answers[-1].values,
            )
        else:
            values, reached = _solved(longer, lifted)
        if reached.mean() >= _MOST:
            answers.append(Reached(longer, values))
        lost = reached.argmin()
    if not answers:
        raise InputError(
            f"{arm.name}: does not reach pose {lost + 1} of {len(poses)}; name another"
            " arm, or give poses of the flange in the base of the robot"
        )
    return answers


def _solved(arm: Arm, poses: SE3) -> tuple[Array, BoolArray]:
    """Values (n, k) of the branch that moves least between similar poses, and which are reached."""
    some = np.unique(
        np.linspace(
            0,
            len(poses) - 1,
            _FOLLOWED,
        ).astype(int)
    )
    metres, radians = pose_distance(poses[:, None], poses[some])
    distances = metres + _LEVER_M * radians
    middle = some[distances.sum(0).argmin()]
    branches = _postures(arm, poses[[middle] * _STARTS])
    if not len(branches):
        return branches, np.zeros(len(poses), bool)
    found = _iterate(
        arm,
        poses[np.tile(some, len(branches))],
        branches.repeat(len(some), 0),
    )
    values = found[0].reshape(
        len(branches),
        len(some),
        -1,
    )
    reached = found[1].reshape(len(branches), -1)
    motion = _away(
        arm,
        values,
        branches[:, None],
    ).mean(1)
    motion += _REST_WEIGHT * _away(
        arm,
        branches,
        arm.ranges.T[1],
    )
    best = np.lexsort([motion, -reached.sum(1)])[0]
    solved = reached[best] | (some == middle)
    nearest = distances[:, solved].argmin(1)
    return _iterate(
        arm,
        poses,
        values[best][solved][nearest],
    )


def _postures(arm: Arm, same: SE3) -> Array:
    """(b, k) values that reach one pose, repeated for each start; the most usual first."""
    lower, rest, upper = arm.ranges.T
    random = np.random.default_rng(0)
    starts = random.uniform(
        lower,
        upper,
        (_STARTS, len(arm.joints)),
    )
    values, reached = _iterate(
        arm,
        same,
        starts,
    )
    values = np.unique(values[reached].round(3), axis=0)
    return values[
        _away(
            arm,
            values,
            rest,
        ).argsort()[:_BRANCHES]
    ]


def _iterate(arm: Arm, poses: SE3, starts: Array) -> tuple[Array, BoolArray]:
    """Damped least squares from values (m, k) to poses (m,), and which are reached."""
    values = starts.copy()
    misses = np.zeros(len(values))
    lower, rest, upper = arm.ranges.T
    active = np.arange(len(values))
    for _ in range(_STEPS):
        at = values[active]
        miss = (arm.poses(at).inverse() @ poses[active]).log() * _WEIGHTS
        slopes = arm.slopes(at) * _WEIGHTS[:, None]
        misses[active] = norms(miss)
        # Motions that leave the gripper where it is lead towards the usual posture.
        aside = 0.5 * _turned(arm, rest - at)
        miss -= (slopes @ aside[..., None])[..., 0]
        back = slopes.swapaxes(1, 2)
        gram = slopes @ back + _DAMPING * np.eye(6)
        steps = aside + (back @ np.linalg.solve(gram, miss[..., None]))[..., 0]
        longest = np.abs(steps).max(1)
        shorter = np.minimum(1, _LONGEST_STEP / longest.clip(1e-9))
        values[active] += steps * shorter[:, None]
        active = active[longest > 1e-6]
    middle = (lower + upper) / 2
    values = middle + _turned(arm, values - middle)
    inside = (values > lower - _SLACK) & (values < upper + _SLACK)
    return values, inside.all(1) & (misses < _REACHED_M)


def _away(arm: Arm, values: Array, others: Array) -> Array:
    """(...,) mean difference of values (..., k)."""
    return np.abs(_turned(arm, values - others)).mean(-1)


def _turned(arm: Arm, differences: Array) -> Array:
    """Differences of values (..., k); those of angles within half a turn."""
    turns = np.round(differences / _TURN) * arm.rotates()
    return differences - _TURN * turns
