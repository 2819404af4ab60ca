"""Folders of images and camera poses, as other programs write them."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from evercal.geometry import SE3, Camera
from evercal.recordings import ReadOptions, load_recording
from evercal.recordings.formats import wrist

from ..checks import assert_pose, refused
from .test_wrist import LENS_TEXT, PLAIN, make_folder, some_poses, write_poses

CAMERA_POSES = some_poses(4, seed=5)
NUMBERS = [f"{i}.png" for i in range(4)]
GL = np.diag([1.0, -1.0, -1.0, 1.0])
BODY_FROM_CAMERA = some_poses(1, seed=6)[0]


def quaternions(poses: SE3) -> np.ndarray:
    """(n, 7) x y z qw qx qy qz."""
    return np.hstack([poses.translation_m, poses.rotation_wxyz])


def matrix_files(folder: Path, names: Sequence[str], poses: SE3) -> None:
    folder.mkdir(parents=True)
    for name, pose in zip(names, poses, strict=True):
        np.savetxt(folder / name, pose.matrix())


def without_camera(root: Path, names: Sequence[str], folder: str) -> None:
    """Images, and their intrinsics as text."""
    make_folder(root, names, None, folder)
    (root / "camera.json").unlink()
    (root / "camera.txt").write_text(LENS_TEXT)


def table(root: Path) -> None:
    without_camera(root, NUMBERS, "images")
    rows = quaternions(CAMERA_POSES)
    header = "x,y,z,qw,qx,qy,qz"
    np.savetxt(root / "base_from_camera.csv", rows, delimiter=",", header=header)


def tum(root: Path) -> None:
    """As https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats describes it."""
    stamps = 1305031102.1 + np.arange(4)
    without_camera(root, [f"{stamp:.6f}.png" for stamp in stamps], "rgb")
    rows = quaternions(CAMERA_POSES)[:, [0, 1, 2, 4, 5, 6, 3]]
    early = np.column_stack([stamps - 0.01, rows])
    late = np.column_stack([stamps + 0.01, rows])
    header = "ground truth trajectory\nfile: 'a.bag'\ntimestamp tx ty tz qx qy qz qw"
    lines = np.stack([early, late], axis=1).reshape(8, 8)
    np.savetxt(root / "groundtruth.txt", lines, ["%.4f", *["%.17g"] * 7], header=header)


def euroc(root: Path) -> None:
    """ASL's layout: poses of the body in nanoseconds, and the camera on it in sensor.yaml."""
    mav = root / "mav0"
    stamps = [1403636579763555584 + 50_000_000 * i for i in range(4)]
    make_folder(mav, [f"{stamp}.png" for stamp in stamps], None, "cam0/data")
    numbers = ", ".join(map(str, BODY_FROM_CAMERA.matrix().ravel()))
    (mav / "cam0" / "sensor.yaml").write_text(
        f"sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{numbers}]\nrate_hz: 20\n"
        "resolution: [32, 24]\ncamera_model: pinhole\nintrinsics: [30, 31, 15, 11]\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [0, 0, 0, 0]\n"
    )
    names = ["timestamp", *(f" p_RS_R_{a} [m]" for a in "xyz"), *(f" q_RS_{a} []" for a in "wxyz"),
             *(f" v_RS_R_{a} [m s^-1]" for a in "xyz"),
             *(f" b_w_RS_S_{a} [rad s^-1]" for a in "xyz")]  # fmt: skip
    rows = quaternions(CAMERA_POSES @ BODY_FROM_CAMERA.inverse())
    folder = mav / "state_groundtruth_estimate0"
    folder.mkdir()
    lines = ["#" + ",".join(names)]
    for stamp, row in zip(stamps, rows.tolist(), strict=True):
        lines.append(",".join(map(str, [stamp, *row, *[0.1] * 6])))
    (folder / "data.csv").write_text("\n".join(lines))


def scannet(root: Path) -> None:
    """As ScanNet's SensReader writes it: matrices of 4x4, also of the intrinsics."""
    make_folder(root, [f"{i}.png" for i in range(5)], None, "color")
    matrix_files(root / "pose", [f"{i}.txt" for i in range(4)], CAMERA_POSES)
    np.savetxt(root / "pose" / "4.txt", np.full((4, 4), -np.inf))
    (root / "intrinsic").mkdir()
    matrix = np.eye(4)
    matrix[:3, :3] = PLAIN.matrix()
    np.savetxt(root / "intrinsic" / "intrinsic_color.txt", matrix)


def ace(root: Path) -> None:
    """As the scripts of ACE write 7-Scenes, but with a 3x3 matrix; a half for testing."""
    for split, first in (("train", 0), ("test", 2)):
        names = [f"seq-01-frame-{i:06d}" for i in (first, first + 1)]
        folder = root / split
        make_folder(folder, [f"{name}.color.png" for name in names], None, "rgb")
        poses = CAMERA_POSES[first : first + 2]
        matrix_files(folder / "poses", [f"{name}.pose.txt" for name in names], poses)
        (folder / "calibration").mkdir()
        for name in names:
            (folder / "calibration" / f"{name}.calibration.txt").write_text(LENS_TEXT)


def record3d(root: Path) -> None:
    """Quaternion, then position, OpenGL's axes, and a matrix column after column."""
    make_folder(root, NUMBERS, None, "rgb")
    rows = quaternions(SE3.from_matrix(CAMERA_POSES.matrix() @ GL))
    rows = rows[:, [4, 5, 6, 3, 0, 1, 2]]
    data = {"w": 32, "h": 24, "dw": 16, "dh": 12, "fps": 60, "cameraType": 1,
            "K": PLAIN.matrix().T.ravel().tolist(), "poses": rows.tolist()}  # fmt: skip
    (root / "metadata").write_text(json.dumps(data))


@pytest.mark.parametrize("write", [table, tum, euroc, scannet, ace, record3d])
def test_folders_of_camera_poses_are_read(
    tmp_path: Path, write: Callable[[Path], object]
) -> None:
    write(tmp_path)
    recording = load_recording(tmp_path)
    assert len(recording.test) == (2 if write is ace else 0)
    frames = [*recording.train, *recording.test]
    for frame, pose in zip(frames, CAMERA_POSES, strict=True):
        assert_pose(frame.base_from_camera, pose, 1e-5 if write is tum else 1e-7)
        assert frame.base_from_gripper is None
        assert frame.camera == PLAIN
        assert frame.read_image().shape == (24, 32, 3)
    assert recording.untracked == (write is scannet)
    assert recording.metric


def test_cameras_of_single_images_are_read(tmp_path: Path) -> None:
    root = tmp_path / "ace"
    ace(root)
    pose = root / "train/poses/seq-01-frame-000000.pose.txt"
    kept = pose.read_text()
    pose.write_text("-inf " * 16)
    recording = load_recording(root)
    names = [frame.name for frame in recording.train]
    assert names == ["train/seq-01-frame-000001.color.png"]
    assert recording.untracked == 1
    pose.write_text(kept)
    first, second = sorted((root / "train/calibration").iterdir())
    second.write_text("33.5")
    cameras = [frame.camera for frame in load_recording(root).train]
    assert cameras == [PLAIN, Camera(32, 24, 33.5, 33.5, 15.5, 11.5)]
    second.unlink()
    refused("lacks the file of an image", load_recording, root)
    options = ReadOptions(camera=first)
    assert load_recording(root, options=options).train[1].camera == PLAIN
    options = ReadOptions(camera=second)
    refused("camera file is missing", load_recording, root, options=options)


def test_the_phone_states_a_camera_for_each_image(tmp_path: Path) -> None:
    record3d(tmp_path)
    metadata = tmp_path / "metadata"
    data = json.loads(metadata.read_text())
    data["perFrameIntrinsicCoeffs"] = [[30 + i, 31 + i, 15, 11] for i in range(4)]
    metadata.write_text(json.dumps(data))
    focal = [frame.camera.fx for frame in load_recording(tmp_path).train]
    assert focal == [30, 31, 32, 33]


def test_broken_matrices_of_a_folder_are_refused(tmp_path: Path) -> None:
    scannet(tmp_path)
    np.savetxt(tmp_path / "pose" / "2.txt", np.diag([2.0, 2, 2, 1]))
    refused("pose: .*rotation", load_recording, tmp_path)
    for file in (tmp_path / "pose").glob("*.txt"):
        file.write_text("-inf " * 16)
    refused("all poses in its files are inf or nan", load_recording, tmp_path)


def test_a_broken_sensor_file_is_refused(tmp_path: Path) -> None:
    euroc(tmp_path)
    sensor = tmp_path / "mav0/cam0/sensor.yaml"
    sensor.write_text(sensor.read_text().replace("T_BS", "T_CB"))
    refused(r"sensor\.yaml: 'T_BS' is a list of numbers", load_recording, tmp_path)
    sensor.unlink()
    refused(r"sensor\.yaml: camera file is missing", load_recording, tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"poses": None}, "has 7 numbers .* got 0"),
        ({"poses": [[1, 0, 0, 0]]}, "has 7 numbers .* got 4"),
        ({"K": None}, "camera_matrix"),
        ({"w": None}, "camera width is"),
    ],
)
def test_broken_metadata_are_refused(
    tmp_path: Path, change: dict[str, object], message: str
) -> None:
    record3d(tmp_path)
    metadata = tmp_path / "metadata"
    data = json.loads(metadata.read_text()) | change
    metadata.rename(tmp_path / "metadata.json").write_text(json.dumps(data))
    refused(message, load_recording, tmp_path)


def test_two_files_of_poses_are_refused(tmp_path: Path) -> None:
    record3d(tmp_path / "phone")
    (tmp_path / "phone" / "metadata.json").touch()
    message = "holds metadata and metadata.json; keep"
    refused(message, load_recording, tmp_path / "phone")
    table(tmp_path / "table")
    write_poses(tmp_path / "table" / "base_from_gripper.csv", CAMERA_POSES)
    message = "holds base_from_gripper.csv and base_from_camera.csv"
    refused(message, load_recording, tmp_path / "table")


def test_the_one_pose_of_a_fixed_camera_is_no_table(tmp_path: Path) -> None:
    make_folder(tmp_path, ["1.png", "2.png"], None)
    np.savetxt(tmp_path / "base_from_camera.txt", np.eye(4))
    assert not wrist.detect(tmp_path)
    rows = CAMERA_POSES[:2].matrix().reshape(2, 16)
    np.savetxt(tmp_path / "base_from_camera.txt", rows)
    assert_pose(load_recording(tmp_path).train[1].base_from_camera, CAMERA_POSES[1])
