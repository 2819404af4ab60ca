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
    reached = inverse_kinematics(arm.poses(values), arm)[0]
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
    values = inverse_kinematics(poses, arm)[0].values
    shuffled = inverse_kinematics(poses[order], arm)[0].values
    np.testing.assert_allclose(shuffled, values[order], atol=1e-4)


def test_similar_poses_of_a_seven_axis_arm_have_similar_values() -> None:
    arm = known_arm("panda")
    steps = np.linspace(0, 1, 30)[:, None]
    first, last = _postures("panda")[:2]
    values = inverse_kinematics(arm.poses(first + steps * (last - first)), arm)[
        0
    ].values
    assert np.abs(np.diff(values, axis=0)).max() < 0.1


def test_an_arm_that_is_too_short_is_named_with_the_pose() -> None:
    poses = known_arm("ur10e").poses(_postures("ur10e", 0.5))
    with pytest.raises(InputError, match=r"ur3e: does not reach pose \d+ of 20;"):
        inverse_kinematics(poses, known_arm("ur3e"))


def test_each_tool_that_may_be_meant_is_an_answer() -> None:
    arm = known_arm("ur5e")
    tool = SE3.from_translation([0, 0, 0.1])
    values = _postures("ur5e")
    answers = inverse_kinematics(arm.poses(values) @ tool, arm)
    assert len(answers) > 1
    errors = [np.abs(answer.values - values).max() for answer in answers]
    assert min(errors) < 1e-3 < max(errors)


def test_one_pose_out_of_reach_is_a_slip() -> None:
    arm = known_arm("panda")
    poses = arm.poses(_postures("panda"))
    shift = np.zeros((20, 3))
    shift[4] = 9.0
    slipped = SE3.from_translation(shift) @ poses
    values = inverse_kinematics(slipped, arm)[0].values
    assert np.abs(values - inverse_kinematics(poses, arm)[0].values)[:4].max() < 0.1
