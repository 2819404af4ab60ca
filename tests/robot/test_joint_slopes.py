import time

import numpy as np
import pytest

from evercal.geometry import SE3
from evercal.robot.joint_slopes import joint_slopes
from evercal.robot.known_arms import known_arm


def _values(name: str, count: int = 60) -> np.ndarray:
    arm = known_arm(name)
    noise = np.random.default_rng(0).normal(0, 0.2, (count, len(arm.joints)))
    return arm.ranges[:, 1] + noise


@pytest.mark.parametrize("name", ["ur5e", "panda", "irb1200-5-0.9", "so101"])
def test_slopes_of_a_named_arm_are_those_of_its_inner_joints(name: str) -> None:
    arm = known_arm(name)
    values = _values(name)
    slopes = joint_slopes(arm.poses(values), arm)
    inner = len(arm.joints) - 2
    assert slopes.shape == (60, 6, inner)
    if inner < 5:
        step = 1e-6
        for joint in range(inner):
            moved = values + step * (np.arange(inner + 2) == joint + 1)
            motion = (arm.poses(values).inverse() @ arm.poses(moved)).log() / step
            np.testing.assert_allclose(slopes[:, :, joint], motion, atol=1e-2)


def test_an_unknown_arm_costs_milliseconds() -> None:
    poses = known_arm("ur5e").poses(_values("ur5e"))
    start = time.process_time()
    slopes = joint_slopes(poses, None)
    assert time.process_time() - start < 0.05
    assert slopes.shape[:2] == (60, 6)
    assert np.isfinite(slopes).all()


def test_any_poses_have_slopes() -> None:
    still = SE3.identity((5,))
    assert np.isfinite(joint_slopes(still, None)).all()
