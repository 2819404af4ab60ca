"""OpenCV, numpy and json read what was written for them; OpenCV projects as the camera does."""

import io
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings

from evercal.calibration.export import plain
from evercal.calibration.export.request import Export
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.recordings.poses.robot_poses import read_robot_poses

from .drawn import CAMERA, made, poses

few = settings(deadline=None, max_examples=40)


def opencv_reads(text: str) -> dict[str, np.ndarray | float]:
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    keys = storage.root().keys()
    nodes = {key: storage.getNode(key) for key in keys}
    return {key: n.mat() if n.isMap() else n.real() for key, n in nodes.items()}


@given(poses())
@few
def test_rvec_and_tvec_are_those_of_opencv(pose: SE3) -> None:
    read = opencv_reads(plain.opencv(Export(made(pose))))
    camera_from_base = np.eye(4)
    camera_from_base[:3, :3] = cv2.Rodrigues(np.asarray(read["rvec"]))[0]
    camera_from_base[:3, 3:] = read["tvec"]
    np.testing.assert_allclose(camera_from_base @ pose.matrix(), np.eye(4), atol=1e-9)
    points = pose.apply([[0.1, 0.2, 1.0], [-0.3, 0.1, 2.0], [0.0, 0.0, 0.5]])
    projected = cv2.projectPoints(
        points,
        np.asarray(read["rvec"]),
        np.asarray(read["tvec"]),
        np.asarray(read["camera_matrix"]),
        np.asarray(read["distortion_coefficients"]),
    )[0]
    expected = CAMERA.project(pose.inverse().apply(points))
    np.testing.assert_allclose(projected[:, 0], expected, atol=1e-6)
    assert (read["image_width"], read["image_height"]) == (640, 480)


def test_opencv_without_intrinsics_and_not_for_another_frame() -> None:
    export = Export(made(SE3.identity(), camera=None))
    assert opencv_reads(plain.opencv(export)).keys() == {"rvec", "tvec"}
    with pytest.raises(InputError, match="leave --via out"):
        plain.opencv(Export(made(SE3.identity()), optical=False))


@given(poses())
@few
def test_matrices(tmp_path_factory: pytest.TempPathFactory, pose: SE3) -> None:
    export = Export(made(pose))
    matrix = np.loadtxt(io.StringIO(plain.csv(export)), delimiter=",")
    np.testing.assert_allclose(matrix, pose.matrix(), atol=1e-15)
    np.testing.assert_array_equal(np.load(io.BytesIO(plain.npy(export))), pose.matrix())
    record = json.loads(plain.as_json(export))
    np.testing.assert_array_equal(record["matrix"], pose.matrix())
    assert (record["parent_frame"], record["child_frame"]) == ("base_link", "cam/optical-frame")
    # What is exported can be given as a robot's pose.
    folder = tmp_path_factory.getbasetemp()
    (folder / "pose.json").write_text(plain.as_json(export))
    (folder / "pose.npy").write_bytes(plain.npy(export))
    for name in ("pose.json", "pose.npy"):
        found = read_robot_poses(Path(folder / name)).poses[0]
        assert np.max(pose_distance(found, pose)) < 1e-12
