"""pycolmap, nerfstudio's rays and TUM lines see what the calibration says, pixel by pixel."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings

from evercal.calibration.export import camera_views
from evercal.calibration.export.formats import write_content
from evercal.calibration.export.request import Export
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_distance
from evercal.recordings.poses.robot_poses import RobotPoses, read_robot_poses

from .drawn import CAMERA, arm, made, poses, quaternion_matrix

few = settings(deadline=None, max_examples=20)
LENSES = [(), (0.1, -0.2, 0.001, 0.002), CAMERA.distortion]
RATIONAL = (0.1, -0.2, 0.001, 0.002, 0.03, 0.01, 0.02, 0.03)


def on_the_arm(names: tuple[str, ...] | None = None, stamps: Any = None) -> Export:
    calibration = made(SE3.exp([0.05, -0.03, 0.1, 0.1, 0.2, 1.5]), "eye_in_hand")
    return Export(calibration, robot_poses=RobotPoses(names, stamps, arm()))


def colmap_reads(folder: Path, export: Export) -> Any:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap reads COLMAP's files")
    write_content(folder, camera_views.colmap(export))
    read = pycolmap.Reconstruction()
    read.read_text(str(folder))
    return read


@pytest.mark.parametrize("lens", [*LENSES, RATIONAL])
def test_colmap_projects_alike(tmp_path: Path, lens: tuple[float, ...]) -> None:
    camera = Camera(640, 480, 600.25, 601.5, 319.75, 240.5, lens)
    pose = SE3.exp([0.9, -0.1, 0.5, -1.5, 0.6, 0.4])
    read = colmap_reads(tmp_path / "model", Export(made(pose, camera=camera)))
    assert sorted(image.name for image in read.images.values()) == ["a.png", "c.png"]
    points = pose.apply(np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 4], (20, 3)))
    for image in read.images.values():
        camera_from_base = image.cam_from_world()
        seen = camera_from_base * points
        pixels = read.cameras[image.camera_id].img_from_cam(seen)
        expected = camera.project(pose.inverse().apply(points))
        # COLMAP's pixels count from the corner of the first one.
        np.testing.assert_allclose(pixels - 0.5, expected, atol=1e-6)
        np.testing.assert_allclose(
            camera_from_base.matrix() @ pose.matrix(), np.eye(4)[:3], atol=1e-9
        )


def test_colmap_of_a_camera_on_the_arm(tmp_path: Path) -> None:
    names = ("v/5.png", "v/1.png", "v/3.png", "v/2.png", "v/4.png")
    export = on_the_arm(names)
    read = colmap_reads(tmp_path / "model", export)
    assert len(read.images) == 5
    for image in read.images.values():
        base_from_gripper = arm()[names.index(image.name)].matrix()
        found = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        expected = np.linalg.inv(base_from_gripper @ export.pose.matrix())
        np.testing.assert_allclose(found, expected, atol=1e-9)


def test_colmap_does_not_overwrite_a_model(tmp_path: Path) -> None:
    write_content(tmp_path, camera_views.colmap(Export(made(SE3.identity()))))
    (tmp_path / "cameras.txt").unlink()
    with pytest.raises(InputError, match="already there; give a new folder"):
        write_content(tmp_path, camera_views.colmap(Export(made(SE3.identity()))))
    assert not (tmp_path / "cameras.txt").exists()


def test_colmap_has_no_word_for_blanks() -> None:
    with pytest.raises(InputError, match=r"'1 \.png' has a blank in it"):
        camera_views.colmap(on_the_arm(("1 .png", "2", "3", "4", "5")))


def nerfstudio_rays(meta: dict[str, Any], frame: dict[str, Any], pixels: Any) -> np.ndarray:
    """Directions in the world as its Cameras makes them: half a pixel added, -z forward."""
    u, v = np.moveaxis(np.asarray(pixels) + 0.5, -1, 0)
    x, y = (u - meta["cx"]) / meta["fl_x"], -(v - meta["cy"]) / meta["fl_y"]
    ray = np.stack([x, y, -np.ones_like(x)], axis=-1)
    return ray @ np.array(frame["transform_matrix"])[:3, :3].T


@given(poses())
@few
def test_nerfstudio_rays_go_where_the_camera_looks(pose: SE3) -> None:
    camera = Camera(640, 480, 600.25, 601.5, 319.75, 240.5)
    meta = json.loads(camera_views.nerfstudio(Export(made(pose, camera=camera))))
    assert [frame["file_path"] for frame in meta["frames"]] == ["a.png", "c.png"]
    pixels = np.random.default_rng(0).uniform(0, 480, (10, 2))
    expected = camera.unproject(pixels) @ pose.rotation_matrix().T
    for frame in meta["frames"]:
        np.testing.assert_allclose(nerfstudio_rays(meta, frame, pixels), expected, atol=1e-9)
        matrix = np.array(frame["transform_matrix"])
        np.testing.assert_allclose(matrix[:3, 3], pose.translation_m, atol=1e-12)
        np.testing.assert_array_equal(matrix[3], [0, 0, 0, 1])
    assert (meta["w"], meta["h"], meta["camera_model"]) == (640, 480, "OPENCV")


@pytest.mark.parametrize("lens", LENSES)
def test_nerfstudio_lens_is_its_polynomial(lens: tuple[float, ...]) -> None:
    camera = Camera(640, 480, 600.25, 601.5, 319.75, 240.5, lens)
    meta = json.loads(camera_views.nerfstudio(Export(made(SE3.identity(), camera=camera))))
    points = np.random.default_rng(0).uniform([-0.5, -0.4, 1], [0.5, 0.4, 1], (10, 3))
    x, y = points[:, 0], points[:, 1]
    r2 = x * x + y * y
    k1, k2, k3, k4, p1, p2 = (meta[key] for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    u = meta["fl_x"] * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + meta["cx"]
    v = meta["fl_y"] * (y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)) + meta["cy"]
    np.testing.assert_allclose(np.stack([u, v], -1) - 0.5, camera.project(points), atol=1e-9)


def test_nerfstudio_has_no_rational_lens() -> None:
    camera = Camera(640, 480, 600, 600, 320, 240, RATIONAL)
    with pytest.raises(InputError, match="no terms for k4 k5 k6"):
        camera_views.nerfstudio(Export(made(SE3.identity(), camera=camera)))


@given(poses())
@few
def test_tum_of_a_fixed_camera_is_one_line(pose: SE3) -> None:
    line = np.loadtxt(io.StringIO(camera_views.tum(Export(made(pose)))))
    assert line.shape == (8,)
    np.testing.assert_allclose(
        quaternion_matrix(*line[4:], translation=line[1:4]), pose.matrix(), atol=1e-9
    )


def test_tum_of_a_camera_on_the_arm(tmp_path: Path) -> None:
    stamps = 1.7e9 + np.arange(5) / 10
    export = on_the_arm(None, stamps)
    (tmp_path / "a.tum").write_text(camera_views.tum(export))
    lines = np.loadtxt(tmp_path / "a.tum")
    np.testing.assert_array_equal(lines[:, 0], stamps)
    expected = arm().matrix() @ export.pose.matrix()
    for line, matrix in zip(lines, expected, strict=True):
        found = quaternion_matrix(*line[4:], translation=line[1:4])
        np.testing.assert_allclose(found, matrix, atol=1e-9)
    read = read_robot_poses(tmp_path / "a.tum")
    assert np.max(pose_distance(read.poses, arm() @ export.pose)) < 1e-12


@pytest.mark.parametrize("form", ["tum", "colmap", "nerfstudio"])
def test_what_is_missing_is_said(form: str) -> None:
    write = getattr(camera_views, form)
    with pytest.raises(InputError, match=f"{form}: .* give the gripper's poses with --robot-poses"):
        write(Export(made(SE3.identity(), "eye_in_hand")))
    with pytest.raises(InputError, match=f"{form} holds the pose of the camera itself"):
        write(Export(made(SE3.identity()), optical=False))
    if form != "tum":
        with pytest.raises(InputError, match=f"{form} needs intrinsics"):
            write(Export(made(SE3.identity(), camera=None)))


def test_without_images_the_camera_gives_the_name() -> None:
    calibration = made(SE3.identity())
    bare = type(calibration)(
        "eye_to_hand", calibration.parent_from_child, calibration.covariance, camera=CAMERA
    )
    meta = json.loads(camera_views.nerfstudio(Export(bare)))
    assert [frame["file_path"] for frame in meta["frames"]] == ["camera.png"]
