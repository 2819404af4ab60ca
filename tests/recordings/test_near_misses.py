"""Folders and files that are nearly recordings: what is missing is said; one option reads them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.recordings import ReadOptions, load_recording, write_image
from evercal.recordings.samples import FOLDER

from .checks import refused

CAMERA = "50 0 31.5\n0 50 23.5\n0 0 1\n"
NUMBERS = range(10)
QUATERNIONS = "".join(f"{i / 10} 0 0.5 0 0 0 1\n" for i in NUMBERS)


def matrix(i: int, between: str = "\n") -> str:
    return between.join([f"1 0 0 {i / 10}", "0 1 0 0", "0 0 1 0.5", "0 0 0 1"]) + "\n"


def images(folder: Path, name: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for i in NUMBERS:
        write_image(folder / name.format(i), np.full((48, 64, 3), 9 * i, np.uint8))


def text(file: Path, content: str) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(content)


def seven(root: Path) -> None:
    images(root / "seq-01", "frame-{:06d}.color.png")
    for i in NUMBERS:
        text(root / f"seq-01/frame-{i:06d}.pose.txt", matrix(i))


def flat(root: Path) -> None:
    images(root, "frame-{:06d}.color.png")
    for i in NUMBERS:
        text(root / f"frame-{i:06d}.pose.txt", matrix(i))
        write_image(root / f"frame-{i:06d}.depth.png", np.zeros((48, 64, 3), np.uint8))


def beside(root: Path) -> None:
    images(root / "images", "{:04d}.png")
    for i in NUMBERS:
        text(root / f"poses/{i:04d}.txt", matrix(i))


def same(root: Path) -> None:
    images(root, "{:04d}.png")
    for i in NUMBERS:
        np.save(root / f"{i:04d}.npy", np.eye(4))


def array(root: Path) -> None:
    images(root / "rgb", "{:04d}.png")
    np.save(root / "camera_poses.npy", np.stack([np.eye(4)] * 10))


def euroc(root: Path) -> None:
    images(root / "mav0/cam0/data", "14036365797{:02d}000000.png")
    rows = [f"14036365797{i:02d}000000" for i in NUMBERS]
    poses = zip(rows, QUATERNIONS.splitlines(), strict=True)
    text(root / "../gt.tum", "\n".join(map(" ".join, poses)))


def tum(root: Path) -> None:
    images(root / "rgb", "1305031102.{:02d}.png")


def replica(root: Path) -> None:
    images(root / "results", "frame{:06d}.jpg")
    text(root / "traj.txt", "".join(matrix(i, " ") for i in NUMBERS))


def kitti(root: Path) -> None:
    images(root / "image_0", "{:06d}.png")
    rows = (" ".join(matrix(i, " ").split()[:12]) for i in NUMBERS)
    text(root / "poses.txt", "\n".join(rows))


def ace0(root: Path) -> None:
    images(root / "images", "{}.jpg")
    rows = (f"images/{i}.jpg 1 0 0 0 {i / 10} 0 0.5 50 2000\n" for i in NUMBERS)
    text(root / "poses_final.txt", "".join(rows))


def named(root: Path) -> None:
    images(root / "frames", "{}.jpg")
    rows = (f"{i}.jpg {row}" for i, row in enumerate(QUATERNIONS.splitlines(True)))
    text(root / "trajectory.csv", "".join(rows))


def scannet(root: Path) -> None:
    images(root / "color", "{}.jpg")


def plain(root: Path) -> None:
    images(root, "{}.jpg")


def fixed(root: Path) -> None:
    images(root / "images", "{}.jpg")
    text(root / "base_from_camera.txt", matrix(1))


def empty(root: Path) -> None:
    root.mkdir()


def containers(root: Path) -> None:
    text(root / "episode_0.hdf5", "HDF")


Case = tuple[Callable[[Path], None], str, dict[str, Any]]
FOLDERS: dict[str, Case] = {
    "7-Scenes without a split": (
        seven,
        "TrainSplit.txt: split file is missing; .* give `split` 4:1",
        {"split": "4:1"},
    ),
    "one sequence of it": (flat, "poses in .: .* give `poses` [.];", {"poses": "."}),
    "a folder of matrices": (
        beside,
        "10 images in .*images, and poses in poses: if .* camera, give `poses` poses; if",
        {"poses": "poses"},
    ),
    "matrices beside images": (same, "give `poses` [.];", {"poses": "."}),
    "one array": (
        array,
        "10 images in .*rgb, and poses in camera_poses.npy: .* give `poses` camera_poses",
        {"poses": "camera_poses.npy"},
    ),
    "EuRoC without ground truth": (
        euroc,
        "cam0/data without poses; add mav0/state_groundtruth_estimate0/data.csv, give",
        {"poses": "../gt.tum"},
    ),
    "TUM without ground truth": (tum, "rgb without poses; add", {}),
    "ScanNet without poses": (scannet, "color without poses; add pose, ", {}),
    "Replica": (replica, "results, and poses in traj.txt", {"poses": "traj.txt"}),
    "KITTI": (kitti, "give `poses` poses.txt", {"poses": "poses.txt"}),
    "ACE0": (
        ace0,
        "give `poses` poses_final.txt",
        {
            "poses": "poses_final.txt",
            "pose_convention": "qw,qx,qy,qz,x,y,z,...:inverse",
        },
    ),
    "a table of another name": (
        named,
        "give `poses` trajectory.csv; if of the gripper, call them base_from_gripper",
        {"poses": "trajectory.csv", "pose_convention": "xyzw"},
    ),
    "images only": (plain, "10 images in .* without poses; add .* reconstruct'", {}),
    "a fixed camera": (fixed, "10 images in .* without poses", {}),
    "nothing": (empty, "no known scene format, no images; give a bag, or a folder", {}),
    "containers": (containers, "no images; episode_0.hdf5 is HDF5, whose", {}),
}


@pytest.mark.parametrize("case", FOLDERS)
def test_folders_are_told_what_they_lack(tmp_path: Path, case: str) -> None:
    make, message, options = FOLDERS[case]
    root = tmp_path / "scene"
    make(root)
    refused(message, load_recording, root)
    if not options:
        return
    if make is not seven:
        text(tmp_path / "camera.txt", CAMERA)
        options = {**options, "camera": tmp_path / "camera.txt"}
    recording = load_recording(root, options=ReadOptions(**options))
    assert len(recording.train) + len(recording.test) == 10
    assert all(frame.base_from_camera for frame in recording.train)
    assert not [frame for frame in recording.train if "depth" in frame.name]


FILES = {
    "demo.h5": "HDF5, whose contents",
    "demo.HDF5": "HDF5, whose contents",
    "HD720_SN1.svo2": "a recording of a ZED camera, which only its SDK reads",
    "demo.pkl": "Python objects, which are not read as they may run code",
    "clip.MOV": "a video; 'evercal reconstruct' estimates",
    "0.png": "one image; give the folder",
    "chunk-000.parquet": "part of a dataset; give the folder of meta/info.json",
    "poses.csv": "no images; give the folder of the images, and this file as `poses`",
    "mesh.ply": "a model or point cloud",
    "replay.zarr": "a container that is not read",
    "x.bin": "a file, not a folder, and no bag",
    "all.zip": "not unpacked: all.zip; unpack in",
}


@pytest.mark.parametrize("name", FILES)
def test_files_are_named_by_their_kind(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"\0\1\2\3")
    with pytest.raises(InputError) as caught:
        load_recording(tmp_path / name)
    message = str(caught.value)
    assert FILES[name] in message
    assert len(message) < len(str(tmp_path)) * 2 + 200


def test_folders_of_another_level_are_named(tmp_path: Path) -> None:
    room = tmp_path / "a/b/room"
    images(room / "images", "{}.png")
    text(room / "camera.txt", CAMERA)
    text(room / "base_from_gripper.csv", "x y z qx qy qz qw\n" + QUATERNIONS)
    assert len(load_recording(room).train) == 10
    for above in (room.parent, room.parent.parent):
        refused(f"no recording, but it has some; give {room},", load_recording, above)
    refused(f"a part of a recording; give {room}$", load_recording, room / "images")


def test_a_split_takes_test_frames_from_the_others(tmp_path: Path) -> None:
    seven(tmp_path)
    options = ReadOptions(split="3:2")
    recording = load_recording(tmp_path, options=options)
    names = [
        [frame.name[-1] for frame in part] for part in (recording.train, recording.test)
    ]
    assert names == [["0", "1", "2", "5", "6", "7"], ["3", "4", "8", "9"]]
    for wrong in ("4", "0:1", "a:b", "4:-1"):
        options = ReadOptions(split=wrong)
        refused("`split` .* such as 4:1", load_recording, tmp_path, options=options)
    options = ReadOptions(split="4:1")
    bedroom = FOLDER / "bedroom"
    refused("without test frames only", load_recording, bedroom, options=options)
