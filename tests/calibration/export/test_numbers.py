"""Formats of one pose as numbers, read by OpenCV, numpy and textbook rotations."""

import io
import json
import re
from math import cos, radians, sin
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from numpy.typing import NDArray

from evercal.geometry import SE3, pose_distance
from evercal.recordings.poses.robot_poses import read_robot_poses

from .random_poses import CAMERA, calibration_of, poses, quaternion_matrix

few = settings(max_examples=8)
NUMBER = r"-?\d+\.\d+"


def read_opencv(text: str) -> dict[str, np.ndarray | float]:
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    keys = storage.root().keys()
    nodes = {key: storage.getNode(key) for key in keys}
    return {key: n.mat() if n.isMap() else n.real() for key, n in nodes.items()}


@given(poses())
@few
def test_opencv_projects_with_rvec_and_tvec(pose: SE3) -> None:
    values = read_opencv(calibration_of(pose).export("opencv"))
    keys = ("rvec", "tvec", "camera_matrix", "distortion_coefficients")
    points = pose.apply([[0.1, 0.2, 1.0], [-0.3, 0.1, 2.0], [0.0, 0.0, 0.5]])
    rvec, tvec, matrix, distortion = (np.asarray(values[key]) for key in keys)
    projected = cv2.projectPoints(points, rvec, tvec, matrix, distortion)[0]
    expected = CAMERA.project(pose.inverse().apply(points))
    np.testing.assert_allclose(projected[:, 0], expected, atol=1e-6)
    assert (values["image_width"], values["image_height"]) == (640, 480)


def test_opencv_without_intrinsics_holds_the_pose_only() -> None:
    text = calibration_of(SE3.identity(), camera=None).export("opencv")
    assert read_opencv(text).keys() == {"rvec", "tvec"}


@given(poses())
@few
def test_matrices_are_read_back(tmp_path_factory: pytest.TempPathFactory, pose: SE3) -> None:
    calibration, folder = calibration_of(pose), tmp_path_factory.getbasetemp()
    matrix = np.loadtxt(io.StringIO(calibration.export("csv")), delimiter=",")
    np.testing.assert_allclose(matrix, pose.matrix(), atol=1e-15)
    calibration.export("npy", folder / "pose.npy")
    np.testing.assert_array_equal(np.load(folder / "pose.npy"), pose.matrix())
    record = json.loads(calibration.export("json", folder / "pose.json"))
    np.testing.assert_array_equal(record["matrix"], pose.matrix())
    assert (record["parent_frame"], record["child_frame"]) == ("base_link", "cam/optical-frame")
    for name in ("pose.json", "pose.npy"):
        robot_pose = read_robot_poses(Path(folder / name)).poses[0]
        assert np.max(pose_distance(robot_pose, pose)) < 1e-12


@given(poses())
@few
def test_zivid_is_in_millimetres(pose: SE3) -> None:
    record = yaml.safe_load(calibration_of(pose).export("zivid"))
    assert record.keys() == {"__version__", "FloatMatrix"}
    assert record["__version__"] == {"serializer": 1, "data": 1}
    matrix = np.array(record["FloatMatrix"]["Data"])
    matrix[:3, 3] /= 1000
    np.testing.assert_allclose(matrix, pose.matrix(), atol=1e-12)


@given(poses())
@few
def test_franka_is_written_by_column(pose: SE3) -> None:
    numbers = json.loads(calibration_of(pose).export("franka"))
    np.testing.assert_allclose(np.reshape(numbers, (4, 4), order="F"), pose.matrix(), atol=1e-12)


def rotation_about(axis: str, degrees: float) -> NDArray[np.float64]:
    c, s = cos(radians(degrees)), sin(radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


def check(rotation: NDArray[np.float64], position_m: list[float], pose: SE3) -> None:
    """Compare to the nine decimals of the text; at gimbal lock, to scipy's 2e-7 rad."""
    np.testing.assert_allclose(position_m, pose.translation_m, atol=2e-9)
    expected = pose.rotation_matrix()
    locked = np.isclose(np.abs(expected), 1, rtol=0, atol=1e-9).any()
    np.testing.assert_allclose(rotation, expected, atol=3e-7 if locked else 4e-9)


@given(poses())
@few
def test_ur(pose: SE3) -> None:
    comment, line = calibration_of(pose).export("ur").splitlines()
    assert comment.startswith("# pose of cam/optical-frame in base_link")
    assert re.fullmatch(rf"p\[{NUMBER}(, {NUMBER}){{5}}\]", line)
    numbers = [float(word) for word in re.findall(NUMBER, line)]
    check(np.asarray(cv2.Rodrigues(np.array(numbers[3:]))[0], dtype=np.float64), numbers[:3], pose)


@given(poses())
@few
def test_abb(pose: SE3) -> None:
    _, line = calibration_of(pose).export("abb").splitlines()
    position, (q1, q2, q3, q4) = json.loads(line)
    rotation = quaternion_matrix(q2, q3, q4, q1, (0, 0, 0))[:3, :3]
    check(rotation, [value / 1000 for value in position], pose)


@pytest.mark.parametrize(
    ("name", "keys", "order"),
    [
        ("kuka", "X Y Z A B C", (("z", 3), ("y", 4), ("x", 5))),
        ("fanuc", "X Y Z W P R", (("z", 5), ("y", 4), ("x", 3))),
        ("yaskawa", "X Y Z Rx Ry Rz", (("z", 5), ("y", 4), ("x", 3))),
        ("staubli", "X Y Z RX RY RZ", (("x", 3), ("y", 4), ("z", 5))),
    ],
)
@given(pose=poses())
@few
def test_euler_angles(name: str, keys: str, order: tuple[tuple[str, int], ...], pose: SE3) -> None:
    _, *lines = calibration_of(pose).export(name).splitlines()
    if name == "kuka":
        pairs = [pair.split() for pair in lines[0].strip("{}").split(", ")]
        lines = [" ".join(column) for column in zip(*pairs, strict=True)]
    assert lines[0] == keys
    numbers = [float(word) for word in lines[1].split()]
    rotation = np.linalg.multi_dot([rotation_about(axis, numbers[i]) for axis, i in order])
    check(rotation, [value / 1000 for value in numbers[:3]], pose)
