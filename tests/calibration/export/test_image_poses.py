"""Formats of a pose per image, compared with pycolmap, nerfstudio's rays and TUM lines."""

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose, assert_array_equal

from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_distance
from evercal.recordings.poses.robot_poses import RobotPoses, read_robot_poses
from evercal.robot.frame_names import FrameNames

from .random_poses import CAMERA, POSE, calibration_of, quaternion_matrix, random_poses

DISTORTIONS = [(), (0.1, -0.2, 0.001, 0.002), CAMERA.distortion]
RATIONAL = (0.1, -0.2, 0.001, 0.002, 0.03, 0.01, 0.02, 0.03)
ON_ARM = calibration_of(SE3.exp([0.05, -0.03, 0.1, 0.1, 0.2, 1.5]), "eye_in_hand")


def camera_with(distortion: tuple[float, ...]) -> Camera:
    return replace(CAMERA, distortion=distortion)


def read_colmap(folder: Path) -> Any:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap reads COLMAP's files")
    model = pycolmap.Reconstruction()
    model.read_text(str(folder))
    return model


@pytest.mark.parametrize("distortion", [*DISTORTIONS, RATIONAL])
def test_colmap_projects_like_the_camera(
    tmp_path: Path, distortion: tuple[float, ...]
) -> None:
    camera = camera_with(distortion)
    calibration_of(POSE, camera=camera).export("colmap", tmp_path / "model")
    model = read_colmap(tmp_path / "model")
    assert sorted(image.name for image in model.images.values()) == ["a.png", "c.png"]
    points = POSE.apply(
        np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 4], (20, 3))
    )
    for image in model.images.values():
        camera_from_base = image.cam_from_world()
        pixels = model.cameras[image.camera_id].img_from_cam(camera_from_base * points)
        # COLMAP's pixel coordinates start at the corner of the first pixel.
        expected = camera.project(POSE.inverse().apply(points))
        assert_allclose(pixels - 0.5, expected, atol=1e-6)
        assert_allclose(
            camera_from_base.matrix() @ POSE.matrix(), np.eye(4)[:3], atol=1e-9
        )


def test_colmap_of_a_camera_on_the_arm(tmp_path: Path) -> None:
    names = ("v/5.png", "v/1.png", "v/3.png", "v/2.png", "v/4.png")
    robot = RobotPoses(names, None, random_poses())
    ON_ARM.export("colmap", tmp_path / "model", robot_poses=robot)
    model = read_colmap(tmp_path / "model")
    assert len(model.images) == 5
    for image in model.images.values():
        base_from_gripper = random_poses()[names.index(image.name)].matrix()
        expected = np.linalg.inv(base_from_gripper @ ON_ARM.parent_from_child.matrix())
        assert_allclose(image.cam_from_world().matrix(), expected[:3], atol=1e-9)


def test_colmap_does_not_overwrite_a_model(tmp_path: Path) -> None:
    calibration = calibration_of(SE3.identity())
    calibration.export("colmap", tmp_path)
    (tmp_path / "cameras.txt").unlink()
    with pytest.raises(InputError, match="already there; give a new folder"):
        calibration.export("colmap", tmp_path)
    assert not (tmp_path / "cameras.txt").exists()


def test_colmap_refuses_blanks_in_names(tmp_path: Path) -> None:
    robot = RobotPoses(("1 .png", "2", "3", "4", "5"), None, random_poses())
    with pytest.raises(InputError, match=r"'1 \.png' contains a blank"):
        ON_ARM.export("colmap", tmp_path, robot_poses=robot)


def test_nerfstudio_rays_match_the_camera() -> None:
    camera = camera_with(())
    meta = json.loads(calibration_of(POSE, camera=camera).export("nerfstudio"))
    assert [frame["file_path"] for frame in meta["frames"]] == ["a.png", "c.png"]
    assert (meta["w"], meta["h"], meta["camera_model"]) == (640, 480, "OPENCV")
    pixels = np.random.default_rng(0).uniform(0, 480, (10, 2))
    # nerfstudio adds half a pixel, and its cameras look along -z.
    u, v = np.moveaxis(pixels + 0.5, -1, 0)
    x = (u - meta["cx"]) / meta["fl_x"]
    y = -(v - meta["cy"]) / meta["fl_y"]
    rays = np.stack([x, y, -np.ones_like(x)], axis=-1)
    for frame in meta["frames"]:
        matrix = np.array(frame["transform_matrix"])
        world = camera.unproject(pixels) @ POSE.rotation_matrix().T
        assert_allclose(rays @ matrix[:3, :3].T, world, atol=1e-9)
        assert_allclose(matrix[:, 3], [*POSE.translation_m, 1], atol=1e-12)


@pytest.mark.parametrize("distortion", DISTORTIONS)
def test_nerfstudio_distortion_is_its_polynomial(distortion: tuple[float, ...]) -> None:
    camera = camera_with(distortion)
    calibration = calibration_of(SE3.identity(), camera=camera)
    meta = json.loads(calibration.export("nerfstudio"))
    points = np.random.default_rng(0).uniform([-0.5, -0.4, 1], [0.5, 0.4, 1], (10, 3))
    x = points[:, 0]
    y = points[:, 1]
    r2 = x * x + y * y
    k1, k2, k3, k4, p1, p2 = (meta[key] for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    u = (
        meta["fl_x"] * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x))
        + meta["cx"]
    )
    v = (
        meta["fl_y"] * (y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y))
        + meta["cy"]
    )
    assert_allclose(np.stack([u, v], -1) - 0.5, camera.project(points), atol=1e-9)


def test_nerfstudio_refuses_rational_distortion() -> None:
    calibration = calibration_of(SE3.identity(), camera=camera_with(RATIONAL))
    with pytest.raises(InputError, match="nerfstudio: there are no terms for k4 k5 k6"):
        calibration.export("nerfstudio")


def test_tum_of_a_fixed_camera_is_one_line() -> None:
    line = np.loadtxt(io.StringIO(calibration_of(POSE).export("tum")))
    matrix = quaternion_matrix(*line[4:], translation=line[1:4])
    assert_allclose(matrix, POSE.matrix(), atol=1e-9)


def test_tum_of_a_camera_on_the_arm(tmp_path: Path) -> None:
    stamps = 1.7e9 + np.arange(5) / 10
    robot = RobotPoses(None, stamps, random_poses())
    ON_ARM.export("tum", tmp_path / "a.tum", robot_poses=robot)
    lines = np.loadtxt(tmp_path / "a.tum")
    assert_array_equal(lines[:, 0], stamps)
    expected = random_poses() @ ON_ARM.parent_from_child
    for line, matrix in zip(lines, expected.matrix(), strict=True):
        actual = quaternion_matrix(*line[4:], translation=line[1:4])
        assert_allclose(actual, matrix, atol=1e-9)
    assert (
        np.max(pose_distance(read_robot_poses(tmp_path / "a.tum").poses, expected))
        < 1e-12
    )


@pytest.mark.parametrize("name", ["tum", "colmap", "nerfstudio"])
def test_missing_inputs_are_refused(name: str) -> None:
    with pytest.raises(
        InputError, match=f"{name}: .* give the gripper's poses with `robot_poses`"
    ):
        ON_ARM.export(name)
    fixed = calibration_of(SE3.identity())
    with pytest.raises(InputError, match=f"{name} holds the pose of the camera"):
        fixed.export(name, via="camera_link", via_optical=True)
    if name != "tum":
        with pytest.raises(InputError, match=f"{name}: intrinsics are required"):
            replace(fixed, camera=None).export(name)


def test_without_images_the_frame_names_the_image() -> None:
    calibration = replace(
        calibration_of(SE3.identity()), images=(), frames=FrameNames()
    )
    meta = json.loads(calibration.export("nerfstudio"))
    assert [frame["file_path"] for frame in meta["frames"]] == ["camera.png"]


def moveit(
    robot: RobotPoses | None, target: RobotPoses | None
) -> list[dict[str, list[float]]]:
    text = ON_ARM.export("moveit_samples", robot_poses=robot, target_poses=target)
    return yaml.safe_load(text)


@pytest.mark.parametrize("named", [False, True])
def test_moveit_samples_are_pairs_of_matrices(named: bool) -> None:
    robot = random_poses(3, 1)
    target = random_poses(3, 2)
    first = None
    second = None
    order = [0, 1, 2]
    if named:
        first = ("a", "b", "c")
        second = ("c", "a", "b")
        order = [2, 0, 1]
    samples = moveit(
        RobotPoses(first, None, robot), RobotPoses(second, None, target[order])
    )
    assert len(samples) == 3
    for i, sample in enumerate(samples):
        assert sample.keys() == {"effector_wrt_world", "object_wrt_sensor"}
        assert all(type(value) is float for row in sample.values() for value in row)
        gripper = np.reshape(sample["effector_wrt_world"], (4, 4))
        board = np.reshape(sample["object_wrt_sensor"], (4, 4))
        assert_allclose(gripper, robot[i].matrix(), atol=1e-12)
        assert_allclose(board, target[i].matrix(), atol=1e-12)


@pytest.mark.parametrize(
    ("target", "message"),
    [
        (None, r"`robot_poses` and the board's poses .* `target_poses`"),
        (
            RobotPoses(("a", "b", "c"), None, random_poses(3)),
            "'c' has only one of its two poses",
        ),
        (RobotPoses(None, None, random_poses(3)), "2 robot poses and 3 target poses"),
    ],
)
def test_incomplete_moveit_pairs_are_refused(
    target: RobotPoses | None, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        moveit(RobotPoses(("a", "b"), None, random_poses(2)), target)
