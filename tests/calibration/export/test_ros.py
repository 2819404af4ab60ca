"""Formats of ROS, read the way tf2_ros, launch, yourdfpy and easy_handeye read them."""

import argparse
import io
import shlex
import sys
import types
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
import yourdfpy
from hypothesis import given, settings
from hypothesis import strategies as st

from evercal.calibration.calibration import Mount
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.poses.camera_file import read_camera

from .random_poses import calibration_of, poses, quaternion_matrix

poses_and_mounts = given(poses(), st.sampled_from(["eye_to_hand", "eye_in_hand"]))
few = settings(max_examples=8)
CHILD = "cam/optical-frame"


def parent_of(mount: Mount) -> str:
    return "base_link" if mount == "eye_to_hand" else "tool0"


def check_flags(words: list[str], pose: SE3, parent: str) -> None:
    """Parse the flags of static_transform_publisher."""
    parser = argparse.ArgumentParser()
    for name in ("x", "y", "z", "qx", "qy", "qz", "qw"):
        parser.add_argument(f"--{name}", type=float, required=True)
    parser.add_argument("--frame-id", required=True)
    parser.add_argument("--child-frame-id", required=True)
    # argparse would read -1e-05 as an option; tf2 does not.
    pairs = zip(words[::2], words[1::2], strict=True)
    parsed = parser.parse_args([f"{flag}={value}" for flag, value in pairs])
    assert (parsed.frame_id, parsed.child_frame_id) == (parent, CHILD)
    position = (parsed.x, parsed.y, parsed.z)
    matrix = quaternion_matrix(parsed.qx, parsed.qy, parsed.qz, parsed.qw, position)
    np.testing.assert_allclose(matrix, pose.matrix(), atol=1e-9)


@poses_and_mounts
@few
def test_shell_command(pose: SE3, mount: Mount) -> None:
    text = calibration_of(pose, mount).export("static_transform_publisher")
    words = shlex.split(text)
    assert words[:4] == ["ros2", "run", "tf2_ros", "static_transform_publisher"]
    check_flags(words[4:], pose, parent_of(mount))


@poses_and_mounts
@few
def test_launch_file_runs(pose: SE3, mount: Mount) -> None:
    launch, actions = types.ModuleType("launch"), types.ModuleType("launch_ros.actions")
    launch.LaunchDescription = list  # pyright: ignore[reportAttributeAccessIssue]
    actions.Node = dict  # pyright: ignore[reportAttributeAccessIssue]
    stand_ins = {"launch": launch, "launch_ros": types.ModuleType("launch_ros")}
    namespace: dict[str, Any] = {}
    text = calibration_of(pose, mount).export("launch_py")
    with pytest.MonkeyPatch.context() as patch:
        for name, module in {**stand_ins, "launch_ros.actions": actions}.items():
            patch.setitem(sys.modules, name, module)
        exec(compile(text, "x.launch.py", "exec"), namespace)
        (node,) = namespace["generate_launch_description"]()
    assert node["package"] == "tf2_ros"
    assert node["executable"] == "static_transform_publisher"
    assert node["name"].isidentifier()
    check_flags(node["arguments"], pose, parent_of(mount))


@poses_and_mounts
@few
def test_ros1_launch_file(pose: SE3, mount: Mount) -> None:
    text = calibration_of(pose, mount).export("ros1_launch")
    node = ElementTree.fromstring(text).find("node")
    assert node is not None
    assert (node.get("pkg"), node.get("type")) == ("tf2_ros", "static_transform_publisher")
    *words, parent, child = str(node.get("args")).split()
    assert (parent, child) == (parent_of(mount), CHILD)
    x, y, z, *quaternion = map(float, words)
    matrix = quaternion_matrix(*quaternion, translation=(x, y, z))
    np.testing.assert_allclose(matrix, pose.matrix(), atol=1e-9)


def matrix_of(transform: dict[str, dict[str, float]]) -> np.ndarray:
    """Return the matrix of a geometry_msgs/Transform, which has fields of type float only."""
    position = [transform["translation"][axis] for axis in "xyz"]
    assert all(type(v) is float for v in (*position, *transform["rotation"].values()))
    return quaternion_matrix(**transform["rotation"], translation=position)


@poses_and_mounts
@few
def test_transform_stamped_has_the_fields_of_the_message(pose: SE3, mount: Mount) -> None:
    message = yaml.safe_load(calibration_of(pose, mount).export("transform_stamped"))
    assert message.keys() == {"header", "child_frame_id", "transform"}
    stamp = {"sec": 0, "nanosec": 0}
    assert message["header"] == {"stamp": stamp, "frame_id": parent_of(mount)}
    assert message["child_frame_id"] == CHILD
    np.testing.assert_allclose(matrix_of(message["transform"]), pose.matrix(), atol=1e-9)


# The fields of easy_handeye2_msgs/HandeyeCalibration in its .msg files.
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


@poses_and_mounts
@few
def test_easy_handeye2(tmp_path_factory: pytest.TempPathFactory, pose: SE3, mount: Mount) -> None:
    path = tmp_path_factory.getbasetemp() / "cell.calib"
    text = calibration_of(pose, mount).export("easy_handeye2", path, robot_frame="other_frame")
    message = yaml.full_load(text)
    assert message.keys() == {"parameters", "transform"}
    parameters = message["parameters"]
    assert {key: type(value) for key, value in parameters.items()} == PARAMETERS
    # The publisher selects the parent by the type of the calibration.
    in_hand = parameters["calibration_type"] == "eye_in_hand"
    assert in_hand or parameters["calibration_type"] == "eye_on_base"
    frames = [parameters["robot_effector_frame"], parameters["robot_base_frame"]]
    parent, other = frames if in_hand else frames[::-1]
    assert (parent, other) == (parent_of(mount), "other_frame")
    assert parameters["tracking_base_frame"] == CHILD
    assert parameters["name"] == "cell"
    np.testing.assert_allclose(matrix_of(message["transform"]), pose.matrix(), atol=1e-9)


def read_easy_handeye(
    namespace: str,
    move_group_namespace: str = "/",
    move_group: str = "manipulator",
    eye_on_hand: bool | None = None,
    robot_base_frame: str | None = None,
    robot_effector_frame: str | None = None,
    tracking_base_frame: str | None = None,
    tracking_marker_frame: str | None = None,
) -> tuple[str | None, str | None]:
    """Take the keyword arguments of easy_handeye's reader and return parent and child."""
    return robot_effector_frame if eye_on_hand else robot_base_frame, tracking_base_frame


@poses_and_mounts
@few
def test_easy_handeye(pose: SE3, mount: Mount) -> None:
    data = yaml.safe_load(calibration_of(pose, mount).export("easy_handeye"))
    assert data.keys() == {"parameters", "transformation"}
    assert read_easy_handeye(**data["parameters"]) == (parent_of(mount), CHILD)
    assert data["parameters"]["eye_on_hand"] is (mount == "eye_in_hand")
    assert data["parameters"]["namespace"] == "/evercal/"
    t = data["transformation"]
    assert t.keys() == {"x", "y", "z", "qx", "qy", "qz", "qw"}
    matrix = quaternion_matrix(t["qx"], t["qy"], t["qz"], t["qw"], (t["x"], t["y"], t["z"]))
    np.testing.assert_allclose(matrix, pose.matrix(), atol=1e-9)


@poses_and_mounts
@few
def test_urdf_is_read_by_yourdfpy(pose: SE3, mount: Mount) -> None:
    parent = parent_of(mount)
    robot = f"""<robot name="r"><link name="{parent}"/><link name="{CHILD}"/>
        {calibration_of(pose, mount).export("urdf")}</robot>"""
    model = yourdfpy.URDF.load(io.BytesIO(robot.encode()))
    # At gimbal lock scipy's angles are accurate to 2e-7 rad.
    locked = abs(abs(pose.rotation_matrix()[2, 0]) - 1) <= 1e-9
    matrix = model.get_transform(CHILD, parent)
    np.testing.assert_allclose(matrix, pose.matrix(), atol=3e-7 if locked else 1e-9)


def test_urdf_angles_rotate_about_fixed_axes() -> None:
    """Rz(0.5) Ry(0.4) Rx(0.3) is written 0.3 0.4 0.5."""
    about = [SE3.exp([0, 0, 0, *angles]) for angles in np.diag([0.3, 0.4, 0.5])]
    text = calibration_of(about[2] @ about[1] @ about[0]).export("urdf")
    origin = ElementTree.fromstring(text).find("origin")
    assert origin is not None
    np.testing.assert_allclose([*map(float, str(origin.get("rpy")).split())], [0.3, 0.4, 0.5])


@pytest.mark.parametrize(
    ("distortion", "model", "count"),
    [
        ((), "plumb_bob", 5),
        ((0.1, 0.2, 0.3, 0.4), "plumb_bob", 5),
        ((0.1, 0.2, 0.3, 0.4, 1e-7), "plumb_bob", 5),
        ((0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8), "rational_polynomial", 8),
    ],
)
def test_camera_info(tmp_path: Path, distortion: tuple[float, ...], model: str, count: int) -> None:
    camera = Camera(640, 480, 600.25, 601.5, 319.75, 240.5, distortion)
    calibration = calibration_of(SE3.identity(), camera=camera)
    info = yaml.safe_load(calibration.export("camera_info", tmp_path / "info.yaml"))
    assert info["distortion_model"] == model
    assert len(info["distortion_coefficients"]["data"]) == count
    assert info["projection_matrix"]["data"][3::4] == [0.0, 0.0, 0.0]
    assert info["rectification_matrix"]["data"] == np.eye(3).ravel().tolist()
    for key in ("camera_matrix", "projection_matrix", "distortion_coefficients"):
        assert info[key]["rows"] * info[key]["cols"] == len(info[key]["data"])
    read = read_camera(tmp_path / "info.yaml")
    np.testing.assert_array_equal(read.matrix(), camera.matrix())
    assert (read.width, read.height) == (640, 480)
    assert read.distortion[: len(distortion)] == distortion
    assert not any(read.distortion[len(distortion) :])


@pytest.mark.parametrize("name", ["/camera", "my camera", "a\nb", "a/", "a//b", '"', "-x", "<"])
def test_invalid_frame_names_are_refused(name: str) -> None:
    with pytest.raises(InputError, match="is no name of a tf frame"):
        calibration_of(SE3.identity()).export("urdf", child=name)


@pytest.mark.parametrize("name", ["robot1/camera_link", "0", "a.b-c"])
def test_valid_frame_names_are_written(name: str) -> None:
    text = calibration_of(SE3.identity()).export("transform_stamped", child=name)
    assert yaml.safe_load(text)["child_frame_id"] == name
