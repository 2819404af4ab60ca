"""A folder of images and gripper poses, paired by name, by time or in order."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from evercal.geometry import SE3, Camera, pose_distance
from evercal.recordings import ReadOptions, Recording, load_recording, write_image
from evercal.recordings.image_files import image_files
from evercal.recordings.poses.pairing import pair_images
from evercal.recordings.poses.robot_poses import RobotPoses
from evercal.recordings.poses.row_files import times_in_names
from evercal.storage.text_files import natural_key

from ..checks import assert_pose, refused

CAMERA = Camera(32, 24, 30.0, 31.0, 15.0, 11.0, (0.1, 0.0, 0.0, 0.0))
LENS_TEXT = "30 0 15\n0 31 11\n0 0 1\n"
PLAIN = Camera(32, 24, 30.0, 31.0, 15.0, 11.0)


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
    (a, b, c), _, notes = pair_images(images, rows, None, Path("poses.csv"))
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
        paired, _, notes = pair_images(files, rows, None, Path("p"))
        assert None not in paired
        assert "in order" in notes[0]


def test_poses_are_interpolated_at_times_in_image_names() -> None:
    screw = np.array([0.01, 0, 0, 0, 0.02, 0])
    poses = SE3.exp(np.outer(np.arange(11), screw))
    images = [Path(f"{TIMES[0] + t:.6f}.png") for t in (-0.1, 0.25, 0.5, 0.975)]
    rows = RobotPoses(None, TIMES, poses)
    paired, _, notes = pair_images(images, rows, None, Path("p.tum"))
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
    options = ReadOptions(urdf=tmp_path / "arm.urdf")
    message = "`urdf`: .* holds poses already"
    refused(message, load_recording, tmp_path, options=options)
    (tmp_path / "base_from_gripper.csv").unlink()
    message = "no gripper poses; expected base_from_gripper"
    refused(message, load_recording, tmp_path, "wrist")


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
