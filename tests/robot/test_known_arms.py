import json
from importlib import resources
from typing import get_args

import numpy as np
import pytest

from evercal.choices import ArmClass
from evercal.errors import InputError
from evercal.robot.known_arms import ARM_NAMES, known_arm


def test_a_ur5e_stands_as_its_maker_draws_it() -> None:
    # The maker's sheet: all joints at zero, the arm lies along -x of its base; the flange is at
    # -(a2 + a3), -(d4 + d6), d1 - d5. ROS turns base_link by 180 degrees against it.
    arm = known_arm("UR5e")
    pose = arm.poses(np.zeros((1, 6)))
    np.testing.assert_allclose(pose.translation_m, [[0.8172, 0.2329, 0.0628]])


def test_a_panda_stands_as_its_maker_draws_it() -> None:
    pose = known_arm("panda").poses(np.zeros((1, 7)))
    height = 0.333 + 0.316 + 0.384 - 0.107
    np.testing.assert_allclose(pose.translation_m, [[0.088, 0, height]], atol=1e-12)
    np.testing.assert_allclose(pose.rotation_matrix()[0, :, 2], [0, 0, -1], atol=1e-12)


@pytest.mark.parametrize("name", ARM_NAMES)
def test_each_arm_is_complete(name: str) -> None:
    arm = known_arm(name)
    assert ARM_NAMES[name] in get_args(ArmClass)
    assert arm.name == name
    assert (np.diff(arm.ranges, axis=1) > 0).all()


def test_the_table_is_plain_json() -> None:
    text = resources.files("evercal.robot").joinpath("arms.json").read_text("utf-8")
    assert list(json.loads(text)) == list(ARM_NAMES)


def test_another_name_is_refused_with_those_that_are_known() -> None:
    with pytest.raises(
        InputError, match="arm 'ur6' is not known; give a URDF, or one of ur3, ur5"
    ):
        known_arm("ur6")
