"""easy_handeye2's message, easy_handeye's keyword arguments, MoveIt's samples."""

from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from evercal.calibration.calibration import Mount
from evercal.calibration.export import handeye_tools
from evercal.calibration.export.request import Export
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.robot_poses import RobotPoses

from .drawn import arm, made, poses, quaternion_matrix

mounts = st.sampled_from(["eye_to_hand", "eye_in_hand"])
few = settings(deadline=None, max_examples=40)

# The fields of easy_handeye2_msgs/HandeyeCalibration, as its .msg files list them.
PARAMETERS = {
    "name": str,
    "calibration_type": str,
    "robot_base_frame": str,
    "robot_effector_frame": str,
    "tracking_base_frame": str,
    "tracking_marker_frame": str,
    "freehand_robot_movement": bool,
    "move_group_namespace": str,
    "move_group": str,
}


def set_message_fields(data: dict[str, Any], fields: dict[str, Any]) -> None:
    """Refuses what is no field of the message, and values of another type, as ROS does."""
    assert data.keys() == fields.keys()
    for key, kind in fields.items():
        if isinstance(kind, dict):
            set_message_fields(data[key], kind)
        else:
            assert type(data[key]) is kind


@given(poses(), mounts)
@few
def test_easy_handeye2(pose: SE3, mount: Mount) -> None:
    export = Export(made(pose, mount), "cell", "other_frame")
    message = yaml.full_load(handeye_tools.easy_handeye2(export))
    vector = dict.fromkeys("xyz", float)
    transform = {"translation": vector, "rotation": {**vector, "w": float}}
    set_message_fields(message, {"parameters": PARAMETERS, "transform": transform})
    said = message["parameters"]
    # Its publisher names the parent by the calibration's type.
    in_hand = said["calibration_type"] == "eye_in_hand"
    assert in_hand or said["calibration_type"] == "eye_on_base"
    parent = said["robot_effector_frame"] if in_hand else said["robot_base_frame"]
    other = said["robot_base_frame"] if in_hand else said["robot_effector_frame"]
    assert (parent, other) == ("tool0" if mount == "eye_in_hand" else "base_link", "other_frame")
    assert said["tracking_base_frame"] == "cam/optical-frame"
    assert said["name"] == "cell"
    position = [message["transform"]["translation"][axis] for axis in "xyz"]
    matrix = quaternion_matrix(**message["transform"]["rotation"], translation=position)
    np.testing.assert_allclose(matrix, pose.matrix(), atol=1e-9)


def easy_handeye_parameters(
    namespace: str,
    move_group_namespace: str = "/",
    move_group: str = "manipulator",
    eye_on_hand: bool | None = None,
    robot_base_frame: str | None = None,
    robot_effector_frame: str | None = None,
    tracking_base_frame: str | None = None,
    tracking_marker_frame: str | None = None,
) -> tuple[str | None, str | None, bool | None, str]:
    """Takes what its reader takes; gives parent, child, eye_on_hand, namespace."""
    parent = robot_effector_frame if eye_on_hand else robot_base_frame
    return parent, tracking_base_frame, eye_on_hand, namespace


@given(poses(), mounts)
@few
def test_easy_handeye(pose: SE3, mount: Mount) -> None:
    data = yaml.safe_load(handeye_tools.easy_handeye(Export(made(pose, mount), "cell")))
    assert data.keys() == {"parameters", "transformation"}
    parent, child, on_hand, namespace = easy_handeye_parameters(**data["parameters"])
    in_hand = mount == "eye_in_hand"
    assert (parent, child) == ("tool0" if in_hand else "base_link", "cam/optical-frame")
    assert on_hand is in_hand
    assert namespace.rstrip("/").split("/")[-1] == "cell"
    t = data["transformation"]
    assert t.keys() == {"x", "y", "z", "qx", "qy", "qz", "qw"}
    matrix = quaternion_matrix(t["qx"], t["qy"], t["qz"], t["qw"], (t["x"], t["y"], t["z"]))
    np.testing.assert_allclose(matrix, pose.matrix(), atol=1e-9)


def pairs(robot: RobotPoses | None, target: RobotPoses | None) -> Export:
    calibration = made(SE3.identity(), "eye_in_hand")
    return Export(calibration, robot_poses=robot, target_poses=target)


def test_moveit_samples_are_sixteen_numbers_each() -> None:
    robot, target = arm(5, 1), arm(5, 2)
    text = handeye_tools.moveit_samples(
        pairs(RobotPoses(None, None, robot), RobotPoses(None, None, target))
    )
    samples = yaml.safe_load(text)
    assert len(samples) == 5
    for i, sample in enumerate(samples):
        assert sample.keys() == {"effector_wrt_world", "object_wrt_sensor"}
        assert all(type(value) is float for row in sample.values() for value in row)
        hand = np.reshape(sample["effector_wrt_world"], (4, 4))
        board = np.reshape(sample["object_wrt_sensor"], (4, 4))
        np.testing.assert_allclose(hand, robot[i].matrix(), atol=1e-12)
        np.testing.assert_allclose(board, target[i].matrix(), atol=1e-12)


def test_moveit_samples_go_by_name() -> None:
    robot, target = arm(3, 1), arm(3, 2)
    shuffled = RobotPoses(("c", "a", "b"), None, target[[2, 0, 1]])
    text = handeye_tools.moveit_samples(pairs(RobotPoses(("a", "b", "c"), None, robot), shuffled))
    boards = [np.reshape(s["object_wrt_sensor"], (4, 4)) for s in yaml.safe_load(text)]
    np.testing.assert_allclose(boards, target.matrix(), atol=1e-12)


def test_moveit_samples_that_do_not_belong_together() -> None:
    robot = RobotPoses(("a", "b"), None, arm(2))
    with pytest.raises(InputError, match=r"--robot-poses and the board's poses .* --target-poses"):
        handeye_tools.moveit_samples(pairs(robot, None))
    with pytest.raises(InputError, match="'c' has only one of its two poses"):
        handeye_tools.moveit_samples(pairs(robot, RobotPoses(("a", "b", "c"), None, arm(3))))
    with pytest.raises(InputError, match="2 robot poses and 3 target poses"):
        handeye_tools.moveit_samples(pairs(robot, RobotPoses(None, None, arm(3))))
