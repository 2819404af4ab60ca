"""A folder of images and gripper poses: rows find their images by name, by time or in order."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from evercal.cli.image_words import image_files
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_distance
from evercal.recordings import ReadOptions, Recording, load_recording, write_image
from evercal.recordings.formats import wrist
from evercal.recordings.poses.pairing import pair_images
from evercal.recordings.poses.robot_poses import RobotPoses
from evercal.recordings.poses.row_files import in_seconds, natural_key, times_in_names

CAMERA = Camera(32, 24, 30.0, 31.0, 15.0, 11.0, (0.1, 0.0, 0.0, 0.0))


def some_poses(count: int, seed: int = 0) -> SE3:
    return SE3.exp(np.random.default_rng(seed).normal(0, 0.4, (count, 6)))


def write_poses(file: Path, poses: SE3) -> None:
    rotvec = poses.log()[:, 3:]
    rows = np.hstack([poses.translation_m, rotvec])
    np.savetxt(file, rows, fmt="%.12f", delimiter=",", comments="",
               header="x_m,y_m,z_m,rotvec_x,rotvec_y,rotvec_z")  # fmt: skip


def make_folder(root: Path, names: Sequence[str], poses: SE3 | None, folder: str = ".") -> Path:
    (root / folder).mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        write_image(root / folder / name, np.full((24, 32, 3), i + 1, np.uint8))
    (root / "camera.json").write_text(json.dumps(CAMERA.to_dict()))
    if poses is not None:
        write_poses(root / "base_from_gripper.csv", poses)
    return root


def assert_paired(scene: Recording, names: Sequence[str], poses: SE3) -> None:
    assert [frame.name for frame in scene.train] == list(names)
    for frame, pose in zip(scene.train, poses, strict=True):
        assert frame.base_from_camera is None
        assert frame.base_from_gripper is not None
        assert max(pose_distance(frame.base_from_gripper, pose)) < 1e-9
        assert frame.camera == CAMERA


@pytest.mark.parametrize("folder", [".", "images", "rgb"])
def test_rows_without_names_are_paired_in_natural_order(tmp_path: Path, folder: str) -> None:
    names = [f"image-{i}.png" for i in range(1, 13)]  # image-10 comes after image-9
    poses = some_poses(12)
    scene = load_recording(make_folder(tmp_path / "wave", names, poses, folder))
    assert_paired(scene, names, poses)
    assert (scene.name, scene.test, scene.untracked) == ("wave", (), 0)
    assert int(scene.train[11].read_image().mean()) == 12
    assert "in order" in scene.notes[0]


def test_too_few_rows_are_refused(tmp_path: Path) -> None:
    make_folder(tmp_path, ["a.png", "b.png", "c.png"], some_poses(2))
    with pytest.raises(InputError, match="2 poses for 3 images"):
        load_recording(tmp_path)


def test_names_pair_in_any_order() -> None:
    images = [Path(f"rgb/{name}") for name in ("a.png", "b.png", "c.png")]
    poses = some_poses(3)
    rows = RobotPoses(("c", "rgb/a.png", "gone.png"), None, poses)
    paired, notes = pair_images(images, rows, None, Path("poses.csv"))
    assert paired[0] is not None
    assert paired[2] is not None
    assert paired[1] is None
    assert max(pose_distance(paired[0], poses[1])) < 1e-12
    assert max(pose_distance(paired[2], poses[0])) < 1e-12
    assert notes == [
        "1 image without a row in poses.csv: b.png",
        "1 row of poses.csv without an image: gone.png",
    ]


def test_names_of_other_images_and_repeated_names_are_refused() -> None:
    images = [Path("a.png"), Path("b.png")]
    with pytest.raises(InputError, match="names no image of"):
        pair_images(images, RobotPoses(("1", "2"), None, some_poses(2)), None, Path("p.csv"))
    rows = RobotPoses(("a.png", "a.png"), None, some_poses(2))
    with pytest.raises(InputError, match=r"'a\.png' comes twice"):
        pair_images(images, rows, None, Path("p.csv"))


def test_poses_are_interpolated_at_times_in_image_names() -> None:
    stamps = 1305031102.0 + np.arange(11) / 10
    poses = SE3.exp(np.outer(np.arange(11), [0.01, 0, 0, 0, 0.02, 0]))
    images = [Path(f"{stamps[0] + t:.6f}.png") for t in (0.25, 0.5, 0.975)]
    paired, _ = pair_images(images, RobotPoses(None, stamps, poses), None, Path("p.tum"))
    for pose, at in zip(paired, (2.5, 5.0, 9.75), strict=True):
        assert pose is not None
        expected = SE3.exp(np.array([0.01, 0, 0, 0, 0.02, 0]) * at)
        # Between the screw's poses a line is followed, not an arc: microns apart here.
        assert pose_distance(pose, expected)[0] < 1e-4
        assert pose_distance(pose, expected)[1] < 1e-6


def test_poses_are_interpolated_at_times_in_a_stamps_file(tmp_path: Path) -> None:
    assert in_seconds([1403636579763555584])[0] == pytest.approx(1403636579.763556, abs=1e-6)
    assert in_seconds([1403636579763555])[0] == pytest.approx(1403636579.763555, abs=1e-6)
    assert in_seconds([1403636579763])[0] == pytest.approx(1403636579.763)
    assert in_seconds([12.5])[0] == 12.5
    names = ["x.png", "y.png"]
    make_folder(tmp_path, names, None)
    (tmp_path / "base_from_gripper.csv").write_text(
        "stamp_s,x_m,y_m,z_m,rotvec_x,rotvec_y,rotvec_z\n"
        "0.0,0,0,0,0,0,0\n0.1,1,0,0,0,0,0\n0.2,2,0,0,0,0,0\n"
    )
    (tmp_path / "stamps.csv").write_text("image,stamp_ns\nimages/y.png,150000000\nx.png,50000000\n")
    first, second = load_recording(tmp_path).train
    assert first.base_from_gripper is not None
    assert second.base_from_gripper is not None
    np.testing.assert_allclose(first.base_from_gripper.translation_m, [0.5, 0, 0])
    np.testing.assert_allclose(second.base_from_gripper.translation_m, [1.5, 0, 0])
    (tmp_path / "stamps.csv").write_text("image,stamp_s\nx.png,0.05\n")
    with pytest.raises(InputError, match=r"y\.png: stamps\.csv has no row"):
        load_recording(tmp_path)
    (tmp_path / "stamps.csv").write_text("image,stamp_s\nx.png,105\ny.png,106\n")
    with pytest.raises(InputError, match="are the clocks the same"):
        load_recording(tmp_path)


def test_frame_numbers_are_not_times() -> None:
    rows = RobotPoses(None, 1.7e9 + np.arange(3.0), some_poses(3))
    paired, notes = pair_images([Path(f"{i:06d}.png") for i in range(3)], rows, None, Path("p"))
    assert None not in paired
    assert "in order" in notes[0]
    with pytest.raises(InputError, match=r"3 poses for 2 images.*stamps\.csv"):
        pair_images([Path("000001.png"), Path("000002.png")], rows, None, Path("p"))


def test_frame_numbers_are_not_seconds() -> None:
    # A robot's clock often starts at 0: frame 50 was not taken 50 s later.
    stamps = np.arange(2001) / 10
    rows = RobotPoses(None, stamps, SE3.exp(np.outer(stamps, [0.001, 0, 0, 0, 0, 0])))
    for form in ("{:06d}.png", "{}.png", "20240115_{:06d}.png", "20240115{:06d}.png"):
        images = [Path(form.format(i)) for i in range(100)]
        with pytest.raises(InputError, match=r"2001 poses for 100 images.*stamps\.csv"):
            pair_images(images, rows, None, Path("p"))


def test_times_of_another_clock_are_refused() -> None:
    rows = RobotPoses(None, np.arange(3.0), some_poses(3))
    for names in (("9.25", "9.5", "9.75"), ("1700000000123", "1700000000223", "1700000000323")):
        images = [Path(f"{name}.png") for name in names]
        with pytest.raises(InputError, match="are the clocks the same"):
            pair_images(images, rows, None, Path("p"))


def test_times_in_names() -> None:
    for names, times in (
        (("1403636579763555584.png",), [1403636579.763556]),
        (("rgb/1403636579763.jpg", "1403636579863"), [1403636579.763, 1403636579.863]),
        (("10.png", "10.5"), [10.0, 10.5]),
    ):
        assert times_in_names(names) == pytest.approx(times, abs=1e-6)
    for name in ("0000000123.png", "12.png", "frame-1.5.png", "-1.5.png", "1e3.png", "nan.png"):
        assert times_in_names([name]) is None


def test_images_outside_the_recorded_poses_get_no_pose(tmp_path: Path) -> None:
    stamps = np.array([10.0, 10.1, 10.2])
    images = [Path(f"{t}.png") for t in ("9.9", "10.05", "10.3")]
    rows = RobotPoses(None, stamps, some_poses(3))
    paired, notes = pair_images(images, rows, None, Path("p"))
    assert [pose is None for pose in paired] == [True, False, True]
    assert notes[1].startswith("2 images taken outside")


def test_images_out_of_natural_order_are_not_paired_in_order() -> None:
    rows = RobotPoses(None, None, some_poses(3))
    images = [Path(f"{name}.png") for name in ("image-1", "image-10", "image-2")]
    with pytest.raises(InputError, match=r"image-2\.png is given after image-10\.png"):
        pair_images(images, rows, None, Path("p"))
    # Every folder has an order of its own.
    images = [Path(name) for name in ("b/1.png", "b/2.png", "a/1.png")]
    assert None not in pair_images(images, rows, None, Path("p"))[0]


def test_folder_of_images_is_in_natural_order(tmp_path: Path) -> None:
    for i in range(1, 12):
        (tmp_path / f"image-{i}.png").touch()
    names = [file.name for file in image_files([tmp_path])]
    assert names == [f"image-{i}.png" for i in range(1, 12)]


def test_natural_order_of_mixed_names() -> None:
    names = ["b2.png", "10.png", "b10.png", "9.png", "a.png", "b.png"]
    assert sorted(names, key=natural_key) == [
        "9.png", "10.png", "a.png", "b2.png", "b10.png", "b.png"
    ]  # fmt: skip


def test_camera_file_is_chosen_and_must_fit_the_images(tmp_path: Path) -> None:
    make_folder(tmp_path, ["1.png", "2.png"], some_poses(2))
    (tmp_path / "camera.json").rename(tmp_path / "other.json")
    with pytest.raises(InputError, match=r"no camera file in it; name the file .* --camera"):
        load_recording(tmp_path)
    scene = load_recording(tmp_path, options=ReadOptions(camera=tmp_path / "other.json"))
    assert scene.train[0].camera == CAMERA
    (tmp_path / "camera.txt").write_text("30 0 15\n0 31 11\n0 0 1\n")
    assert load_recording(tmp_path).train[0].camera == Camera(32, 24, 30.0, 31.0, 15.0, 11.0)
    (tmp_path / "camera.txt").unlink()
    wide = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
    (tmp_path / "camera.json").write_text(json.dumps(wide.to_dict()))
    with pytest.raises(InputError, match=r"is for images of 64x48, 1\.png is 32x24"):
        load_recording(tmp_path)


def test_missing_and_ambiguous_files_are_refused(tmp_path: Path) -> None:
    make_folder(tmp_path, [], some_poses(2))
    with pytest.raises(InputError, match="no images"):
        load_recording(tmp_path)
    (tmp_path / "joints.csv").write_text("a\n1\n")
    with pytest.raises(InputError, match=r"holds base_from_gripper\.csv and joints\.csv"):
        load_recording(tmp_path)
    (tmp_path / "joints.csv").unlink()
    with pytest.raises(InputError, match=r"--gripper-frame: .* holds gripper poses already"):
        load_recording(tmp_path, options=ReadOptions(gripper_frame="tool0"))
    (tmp_path / "base_from_gripper.csv").unlink()
    with pytest.raises(InputError, match="no gripper poses; expected base_from_gripper"):
        wrist.load(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        ("image,stamp_s\n", "no rows"),
        ("1,2,3\n4,5,6\n", "names no columns"),
        ("image,stamp_s\na.png\n", "row 1 has 1 cells"),
        ("image,stamp_s\na.png,nan\n", "'nan' is not a number"),
        ("image,x\na.png,1\n", "needs the columns image and stamp_s"),
        ("image,stamp_s\nl/a.png,1\nr/a.png,2\n", "'a.png' comes twice"),
    ],
)
def test_broken_stamps_are_refused(tmp_path: Path, text: str, message: str) -> None:
    make_folder(tmp_path, ["1.png"], some_poses(1))
    (tmp_path / "stamps.csv").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        load_recording(tmp_path)
    assert "\n" not in str(caught.value)
    assert "stamps.csv" in str(caught.value)


def test_other_kinds_of_pose_files_are_read(tmp_path: Path) -> None:
    names, poses = ["1.png", "2.png"], some_poses(2)
    make_folder(tmp_path, names, None)
    np.save(tmp_path / "base_from_gripper.npy", poses.matrix())
    assert_paired(load_recording(tmp_path), names, poses)
    (tmp_path / "base_from_gripper.npy").unlink()
    rows = np.hstack([1000 * poses.translation_m, poses.log()[:, 3:]])
    numbers = "\n".join(" ".join(f"{v:.12g}" for v in row) for row in rows)
    (tmp_path / "base_from_gripper.txt").write_text(numbers)
    with pytest.raises(InputError, match=r"base_from_gripper\.txt"):
        load_recording(tmp_path)  # nothing says how the numbers are meant
    scene = load_recording(tmp_path, options=ReadOptions(pose_convention="ur:mm"))
    assert_paired(scene, names, poses)
