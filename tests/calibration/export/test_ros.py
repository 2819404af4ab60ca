"""What ROS reads: flags of tf2_ros, launch files that run, fields of messages, URDF."""

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
from evercal.calibration.export import ros
from evercal.calibration.export.request import Export
from evercal.calibration.export.urdf import urdf
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.poses.camera_file import read_camera

from .drawn import CAMERA, made, poses, quaternion_matrix

mounts = st.sampled_from(["eye_to_hand", "eye_in_hand"])
drawn = given(poses(), mounts)
few = settings(deadline=None, max_examples=40)


def tf2_flags(words: list[str]) -> argparse.Namespace:
    """As static_transform_publisher takes them."""
    parser = argparse.ArgumentParser()
    for name in ("x", "y", "z", "qx", "qy", "qz", "qw"):
        parser.add_argument(f"--{name}", type=float, required=True)
    parser.add_argument("--frame-id", required=True)
    parser.add_argument("--child-frame-id", required=True)
    return parser.parse_args(words)


def check_flags(words: list[str], pose: SE3, parent: str) -> None:
    # argparse takes -1e-05 for an option, tf2 does not.
    parsed = tf2_flags([f"{a}={b}" for a, b in zip(words[::2], words[1::2], strict=True)])
    assert (parsed.frame_id, parsed.child_frame_id) == (parent, "cam/optical-frame")
    position = (parsed.x, parsed.y, parsed.z)
    matrix = quaternion_matrix(parsed.qx, parsed.qy, parsed.qz, parsed.qw, position)
    np.testing.assert_allclose(matrix, pose.matrix(), atol=1e-9)


def parent_of(mount: Mount) -> str:
    return "base_link" if mount == "eye_to_hand" else "tool0"


@drawn
@few
def test_shell_line(pose: SE3, mount: Mount) -> None:
    words = shlex.split(ros.static_transform_publisher(Export(made(pose, mount))))
    assert words[:4] == ["ros2", "run", "tf2_ros", "static_transform_publisher"]
    check_flags(words[4:], pose, parent_of(mount))


@drawn
@few
def test_launch_file_runs(pose: SE3, mount: Mount) -> None:
    launch, actions = types.ModuleType("launch"), types.ModuleType("launch_ros.actions")
    launch.LaunchDescription = list  # pyright: ignore[reportAttributeAccessIssue]
    actions.Node = dict  # pyright: ignore[reportAttributeAccessIssue]
    stand_ins = {"launch": launch, "launch_ros": types.ModuleType("launch_ros")}
    namespace: dict[str, Any] = {}
    with pytest.MonkeyPatch.context() as patch:
        for name, module in {**stand_ins, "launch_ros.actions": actions}.items():
            patch.setitem(sys.modules, name, module)
        exec(compile(ros.launch_py(Export(made(pose, mount))), "x.launch.py", "exec"), namespace)
        (node,) = namespace["generate_launch_description"]()
    assert node["package"] == "tf2_ros"
    assert node["executable"] == "static_transform_publisher"
    assert node["name"].isidentifier()
    check_flags(node["arguments"], pose, parent_of(mount))


@drawn
@few
def test_ros1_launch_file(pose: SE3, mount: Mount) -> None:
    node = ElementTree.fromstring(ros.ros1_launch(Export(made(pose, mount)))).find("node")
    assert node is not None
    assert (node.get("pkg"), node.get("type")) == ("tf2_ros", "static_transform_publisher")
    *words, parent, child = str(node.get("args")).split()
    assert (parent, child) == (parent_of(mount), "cam/optical-frame")
    x, y, z, *quaternion = map(float, words)
    matrix = quaternion_matrix(*quaternion, translation=(x, y, z))
    np.testing.assert_allclose(matrix, pose.matrix(), atol=1e-9)


@drawn
@few
def test_transform_stamped_has_the_fields_of_the_message(pose: SE3, mount: Mount) -> None:
    message = yaml.safe_load(ros.transform_stamped(Export(made(pose, mount))))
    assert message.keys() == {"header", "child_frame_id", "transform"}
    assert message["header"] == {
        "stamp": {"sec": 0, "nanosec": 0},
        "frame_id": parent_of(mount),
    }
    assert message["child_frame_id"] == "cam/optical-frame"
    translation, rotation = message["transform"]["translation"], message["transform"]["rotation"]
    assert all(type(v) is float for v in (*translation.values(), *rotation.values()))
    matrix = quaternion_matrix(**rotation, translation=[translation[axis] for axis in "xyz"])
    np.testing.assert_allclose(matrix, pose.matrix(), atol=1e-9)


@drawn
@few
def test_urdf_by_yourdfpy(pose: SE3, mount: Mount) -> None:
    parent = parent_of(mount)
    robot = f"""<robot name="r"><link name="{parent}"/><link name="cam/optical-frame"/>
        {urdf(Export(made(pose, mount)))}</robot>"""
    read = yourdfpy.URDF.load(io.BytesIO(robot.encode()))
    found = read.get_transform("cam/optical-frame", parent)
    # At gimbal lock scipy's angles are right to 2e-7 rad.
    np.testing.assert_allclose(found, pose.matrix(), atol=3e-7)
    if abs(abs(pose.rotation_matrix()[2, 0]) - 1) > 1e-9:
        np.testing.assert_allclose(found, pose.matrix(), atol=1e-9)


def test_urdf_angles_turn_about_fixed_axes() -> None:
    """Rz(0.5) Ry(0.4) Rx(0.3) is written 0.3 0.4 0.5."""
    half = np.array([0.3, 0.4, 0.5]) / 2
    (cx, cy, cz), (sx, sy, sz) = np.cos(half), np.sin(half)
    about = SE3(
        np.array([[cx, sx, 0, 0], [cy, 0, sy, 0], [cz, 0, 0, sz]]),
        np.zeros((3, 3)),
    )
    text = urdf(Export(made(about[2] @ about[1] @ about[0])))
    origin = ElementTree.fromstring(text).find("origin")
    assert origin is not None
    np.testing.assert_allclose([*map(float, str(origin.get("rpy")).split())], [0.3, 0.4, 0.5])


LENSES = [
    ((), "plumb_bob", 5),
    ((0.1, 0.2, 0.3, 0.4), "plumb_bob", 5),
    ((0.1, 0.2, 0.3, 0.4, 1e-7), "plumb_bob", 5),
    ((0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8), "rational_polynomial", 8),
]


@pytest.mark.parametrize(("lens", "model", "count"), LENSES)
def test_camera_info(tmp_path: Path, lens: tuple[float, ...], model: str, count: int) -> None:
    camera = Camera(640, 480, 600.25, 601.5, 319.75, 240.5, lens)
    text = ros.camera_info(Export(made(SE3.identity(), camera=camera)))
    info = yaml.safe_load(text)
    assert info["distortion_model"] == model
    assert len(info["distortion_coefficients"]["data"]) == count
    assert info["projection_matrix"]["data"][3::4] == [0.0, 0.0, 0.0]
    assert info["rectification_matrix"]["data"] == np.eye(3).ravel().tolist()
    for key in ("camera_matrix", "projection_matrix", "distortion_coefficients"):
        matrix = info[key]
        assert matrix["rows"] * matrix["cols"] == len(matrix["data"])
    (tmp_path / "info.yaml").write_text(text)
    read = read_camera(tmp_path / "info.yaml")
    np.testing.assert_array_equal(read.matrix(), camera.matrix())
    assert (read.width, read.height) == (640, 480)
    assert read.distortion[: len(lens)] == lens
    assert not any(read.distortion[len(lens) :])


def test_no_intrinsics_no_camera_info() -> None:
    with pytest.raises(InputError, match="holds no intrinsics"):
        ros.camera_info(Export(made(SE3.identity(), camera=None)))
    with pytest.raises(InputError, match="leave --via out"):
        ros.camera_info(Export(made(SE3.identity(), camera=CAMERA), optical=False))
