"""A folder of images and gripper poses, paired by name, by time or in order."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from evercal.geometry import SE3, Camera, pose_distance
from evercal.recordings import ReadOptions, Recording, load_recording, write_image
from evercal.recordings.formats import wrist
from evercal.recordings.image_files import image_files
from evercal.recordings.poses.pairing import pair_images
from evercal.recordings.poses.robot_poses import RobotPoses
from evercal.recordings.poses.row_files import times_in_names
from evercal.storage.text_files import natural_key

from ..checks import assert_pose, refused

CAMERA = Camera(32, 24, 30.0, 31.0, 15.0, 11.0, (0.1, 0.0, 0.0, 0.0))


def some_poses(count: int, seed: int = 0) -> SE3:
    return SE3.exp(np.random.default_rng(seed).normal(0, 0.4, (count, 6)))


def write_poses(file: Path, poses: SE3) -> None:
    rotvec = poses.log()[:, 3:]
    rows = np.hstack([poses.translation_m, rotvec])
    np.savetxt(file, rows, fmt="%.12f", delimiter=",", comments="",
               header="x_m,y_m,z_m,rotvec_x,rotvec_y,rotvec_z")  # fmt: skip


def make_folder(
    root: Path, names: Sequence[str], poses: SE3 | None, folder: str = "."
) -> Path:
    (root / folder).mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        write_image(root / folder / name, np.full((24, 32, 3), i + 1, np.uint8))
    (root / "camera.json").write_text(json.dumps(CAMERA.to_dict()))
    if poses is not None:
        write_poses(root / "base_from_gripper.csv", poses)
    return root


def assert_paired(recording: Recording, names: Sequence[str], poses: SE3) -> None:
    assert [frame.name for frame in recording.train] == list(names)
    for frame, pose in zip(recording.train, poses, strict=True):
        assert frame.base_from_camera is None
        assert_pose(frame.base_from_gripper, pose)
        assert frame.camera == CAMERA


@pytest.mark.parametrize("folder", [".", "images", "rgb"])
def test_rows_without_names_are_paired_in_natural_order(
    tmp_path: Path, folder: str
) -> None:
    names = [f"image-{i}.png" for i in range(1, 13)]  # image-10 comes after image-9
    poses = some_poses(12)
    root = make_folder(tmp_path / "wave", names, poses, folder)
    recording = load_recording(root)
    assert_paired(recording, names, poses)
    assert (recording.name, recording.test, recording.untracked) == ("wave", (), 0)
    assert int(recording.train[11].read_image().mean()) == 12
    assert "in order" in recording.notes[0]


def test_names_pair_in_any_order() -> None:
    poses = some_poses(3)
    rows = RobotPoses(("c", "rgb/a.png", "gone.png"), None, poses)
    images = [Path(f"rgb/{name}") for name in ("a.png", "b.png", "c.png")]
    (a, b, c), notes = pair_images(images, rows, None, Path("poses.csv"))
    assert_pose(a, poses[1])
    assert b is None
    assert_pose(c, poses[0])
    assert notes == [
        "1 image without a row in poses.csv: b.png",
        "1 row of poses.csv without an image: gone.png",
    ]


SECONDS = np.arange(11) / 10
TIMES = 1305031102.0 + SECONDS


FEWER = r"11 poses for 1 images.*stamps\.csv"


@pytest.mark.parametrize(
    ("images", "names", "stamps", "message"),
    [
        ("a b", ("1", "2"), None, "names no image of"),
        ("7.25 8.25", ("7", "9"), None, "names no image of"),
        ("a b", ("a.png", "a.png"), None, r"'a\.png' comes twice"),
        ("image-1 image-10 image-2", None, None, "is given after image-10"),
        # Frame numbers are not times, even if the clock of the robot starts at 0.
        ("000001 000002", None, TIMES[:3], r"3 poses for 2 images.*stamps\.csv"),
        ("20240115_000001", None, SECONDS, FEWER),
        ("20240115000001", None, SECONDS, FEWER),
        ("9.25 9.5", None, SECONDS, "are the clocks the same"),
        ("1700000000123", None, SECONDS, "are the clocks the same"),
    ],
)
def test_images_that_cannot_be_paired_are_refused(
    images: str, names: tuple[str, ...] | None, stamps: np.ndarray | None, message: str
) -> None:
    files = [Path(f"{stem}.png") for stem in images.split()]
    count = len(files) if stamps is None else len(stamps)
    rows = RobotPoses(names, stamps, some_poses(count))
    refused(message, pair_images, files, rows, None, Path("p.csv"))


def test_frame_numbers_and_folders_are_paired_in_order() -> None:
    rows = RobotPoses(None, TIMES[:3], some_poses(3))
    for images in (["0.png", "1.png", "2.png"], ["b/1.png", "b/2.png", "a/1.png"]):
        files = [*map(Path, images)]
        paired, notes = pair_images(files, rows, None, Path("p"))
        assert None not in paired
        assert "in order" in notes[0]


def test_poses_are_interpolated_at_times_in_image_names() -> None:
    screw = np.array([0.01, 0, 0, 0, 0.02, 0])
    poses = SE3.exp(np.outer(np.arange(11), screw))
    images = [Path(f"{TIMES[0] + t:.6f}.png") for t in (-0.1, 0.25, 0.5, 0.975)]
    rows = RobotPoses(None, TIMES, poses)
    paired, notes = pair_images(images, rows, None, Path("p.tum"))
    assert paired[0] is None
    assert notes[1].startswith("1 image taken outside the recorded poses")
    for pose, at in zip(paired[1:], (2.5, 5.0, 9.75), strict=True):
        assert pose is not None
        metres, radians = pose_distance(pose, SE3.exp(screw * at))
        # Interpolation follows a line, not the arc of the screw: microns apart here.
        assert metres < 1e-4
        assert radians < 1e-6


def test_poses_are_interpolated_at_times_in_a_stamps_file(tmp_path: Path) -> None:
    make_folder(tmp_path, ["x.png", "y.png"], None)
    (tmp_path / "base_from_gripper.csv").write_text(
        "stamp_s,x_m,y_m,z_m,rotvec_x,rotvec_y,rotvec_z\n"
        "0.0,0,0,0,0,0,0\n0.1,1,0,0,0,0,0\n0.2,2,0,0,0,0,0\n"
    )
    (tmp_path / "stamps.csv").write_text(
        "image,stamp_ns\nimages/y.png,150000000\nx.png,50000000\n"
    )
    for frame, x in zip(load_recording(tmp_path).train, (0.5, 1.5), strict=True):
        assert_pose(frame.base_from_gripper, SE3.exp([x, 0, 0, 0, 0, 0]))
    (tmp_path / "stamps.csv").write_text("image,stamp_s\nx.png,0.05\n")
    refused(r"y\.png: stamps\.csv has no row", load_recording, tmp_path)


def test_times_in_names() -> None:
    for names, times in (
        (("1403636579763555584.png",), [1403636579.763556]),
        (("1403636579763555.png",), [1403636579.763555]),
        (("rgb/1403636579763.jpg", "1403636579863"), [1403636579.763, 1403636579.863]),
        (("10.png", "10.5"), [10.0, 10.5]),
    ):
        assert times_in_names(names) == pytest.approx(times, abs=1e-6)
    for name in [
        "0000000123.png",
        "12.png",
        "frame-1.5.png",
        "-1.5.png",
        "1e3.png",
        "nan.png",
    ]:
        assert times_in_names([name]) is None


def test_natural_order_of_mixed_names(tmp_path: Path) -> None:
    names = ["9.png", "10.png", "a.png", "b2.png", "b10.png", "b.png"]
    assert sorted(set(names), key=natural_key) == names
    for name in names:
        (tmp_path / name).touch()
    assert [file.name for file in image_files([tmp_path])] == names


def test_camera_file_is_chosen_and_must_fit_the_images(tmp_path: Path) -> None:
    make_folder(tmp_path, ["1.png", "2.png"], some_poses(2))
    (tmp_path / "camera.json").rename(tmp_path / "other.json")
    message = r"no camera file in it; name the file .* `camera`"
    refused(message, load_recording, tmp_path)
    options = ReadOptions(camera=tmp_path / "other.json")
    assert load_recording(tmp_path, options=options).train[0].camera == CAMERA
    (tmp_path / "camera.txt").write_text(LENS_TEXT)
    assert load_recording(tmp_path).train[0].camera == PLAIN
    (tmp_path / "camera.txt").unlink()
    wide = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
    (tmp_path / "camera.json").write_text(json.dumps(wide.to_dict()))
    refused(r"is for images of 64x48, 1\.png is 32x24", load_recording, tmp_path)


def test_missing_and_ambiguous_files_are_refused(tmp_path: Path) -> None:
    make_folder(tmp_path, [], some_poses(2))
    refused("no images", load_recording, tmp_path)
    (tmp_path / "joints.csv").write_text("a\n1\n")
    refused(r"holds base_from_gripper\.csv and joints\.csv", load_recording, tmp_path)
    (tmp_path / "joints.csv").unlink()
    write_image(tmp_path / "1.png", np.zeros((24, 32, 3), np.uint8))
    options = ReadOptions(gripper_frame="tool0")
    message = "`gripper_frame`: .* holds poses already"
    refused(message, load_recording, tmp_path, options=options)
    (tmp_path / "base_from_gripper.csv").unlink()
    message = "no gripper poses; expected base_from_gripper"
    refused(message, load_recording, tmp_path, "wrist")


CAMERA_POSES = some_poses(4, seed=5)
LENS_TEXT = "30 0 15\n0 31 11\n0 0 1\n"
PLAIN = Camera(32, 24, 30.0, 31.0, 15.0, 11.0)
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


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "needs a line of column names"),
        ("image,stamp_s\n", "then rows of a time"),
        ("1,2,3\n4,5,6\n", "needs a line of column names"),
        ("image,stamp_s\na.png\n", "'stamp_s' is made of numbers"),
        ("image,stamp_s\na.png,nan\n", "a stamp is inf or nan"),
        ("image,x\na.png,1\n", "needs the columns image and stamp_s"),
        ("image,stamp_s\nl/a.png,1\nr/a.png,2\n", "'a.png' comes twice"),
    ],
)
def test_broken_stamps_are_refused(tmp_path: Path, text: str, message: str) -> None:
    make_folder(tmp_path, ["1.png"], some_poses(1))
    (tmp_path / "stamps.csv").write_text(text)
    refused(f"stamps.csv.*{message}", load_recording, tmp_path)


def test_other_kinds_of_pose_files_are_read(tmp_path: Path) -> None:
    names = ["1.png", "2.png"]
    poses = some_poses(2)
    make_folder(tmp_path, names, None)
    np.save(tmp_path / "base_from_gripper.npy", poses.matrix())
    assert_paired(load_recording(tmp_path), names, poses)
    (tmp_path / "base_from_gripper.npy").unlink()
    rows = np.hstack([1000 * poses.translation_m, poses.log()[:, 3:]])
    np.savetxt(tmp_path / "base_from_gripper.txt", rows)
    # The convention is missing.
    refused(r"base_from_gripper\.txt", load_recording, tmp_path)
    recording = load_recording(tmp_path, options=ReadOptions(pose_convention="ur:mm"))
    assert_paired(recording, names, poses)
