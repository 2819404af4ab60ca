from dataclasses import replace

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.robot.inverse_kinematics import inverse_kinematics
from evercal.robot.known_arms import ARM_NAMES, known_arm
from evercal.typing import Array


def _postures(name: str, spread: float = 0.25, count: int = 20) -> Array:
    arm = known_arm(name)
    lower, rest, upper = arm.ranges.T
    noise = np.random.default_rng(3).normal(0, spread, (count, len(arm.joints)))
    noise *= np.where(arm.rotates(), 1, 0.1)
    return (rest + noise).clip(lower, upper)


@pytest.mark.parametrize("name", ARM_NAMES)
def test_stated_poses_give_their_joint_values(name: str) -> None:
    arm = known_arm(name)
    values = _postures(name)
    reached = inverse_kinematics(arm.poses(values), arm)
    assert (
        max(pose_distance(reached.arm.poses(reached.values), arm.poses(values))[0])
        < 1e-4
    )
    if len(arm.joints) <= 6:
        # An arm with an offset in its wrist has postures near each other for some poses.
        same = np.abs(reached.values - values).max(1) < 1e-3
        assert same.mean() > 0.9


def test_values_do_not_depend_on_the_order_of_the_poses() -> None:
    arm = known_arm("kr6-r900-sixx")
    poses = arm.poses(_postures("kr6-r900-sixx"))
    order = np.random.default_rng(0).permutation(20)
    values = inverse_kinematics(poses, arm).values
    shuffled = inverse_kinematics(poses[order], arm).values
    np.testing.assert_allclose(shuffled, values[order], atol=1e-4)


def test_similar_poses_of_a_seven_axis_arm_have_similar_values() -> None:
    arm = known_arm("panda")
    steps = np.linspace(0, 1, 30)[:, None]
    first, last = _postures("panda")[:2]
    values = inverse_kinematics(arm.poses(first + steps * (last - first)), arm).values
    assert np.abs(np.diff(values, axis=0)).max() < 0.1


def test_an_arm_that_is_too_short_is_named_with_the_pose() -> None:
    poses = known_arm("ur10e").poses(_postures("ur10e", 0.5))
    with pytest.raises(InputError, match=r"ur3e: does not reach pose \d+ of 20, at"):
        inverse_kinematics(poses, known_arm("ur3e"))


def test_a_tool_is_assumed_where_the_flange_does_not_reach() -> None:
    arm = known_arm("ur3e")
    hand = replace(arm, last=arm.last @ SE3.from_translation([0, 0, 0.3]).matrix())
    straight = _postures("ur3e", 0.1)
    straight[:, 1:5] += np.array([-0.3, 0.3, 0, np.pi / 2]) - arm.ranges[1:5, 1]
    reached = inverse_kinematics(hand.poses(straight), arm)
    assert reached.tool_m == 0.3
