import json
import re
from importlib import resources
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from evercal.choices import ArmClass
from evercal.errors import InputError
from evercal.robot.known_arms import (
    ARM_NAMES,
    USUAL_RAD,
    arm_of,
    known_arm,
)
from evercal.robot.pose_errors import ArmErrors


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


def test_the_page_lists_the_table() -> None:
    page = (Path(__file__).parents[2] / "docs" / "arms.md").read_text("utf-8")
    rows = re.findall(r"^\| .+ \| (.+) \| (`.+) \| .+ \| .+ \|$", page, re.M)
    listed = [
        (name, kind) for kind, cell in rows for name in re.findall("`(.+?)`", cell)
    ]
    assert sorted(listed) == sorted(ARM_NAMES.items())
    assert f"the kinematics of {len(listed)} arms" in page


def test_another_name_is_refused_with_those_that_are_known() -> None:
    with pytest.raises(
        InputError, match="arm 'ur6' is not known; give a URDF, or one of ur3"
    ):
        arm_of("ur6")


def test_an_arm_is_named_or_given_by_its_urdf(tmp_path: Path) -> None:
    joint = '<joint name="{}" type="revolute"><parent link="{}"/><child link="{}"/>{}</joint>'
    limit = '<limit lower="-0.5" upper="2.5"/>'
    links = "".join(f'<link name="{link}"/>' for link in "abc")
    turns = joint.format("j", "a", "b", limit) + joint.format("k", "b", "c", limit)
    file = tmp_path / "robot.urdf"
    file.write_text(f'<robot name="r">{links}{turns}</robot>')
    arm = arm_of(str(file))
    assert arm.joints == ("j", "k")
    np.testing.assert_allclose(arm.ranges, [[-0.5, 1, 2.5]] * 2)
    assert arm.assumed == ((0, 0),)
    turning = file.read_text().replace(' lower="-0.5" upper="2.5"', "")
    file.write_text(turning.replace("revolute", "continuous"))
    assert np.isfinite(arm_of(str(file)).ranges).all()
    assert len(arm_of(str(file), "b", "c").joints) == 1
    assert arm_of("UR5e").name == "ur5e"


def test_an_accuracy_is_that_of_the_joints_or_of_the_gripper() -> None:
    arm = known_arm("so101")
    slopes = np.zeros((4, 6, 2))
    slopes[:, 0] = np.array([0.3, 0.4])
    assert ArmErrors(arm).offset_rad(slopes) == USUAL_RAD["hobby"]
    joints = ArmErrors.stated("so101", "0.2deg")
    assert joints.offset_rad(slopes) == pytest.approx(np.radians(0.2))
    position = ArmErrors.stated(None, "1.5 mm")
    assert position.offset_rad(slopes) == pytest.approx(0.003)


@pytest.mark.parametrize("text", ["0.2", "0deg", "-1mm", "1mm2", "nan deg", "0.2 rad"])
def test_another_accuracy_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"`arm_accuracy` .* such as 0.2deg"):
        ArmErrors.stated("ur5e", text)
