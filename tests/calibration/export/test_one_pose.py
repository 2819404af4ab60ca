"""Formats of one pose, read the way ROS, OpenCV, numpy and robot controllers read them."""

import io
import json
import re
import shlex
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import yaml
import yourdfpy
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from evercal.calibration.export.formats import FORMATS
from evercal.choices import ExportFormat
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_distance
from evercal.recordings.cameras.camera_file import read_camera
from evercal.recordings.poses.robot_poses import read_robot_poses
from evercal.robot.mount import MountName
from evercal.typing import Array

from .random_poses import CAMERA, POSE, calibration_of, poses, quaternion_matrix

Read = tuple[Array, str, str]
"""Matrix parent_from_child, and the names of both frames; empty if the format has none."""
NUMBER = r"-?\d+\.\d+"
CHILD = "cam/optical-frame"


def parent_of(mount: MountName) -> str:
    return "base_link" if mount == "eye_to_hand" else "tool0"


def flags(words: list[str]) -> Read:
    """Read the flags of static_transform_publisher."""
    values = dict(zip(words[::2], words[1::2], strict=True))
    names = ("x", "y", "z", "qx", "qy", "qz", "qw")
    x, y, z, *rotation = (float(values.pop(f"--{name}")) for name in names)
    frames = values.pop("--frame-id"), values.pop("--child-frame-id")
    assert not values
    return quaternion_matrix(*rotation, translation=(x, y, z)), *frames


def shell(text: str) -> Read:
    words = shlex.split(text)
    assert words[:4] == ["ros2", "run", "tf2_ros", "static_transform_publisher"]
    return flags(words[4:])


def launch_py(text: str) -> Read:
    """Run the launch file with stand-ins of ROS."""
    launch = types.ModuleType("launch")
    actions = types.ModuleType("launch_ros.actions")
    launch.LaunchDescription = list  # pyright: ignore[reportAttributeAccessIssue]
    actions.Node = dict  # pyright: ignore[reportAttributeAccessIssue]
    stand_ins = {"launch": launch, "launch_ros": types.ModuleType("launch_ros")}
    namespace: dict[str, Any] = {}
    with pytest.MonkeyPatch.context() as patch:
        for name, module in {**stand_ins, "launch_ros.actions": actions}.items():
            patch.setitem(sys.modules, name, module)
        exec(compile(text, "x.launch.py", "exec"), namespace)
        (node,) = namespace["generate_launch_description"]()
    assert (node["package"], node["executable"]) == (
        "tf2_ros",
        "static_transform_publisher",
    )
    assert node["name"].isidentifier()
    return flags(node["arguments"])


def ros1_launch(text: str) -> Read:
    node = ElementTree.fromstring(text).find("node")
    assert node is not None
    assert (node.get("pkg"), node.get("type")) == (
        "tf2_ros",
        "static_transform_publisher",
    )
    *words, parent, child = str(node.get("args")).split()
    x, y, z, *rotation = map(float, words)
    return quaternion_matrix(*rotation, translation=(x, y, z)), parent, child


def of_message(transform: dict[str, dict[str, float]]) -> Array:
    """Read a geometry_msgs/Transform, which has fields of type float only."""
    position = [transform["translation"][axis] for axis in "xyz"]
    assert all(type(v) is float for v in (*position, *transform["rotation"].values()))
    return quaternion_matrix(**transform["rotation"], translation=position)


def stamped(text: str) -> Read:
    message = yaml.safe_load(text)
    assert message.keys() == {"header", "child_frame_id", "transform"}
    assert message["header"].pop("stamp") == {"sec": 0, "nanosec": 0}
    return (
        of_message(message["transform"]),
        *message["header"].values(),
        message["child_frame_id"],
    )


def easy_handeye2(text: str) -> Read:
    message = yaml.full_load(text)
    assert message.keys() == {"parameters", "transform"}
    parameters = message["parameters"]
    # The fields of easy_handeye2_msgs/HandeyeCalibration in its .msg files.
    names = ["name", "calibration_type", "move_group_namespace", "move_group"]
    names += ["robot_base_frame", "robot_effector_frame"]
    names += ["tracking_base_frame", "tracking_marker_frame"]
    types_of = dict.fromkeys(names, str) | {"freehand_robot_movement": bool}
    assert {key: type(value) for key, value in parameters.items()} == types_of
    # The publisher selects the parent by the type of the calibration.
    in_hand = {"eye_in_hand": True, "eye_on_base": False}[
        parameters["calibration_type"]
    ]
    parent = parameters["robot_effector_frame" if in_hand else "robot_base_frame"]
    return of_message(message["transform"]), parent, parameters["tracking_base_frame"]


def easy_handeye(text: str) -> Read:
    data = yaml.safe_load(text)
    assert data.keys() == {"parameters", "transformation"}
    given = data["parameters"]
    numbers = data["transformation"]
    # The keyword arguments of its reader.
    names = {
        "namespace",
        "move_group_namespace",
        "move_group",
        "eye_on_hand",
        "robot_base_frame",
    }
    names |= {"robot_effector_frame", "tracking_base_frame", "tracking_marker_frame"}
    assert given.keys() <= names
    assert given["namespace"] == "/evercal/"
    parent = given[
        "robot_effector_frame" if given["eye_on_hand"] else "robot_base_frame"
    ]
    rotation = (numbers.pop(f"q{axis}") for axis in "xyzw")
    matrix = quaternion_matrix(
        *rotation, translation=[numbers.pop(axis) for axis in "xyz"]
    )
    assert not numbers
    return matrix, parent, given["tracking_base_frame"]


def urdf(text: str) -> Read:
    joint = ElementTree.fromstring(text)
    parent, child = (str(joint.find(end).get("link")) for end in ("parent", "child"))  # type: ignore[union-attr]
    robot = (
        f'<robot name="r"><link name="{parent}"/><link name="{child}"/>{text}</robot>'
    )
    model = yourdfpy.URDF.load(io.BytesIO(robot.encode()))
    return model.get_transform(child, parent), parent, child


def read_opencv(text: str) -> dict[str, Any]:
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    keys = storage.root().keys()
    nodes = {key: storage.getNode(key) for key in keys}
    return {key: n.mat() if n.isMap() else n.real() for key, n in nodes.items()}


def opencv(text: str) -> Read:
    values = read_opencv(text)
    camera_from_parent = np.eye(4)
    camera_from_parent[:3, :3] = cv2.Rodrigues(values["rvec"])[0]
    camera_from_parent[:3, 3:] = values["tvec"]
    return np.linalg.inv(camera_from_parent), "", ""


def plain(matrix: Array, per_metre: float = 1.0) -> Read:
    return np.r_[matrix[:3] / [1, 1, 1, per_metre], matrix[3:]], "", ""


def zivid(text: str) -> Read:
    record = yaml.safe_load(text)
    assert record.keys() == {"__version__", "FloatMatrix"}
    assert record["__version__"] == {"serializer": 1, "data": 1}
    return plain(np.array(record["FloatMatrix"]["Data"]), 1000)


def of_rotation(
    rotation: Rotation, position: list[float], per_metre: float = 1000
) -> Read:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.as_matrix()
    matrix[:3, 3] = position
    return plain(matrix, per_metre)


def line_of(text: str) -> str:
    comment, *lines = text.splitlines()
    assert re.match("[#;!] pose of cam/optical-frame in ", comment)
    return "\n".join(lines)


def ur(text: str) -> Read:
    line = line_of(text)
    assert re.fullmatch(rf"p\[{NUMBER}(, {NUMBER}){{5}}\]", line)
    numbers = [float(word) for word in re.findall(NUMBER, line)]
    return of_rotation(Rotation.from_rotvec(numbers[3:]), numbers[:3], 1)


def abb(text: str) -> Read:
    position, quaternion = json.loads(line_of(text))
    return of_rotation(Rotation.from_quat(quaternion, scalar_first=True), position)


def euler(
    pattern: str, axes: str, order: tuple[int, int, int]
) -> Callable[[str], Read]:
    """Three lengths and three angles; upper case axes turn with the body."""

    def read(text: str) -> Read:
        match = re.fullmatch(pattern.replace("_", f"({NUMBER})"), line_of(text))
        assert match is not None
        numbers = [float(word) for word in match.groups()]
        angles = [numbers[i] for i in order]
        return of_rotation(Rotation.from_euler(axes, angles, degrees=True), numbers[:3])

    return read


READERS: dict[str, Callable[[str], Read]] = {
    "static_transform_publisher": shell,
    "launch_py": launch_py,
    "ros1_launch": ros1_launch,
    "transform_stamped": stamped,
    "easy_handeye2": easy_handeye2,
    "easy_handeye": easy_handeye,
    "urdf": urdf,
    "opencv": opencv,
    "csv": lambda text: plain(np.loadtxt(io.StringIO(text), delimiter=",")),
    "json": lambda text: plain(np.array(json.loads(text)["matrix"])),
    "zivid": zivid,
    "franka": lambda text: plain(np.reshape(json.loads(text), (4, 4), order="F")),
    "ur": ur,
    "abb": abb,
    "kuka": euler(r"{X _, Y _, Z _, A _, B _, C _}", "ZYX", (3, 4, 5)),
    "fanuc": euler("X Y Z W P R\n_ _ _ _ _ _", "ZYX", (5, 4, 3)),
    "yaskawa": euler("X Y Z Rx Ry Rz\n_ _ _ _ _ _", "ZYX", (5, 4, 3)),
    "staubli": euler("X Y Z RX RY RZ\n_ _ _ _ _ _", "XYZ", (3, 4, 5)),
}


def test_every_format_of_one_pose_has_a_reader() -> None:
    others = {"npy", "camera_info", "moveit_samples", "tum", "colmap", "nerfstudio"}
    others |= {"joint_offsets", "corrected_urdf", "lerobot"}
    others |= {"mujoco", "isaac", "sapien", "pybullet", "blender"}  # test_simulators.py
    assert FORMATS.keys() == READERS.keys() | others


@pytest.mark.parametrize("name", READERS)
@given(poses(), st.sampled_from(["eye_to_hand", "eye_in_hand"]))
@settings(max_examples=8)
def test_the_pose_and_its_frames_are_read_back(
    name: str, pose: SE3, mount: MountName
) -> None:
    matrix, parent, child = READERS[name](calibration_of(pose, mount).export(name))
    assert (parent, child) in (("", ""), (parent_of(mount), CHILD))
    # Controllers' files have nine decimals; at gimbal lock scipy's angles are off by 2e-7 rad.
    rotation = pose.rotation_matrix()
    tolerance = (
        3e-7 if np.isclose(np.abs(rotation), 1, rtol=0, atol=1e-9).any() else 4e-9
    )
    assert_allclose(matrix[:3, :3], rotation, atol=tolerance)
    assert_allclose(matrix[:3, 3], pose.translation_m, atol=2e-9)
    assert_allclose(matrix[3], [0, 0, 0, 1])


def test_opencv_projects_with_its_intrinsics() -> None:
    values = read_opencv(calibration_of(POSE).export("opencv"))
    points = POSE.apply([[0.1, 0.2, 1.0], [-0.3, 0.1, 2.0], [0.0, 0.0, 0.5]])
    keys = ("rvec", "tvec", "camera_matrix", "distortion_coefficients")
    rvec, tvec, matrix, distortion = (np.asarray(values[key]) for key in keys)
    projected = cv2.projectPoints(points, rvec, tvec, matrix, distortion)[0]
    expected = CAMERA.project(POSE.inverse().apply(points))
    assert_allclose(projected[:, 0], expected, atol=1e-6)
    assert (values["image_width"], values["image_height"]) == (640, 480)
    without = calibration_of(POSE, camera=None).export("opencv")
    assert read_opencv(without).keys() == {"rvec", "tvec"}


def test_files_of_matrices_are_poses_of_robots(tmp_path: Path) -> None:
    for name in ("json", "npy"):
        calibration_of(POSE).export(name, tmp_path / f"pose.{name}")
        (read,) = read_robot_poses(tmp_path / f"pose.{name}").poses
        assert max(pose_distance(read, POSE)) < 1e-12
    record = json.loads((tmp_path / "pose.json").read_text())
    assert (record["parent_frame"], record["child_frame"]) == ("base_link", CHILD)


def test_easy_handeye2_has_the_name_of_its_file_and_the_other_frame(
    tmp_path: Path,
) -> None:
    calibration = calibration_of(SE3.identity())
    text = calibration.export(
        "easy_handeye2", tmp_path / "cell.calib", robot_frame="flange"
    )
    parameters = yaml.safe_load(text)["parameters"]
    assert (parameters["name"], parameters["robot_effector_frame"]) == (
        "cell",
        "flange",
    )


@pytest.mark.parametrize("count", [0, 4, 5, 8])
def test_camera_info(tmp_path: Path, count: int) -> None:
    distortion = tuple(np.arange(1, count + 1) / 10)
    camera = Camera(640, 480, 600.25, 601.5, 319.75, 240.5, distortion)
    calibration = calibration_of(SE3.identity(), camera=camera)
    info = yaml.safe_load(calibration.export("camera_info", tmp_path / "info.yaml"))
    model = "rational_polynomial" if count == 8 else "plumb_bob"
    assert info["distortion_model"] == model
    assert len(info["distortion_coefficients"]["data"]) == max(5, count)
    assert info["projection_matrix"]["data"][3::4] == [0.0, 0.0, 0.0]
    assert info["rectification_matrix"]["data"] == np.eye(3).ravel().tolist()
    for key in ("camera_matrix", "projection_matrix", "distortion_coefficients"):
        assert info[key]["rows"] * info[key]["cols"] == len(info[key]["data"])
    read = read_camera(tmp_path / "info.yaml")
    assert_array_equal(read.matrix(), camera.matrix())
    assert (read.width, read.height) == (640, 480)
    assert np.trim_zeros(read.distortion, "b") == distortion


@pytest.mark.parametrize(
    "name", ["/camera", "my camera", "a\nb", "a/", "a//b", '"', "-x", "<"]
)
def test_invalid_frame_names_are_refused(name: str) -> None:
    with pytest.raises(InputError, match="is no name of a tf frame"):
        calibration_of(SE3.identity()).export("urdf", child=name)


@pytest.mark.parametrize("name", ["robot1/camera_link", "0", "a.b-c"])
def test_valid_frame_names_are_written(name: str) -> None:
    text = calibration_of(SE3.identity()).export("transform_stamped", child=name)
    assert stamped(text)[2] == name


def test_names_of_formats_are_those_of_the_table() -> None:
    assert get_args(ExportFormat) == tuple(FORMATS)
