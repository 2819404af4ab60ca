"""Cameras of simulators, projected by the formulas of each program."""

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.testing import assert_allclose

from evercal.calibration.export.formats import export_files
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.cameras.camera_file import read_camera
from evercal.typing import Array

from .random_poses import POSE, calibration_of, quaternion_matrix

CAMERAS = (
    Camera(640, 480, 600.25, 601.5, 319.5, 239.5),
    Camera(640, 480, 526.5, 505.25, 331.5, 233.25),
    Camera(480, 640, 505.25, 526.5, 231.5, 333.25),
)
SEEN = np.array([[0.1, 0.2, 1.0], [-0.3, 0.1, 2.0], [0.0, 0.0, 0.5], [0.2, -0.1, 3.0]])
NUMBER = re.compile(r"-?\d+\.?\d*(?:e-?\d+)?")


def numbers(text: str) -> Array:
    return np.array([*map(float, NUMBER.findall(text))])


def pinhole(seen: Array, focal: Array, centre: Array) -> Array:
    """Pixels of points with y up and z backward; the corner of the image is the origin."""
    flat = seen[:, :2] / -seen[:, 2:]
    return np.c_[centre[0] + focal[0] * flat[:, 0], centre[1] - focal[1] * flat[:, 1]]


def mujoco(text: str, points: Array) -> Array:
    values = {
        k: v for k, v in ElementTree.fromstring(text).attrib.items() if k != "name"
    }
    read = {name: numbers(value) for name, value in values.items()}
    w, x, y, z = read["quat"]
    matrix = quaternion_matrix(x, y, z, w, translation=read["pos"])
    # The principal point is the way from it to the middle of the image.
    centre = read["resolution"] / 2 - read["principalpixel"]
    return pinhole(seen_by(matrix, points), read["focalpixel"], centre)


def isaac(text: str, points: Array) -> Array:
    read = {}
    for name, words in re.findall(r"float (\w+) = (\S+)", text):
        read[name] = float(words)
    block = text.partition("xformOp:transform = (")[2].partition("uniform")[0]
    matrix = numbers(block).reshape(4, 4).T  # USD's vectors are rows
    size = np.array(SIZES[-1])
    aperture = np.array([read["horizontalAperture"], read["verticalAperture"]])
    offset = np.array(
        [-read["horizontalApertureOffset"], read["verticalApertureOffset"]]
    )
    focal = read["focalLength"] / aperture * size
    return pinhole(seen_by(matrix, points), focal, size / 2 + offset / aperture * size)


def sapien(text: str, points: Array) -> Array:
    first = numbers(text.partition("sapien.Pose(")[2].splitlines()[0])
    w, x, y, z = first[3:]
    matrix = quaternion_matrix(x, y, z, w, translation=first[:3])
    words = text.partition("set_perspective_parameters(")[2].partition(")")[0]
    fx, fy, cx, cy = eval(f"[{words}]")[2:6]
    forward, left, up = seen_by(matrix, points).T  # x forward, y left, z up
    return np.c_[cx - fx * left / forward, cy - fy * up / forward]


def clipped(points: Array, to_clip: Array) -> Array:
    clip = np.c_[points, np.ones(len(points))] @ to_clip.T
    across, down = SIZES[-1]
    flat = clip[:, :2] / clip[:, 3:]
    return np.c_[(flat[:, 0] + 1) / 2 * across, (1 - flat[:, 1]) / 2 * down]


def pybullet(text: str, points: Array) -> Array:
    read: dict[str, Any] = {}
    exec(text, read)
    view = np.reshape(read["view_matrix"], (4, 4), order="F")
    projection = np.reshape(read["projection_matrix"], (4, 4), order="F")
    assert (read["width"], read["height"]) == SIZES[-1]
    near = projection[2, 3] / (projection[2, 2] - 1)
    assert (near, projection[3, 2]) == (pytest.approx(0.01), -1)
    return clipped(points, projection @ view)


def blender(text: str, points: Array) -> Array:
    compile(text, "script", "exec")
    read = dict(re.findall(r"(?:data|render)\.(\w+) = (.*)", text))
    matrix = numbers(text.partition("Matrix((")[2].partition("))")[0]).reshape(4, 4)
    across, down = SIZES[-1]
    lens, sensor, right, up = (
        eval(read[name]) for name in ("lens", "sensor_width", "shift_x", "shift_y")
    )
    ratio = eval(read["pixel_aspect_x"]) / eval(read["pixel_aspect_y"])
    fx = lens / sensor * across
    centre = np.array([across / 2 - right * across, down / 2 + up * across * ratio])
    return pinhole(seen_by(matrix, points), np.array([fx, fx * ratio]), centre)


def seen_by(matrix: Array, points: Array) -> Array:
    return SE3.from_matrix(matrix).inverse().apply(points)


READERS = {
    "mujoco": mujoco, "isaac": isaac, "sapien": sapien, "pybullet": pybullet,
    "blender": blender,
}  # fmt: skip
SIZES: list[tuple[int, int]] = []
"""Size of the images of the last file."""


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("camera", CAMERAS)
def test_points_are_drawn_where_the_camera_sees_them(name: str, camera: Camera) -> None:
    SIZES.append(camera.size)
    for mount in ("eye_to_hand", "eye_in_hand"):
        text = calibration_of(POSE, mount, camera).export(name)
        drawn = READERS[name](text, POSE.apply(SEEN)) - 0.5
        assert_allclose(drawn, camera.project(SEEN), atol=1e-6)


def test_what_a_simulator_cannot_hold_is_said() -> None:
    bent = Camera(640, 480, 600.0, 600.0, 319.5, 239.5, (0.1, 0.0, 0.0, 0.0))
    fisheye = Camera(640, 480, 300.0, 300.0, 319.5, 239.5, (0.0,) * 4, "fisheye")
    for name in READERS:
        (note,) = export_files(calibration_of(POSE, camera=bent), name).notes
        assert "without distortion; undistort" in note
        assert not export_files(
            calibration_of(POSE, camera=CAMERAS[0]), name
        ).notes or (name == "isaac")
        with pytest.raises(InputError, match=f"{name}: a simulator draws no fisheye"):
            calibration_of(POSE, camera=fisheye).export(name)
        with pytest.raises(InputError, match="holds no camera"):
            calibration_of(POSE, camera=None).export(name)
    (note,) = export_files(calibration_of(POSE, camera=CAMERAS[1]), "isaac").notes
    assert (
        "mean of fx 526.5 and fy 505.2, and the middle of the image (-12.0, 6.2 px"
        in note
    )


def test_a_camera_of_mujoco_is_a_camera_file(tmp_path: Path) -> None:
    file = tmp_path / "camera.xml"
    for camera in CAMERAS:
        calibration_of(POSE, camera=camera).export("mujoco", file)
        read = read_camera(file)
        assert read.size == camera.size
        assert_allclose(read.matrix(), camera.matrix(), rtol=1e-12)
