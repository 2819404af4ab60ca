"""Poses for robot controllers, read with elementary rotations and OpenCV's Rodrigues formula."""

import json
import re
from math import cos, radians, sin

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from numpy.typing import NDArray

from evercal.calibration.export import robots
from evercal.calibration.export.request import Export
from evercal.geometry import SE3

from .drawn import made, poses, quaternion_matrix

few = settings(deadline=None, max_examples=60)
NUMBER = r"-?\d+\.\d+"


def turn(axis: str, degrees: float) -> NDArray[np.float64]:
    c, s = cos(radians(degrees)), sin(radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


def check(found: NDArray[np.float64], position: list[float], pose: SE3) -> None:
    """To the nine decimals of the text; at gimbal lock to scipy's 2e-7 rad."""
    np.testing.assert_allclose(position, pose.translation_m, atol=2e-9)
    rotation = pose.rotation_matrix()
    locked = np.isclose(np.abs(rotation), 1, rtol=0, atol=1e-9).any()
    np.testing.assert_allclose(found, rotation, atol=3e-7 if locked else 4e-9)


@given(poses())
@few
def test_ur(pose: SE3) -> None:
    comment, line = robots.ur(Export(made(pose))).splitlines()
    assert comment.startswith("# pose of cam/optical-frame in base_link")
    assert re.fullmatch(rf"p\[{NUMBER}(, {NUMBER}){{5}}\]", line)
    numbers = [float(word) for word in re.findall(NUMBER, line)]
    check(np.asarray(cv2.Rodrigues(np.array(numbers[3:]))[0], dtype=np.float64), numbers[:3], pose)


@given(poses())
@few
def test_kuka(pose: SE3) -> None:
    comment, line = robots.kuka(Export(made(pose))).splitlines()
    assert comment.startswith("; ")
    frame = {k: float(v) for k, v in (word.split() for word in line.strip("{}").split(", "))}
    assert [*frame] == [*"XYZABC"]
    found = turn("z", frame["A"]) @ turn("y", frame["B"]) @ turn("x", frame["C"])
    check(found, [frame[axis] / 1000 for axis in "XYZ"], pose)


@pytest.mark.parametrize(
    ("name", "keys", "order"),
    [
        ("fanuc", "X Y Z W P R", (("z", 5), ("y", 4), ("x", 3))),
        ("yaskawa", "X Y Z Rx Ry Rz", (("z", 5), ("y", 4), ("x", 3))),
        ("staubli", "X Y Z RX RY RZ", (("x", 3), ("y", 4), ("z", 5))),
    ],
)
@given(pose=poses())
@few
def test_lines_to_type_in(
    name: str, keys: str, order: tuple[tuple[str, int], ...], pose: SE3
) -> None:
    _, heading, line = getattr(robots, name)(Export(made(pose))).splitlines()
    assert heading == keys
    numbers = [float(word) for word in line.split()]
    found = np.linalg.multi_dot([turn(axis, numbers[column]) for axis, column in order])
    check(found, [value / 1000 for value in numbers[:3]], pose)


@given(poses())
@few
def test_abb(pose: SE3) -> None:
    _, line = robots.abb(Export(made(pose))).splitlines()
    position, (q1, q2, q3, q4) = json.loads(line)
    found = quaternion_matrix(q2, q3, q4, q1, (0, 0, 0))[:3, :3]
    check(found, [value / 1000 for value in position], pose)


@given(poses())
@few
def test_franka_is_column_after_column(pose: SE3) -> None:
    numbers = json.loads(robots.franka(Export(made(pose))))
    assert len(numbers) == 16
    np.testing.assert_allclose(numbers[12:15], pose.translation_m, atol=1e-12)
    np.testing.assert_allclose(np.reshape(numbers, (4, 4), order="F"), pose.matrix(), atol=1e-12)


@given(poses())
@few
def test_zivid_is_in_millimetres(pose: SE3) -> None:
    record = yaml.safe_load(robots.zivid(Export(made(pose))))
    assert record.keys() == {"__version__", "FloatMatrix"}
    assert record["__version__"] == {"serializer": 1, "data": 1}
    matrix = np.array(record["FloatMatrix"]["Data"])
    matrix[:3, 3] /= 1000
    np.testing.assert_allclose(matrix, pose.matrix(), atol=1e-12)
