"""Damaged files are read, or refused in one line, by every reader.

EVERCAL_MUTATIONS=5000 python -m pytest tests/test_mutated_files.py -s
"""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import time
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
import yaml
from scipy.io import savemat

from evercal.calibration.boards.board_poses import read_board_poses
from evercal.calibration.calibration import read_calibration
from evercal.calibration.transform_file import read_transform
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.map import Map
from evercal.recordings import ReadOptions, load_recording, read_image, write_image
from evercal.recordings.cameras.camera_file import read_camera
from evercal.recordings.formats import generic
from evercal.recordings.poses.robot_poses import read_robot_poses
from evercal.recordings.samples import CELL
from evercal.storage.manifest import write_manifest

from .mutations import mutated
from .recordings.formats import (
    bags_of_messages,
    test_camera_poses,
    test_lerobot,
    test_nerfstudio,
    test_scenes,
)

if TYPE_CHECKING:
    from evercal.mapping.scene_map import MapContents
    from evercal.recordings import Recording

COUNT = int(os.environ.get("EVERCAL_MUTATIONS", "8"))
LONGEST_S = 20.0
POSES = SE3.exp(np.random.default_rng(0).normal(0, 0.4, (9, 6)))
LENS = Camera(64, 48, 60.0, 60.0, 31.5, 23.5, (0.1, -0.01, 0.0, 0.0))


@dataclass(frozen=True)
class Reader:
    """How a kind of file is made and read."""

    make: Callable[[Path], Path]
    """Writes valid files into a new folder, and gives the path to read."""
    read: Callable[[Path], object]
    pattern: str = "*"
    """Files that are damaged, below the folder."""


def recording(path: Path, **options: Any) -> None:
    """Read a recording and its images."""
    loaded = load_recording(path, options=ReadOptions(**options))
    for frame in (*loaded.train, *loaded.test):
        frame.read_image()


def pictures(root: Path, count: int = 9) -> None:
    (root / "images").mkdir(parents=True)
    for i in range(count):
        write_image(
            root / "images" / f"{i:03d}.png", np.full((48, 64, 3), 9 * i, np.uint8)
        )


def file(name: str, data: bytes) -> Callable[[Path], Path]:
    """Writes one file."""

    def make(root: Path) -> Path:
        (root / name).write_bytes(data)
        return root / name

    return make


def wrist(root: Path) -> Path:
    shutil.copytree(CELL / "wrist", root / "wrist")
    for image in sorted((root / "wrist/images").iterdir())[4:]:
        image.unlink()
    table = root / "wrist/base_from_gripper.csv"
    lines = table.read_text().splitlines()
    table.write_text(
        "\n".join(lines[: lines.index(next(x for x in lines if "0" in x)) + 4])
    )
    return root / "wrist"


def seven_scenes(root: Path) -> Path:
    (root / "TrainSplit.txt").write_text("sequence1\n")
    (root / "TestSplit.txt").write_text("sequence2\n")
    for sequence in (1, 2):
        folder = root / f"seq-{sequence:02d}"
        folder.mkdir()
        for i in range(3):
            write_image(
                folder / f"frame-{i:06d}.color.png", np.full((48, 64, 3), i, np.uint8)
            )
            np.savetxt(folder / f"frame-{i:06d}.pose.txt", POSES[i].matrix())
    return root


def nerfstudio(root: Path) -> Path:
    frames = test_nerfstudio.entries(test_nerfstudio.ring())
    lens = {"fl_x": 30, "fl_y": 30, "cx": 12, "cy": 18, "w": 24, "h": 36, "k1": 0.1}
    return test_nerfstudio.write(root, frames, **lens)


def colmap(kind: str) -> Callable[[Path], Path]:
    def make(root: Path) -> Path:
        # Skipped where pycolmap has no wheel; the other readers are tested there.
        from .recordings.formats import test_colmap

        test_colmap.make(root, "OPENCV", kind)
        return root

    return make


def bag(kind: str) -> Callable[[Path], Path]:
    return lambda root: bags_of_messages.recorded_bag(kind).write(root)


def lerobot(version: str) -> Callable[[Path], Path]:
    return lambda root: test_lerobot.make(root, version, "image")


def folder(write: Callable[[Path], None]) -> Callable[[Path], Path]:
    def make(root: Path) -> Path:
        write(root)
        return root

    return make


def read_lerobot(root: Path) -> None:
    lens = {"camera": root / "lens.txt", "image_topic": test_lerobot.WRIST}
    recording(root, **lens)


def poses(name: str) -> Callable[[Path], Path]:
    """Nine robot poses in a file of the ending of `name`."""
    rows = np.hstack([POSES.translation_m, POSES.rotation_wxyz[:, [1, 2, 3, 0]]])

    def make(root: Path) -> Path:
        path = root / name
        if path.suffix == ".npy":
            np.save(path, POSES.matrix())
        elif path.suffix == ".npz":
            np.savez(path, poses=POSES.matrix())
        elif path.suffix == ".mat":
            savemat(path, {"T": POSES.matrix()})
        elif path.suffix == ".yaml":
            path.write_text(
                yaml.safe_dump([{"T": pose.matrix().tolist()} for pose in POSES])
            )
        elif path.suffix == ".tum":
            np.savetxt(path, np.hstack([np.arange(9)[:, None], rows]))
        elif path.suffix == ".json":
            path.write_text(json.dumps([pose.matrix().tolist() for pose in POSES]))
        else:
            head = "x_m,y_m,z_m,qx,qy,qz,qw"
            np.savetxt(path, rows, delimiter=",", header=head, comments="")
        return path

    return make


def matrix(root: Path) -> Path:
    np.savetxt(root / "matrix.txt", POSES[0].matrix())
    return root / "matrix.txt"


def opencv_storage(root: Path, ending: str) -> Path:
    path = root / f"lens{ending}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 64)
    storage.write("image_height", 48)
    storage.write("camera_matrix", LENS.matrix())
    storage.write("distortion_coefficients", np.array(LENS.distortion))
    storage.release()
    return path


def camera_npz(root: Path) -> Path:
    np.savez(root / "lens.npz", camera_matrix=LENS.matrix(), dist_coeffs=np.zeros(5))
    return root / "lens.npz"


INFO = b"""image_width: 64
image_height: 48
camera_name: wrist
camera_matrix: {rows: 3, cols: 3, data: [60, 0, 31.5, 0, 60, 23.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}
"""
CHAIN = b"""cam0:
  camera_model: pinhole
  intrinsics: [60, 61, 31.5, 23.5]
  distortion_model: radtan
  distortion_coeffs: [0.1, 0, 0, 0]
  resolution: [64, 48]
"""
MATRIX = b"60 0 31.5\n0 60 23.5\n0 0 1\n"
PICTURE = np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8)
PNG, JPEG = (cv2.imencode(ending, PICTURE)[1].tobytes() for ending in (".png", ".jpg"))


def read_size(path: Path) -> object:
    return read_camera(path, (64, 48))


READERS = {
    "7scenes": Reader(seven_scenes, recording, "**/*.txt"),
    "12scenes": Reader(test_scenes.write, recording, "**/*.txt"),
    "nerfstudio": Reader(nerfstudio, recording, "*.json"),
    "colmap-bin": Reader(colmap("bin"), recording, "sparse/0/*.bin"),
    "colmap-txt": Reader(colmap("txt"), recording, "sparse/0/*.txt"),
    "wrist": Reader(wrist, recording, "wrist/*.*"),
    "record3d": Reader(folder(test_camera_poses.record3d), recording, "metadata"),
    "euroc": Reader(folder(test_camera_poses.euroc), recording, "mav0/**/*.[cy]*"),
    "scannet": Reader(folder(test_camera_poses.scannet), recording, "*/*.txt"),
    "lerobot-2.1": Reader(lerobot("v2.1"), read_lerobot, "**/*.[jp]*"),
    "lerobot-3.0": Reader(lerobot("v3.0"), read_lerobot, "**/*.[jp]*"),
    "bag-ros1": Reader(bag("ros1"), recording, "*.bag"),
    "bag-sqlite3": Reader(bag("sqlite3"), recording, "wave/*"),
    "bag-mcap": Reader(bag("mcap"), recording, "wave/*"),
    "poses-csv": Reader(poses("poses.csv"), read_robot_poses),
    "poses-json": Reader(poses("poses.json"), read_robot_poses),
    "poses-npy": Reader(poses("poses.npy"), read_robot_poses),
    "poses-npz": Reader(poses("poses.npz"), read_robot_poses),
    "poses-mat": Reader(poses("poses.mat"), read_robot_poses),
    "poses-yaml": Reader(poses("poses.yaml"), read_robot_poses),
    "poses-tum": Reader(poses("poses.tum"), read_robot_poses),
    "camera-text": Reader(file("lens.txt", MATRIX), read_size),
    "camera-json": Reader(
        file("lens.json", json.dumps(LENS.to_dict()).encode()), read_size
    ),
    "camera-ros": Reader(file("lens.yaml", INFO), read_size),
    "camera-kalibr": Reader(file("chain.yaml", CHAIN), read_size),
    "camera-npz": Reader(camera_npz, read_size),
    "camera-opencv-yaml": Reader(lambda root: opencv_storage(root, ".yml"), read_size),
    "camera-opencv-xml": Reader(lambda root: opencv_storage(root, ".xml"), read_size),
    "transform": Reader(matrix, read_transform),
    "image-png": Reader(file("image.png", PNG), read_image),
    "image-jpeg": Reader(file("image.jpg", JPEG), read_image),
}
"""Readers whose files need no map."""


def outcomes(name: str, reader: Reader, root: Path) -> Counter[str]:
    """Damage one file after the other, and count what reading gives."""
    root.mkdir()
    path = reader.make(root)
    reader.read(path)  # undamaged
    files = sorted(path for path in root.glob(reader.pattern) if path.is_file())
    assert files, "there is something to damage"
    counts: Counter[str] = Counter()
    longest = 0.0
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for seed in range(COUNT):
        rng = random.Random(f"{name} {seed}")
        victim = rng.choice(files)
        whole = victim.read_bytes()
        victim.write_bytes(mutated(whole, rng))
        began = time.monotonic()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                reader.read(path)
            counts["read"] += 1
        except InputError as error:
            counts["refused" if len(str(error).splitlines()) == 1 else str(error)] += 1
        except Exception as error:
            raise AssertionError(f"{name}: damage {seed} of {victim.name}") from error
        longest = max(longest, time.monotonic() - began)
        assert longest < LONGEST_S, (name, seed)
        victim.write_bytes(whole)
    peak_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    memory = f"{before_kb / 1000:.0f} to {peak_kb / 1000:.0f} MB"
    print(f"\n{name}: {dict(counts)}, most {longest:.2f} s, {memory}")  # noqa: T201
    assert counts.keys() <= {"read", "refused"}
    return counts


@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_read_or_refused(name: str, tmp_path: Path) -> None:
    assert outcomes(name, READERS[name], tmp_path / "files")["refused"], (
        "some damage is noticed"
    )


def test_damaged_recordings_are_read_or_refused(
    rooms: tuple[Recording, ...], tmp_path: Path
) -> None:
    def make(root: Path) -> Path:
        generic.write(root / "alpha", rooms[0])
        return root / "alpha"

    reader = Reader(make, recording, "alpha/*.json")
    assert outcomes("generic", reader, tmp_path / "files")["refused"]


@pytest.fixture(scope="module")
def hall_folder(
    hall_map: MapContents, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    from evercal.mapping.store import MapStore

    root = tmp_path_factory.mktemp("mutations") / "hall"
    MapStore.create(root).commit(hall_map.scenes[0], {"scene": "hall"})
    return root


def copied(folder: Path) -> Callable[[Path], Path]:
    return lambda root: Path(shutil.copytree(folder, root / folder.name))


def test_a_damaged_map_is_refused(hall_folder: Path, tmp_path: Path) -> None:
    """What differs from its checksum is never answered from."""
    reader = Reader(copied(hall_folder), Map.open, "hall/**/*")
    counts = outcomes("map", reader, tmp_path / "files")
    assert counts["refused"] > 0.5 * COUNT, "report.json and the like are not read"


def test_a_map_of_another_program_is_read_or_refused(
    hall_folder: Path, tmp_path: Path
) -> None:
    """Files are damaged, and their checksums are right."""

    def read(path: Path) -> None:
        manifest = json.loads((path / "manifest.json").read_text())
        write_manifest(path, manifest["payload"], sorted(manifest["files"]))
        Map.open(path)

    reader = Reader(copied(hall_folder), read, "hall/stages/**/*.*")
    outcomes("resealed", reader, tmp_path / "files")


def test_a_damaged_archive_is_refused(hall_folder: Path, tmp_path: Path) -> None:
    def make(root: Path) -> Path:
        Map.open(hall_folder).pack(root / "hall.zip")
        return root / "hall.zip"

    def read(path: Path) -> None:
        out = path.with_name("out")
        try:
            Map.unpack(path, out)
        finally:
            assert [
                p.name for p in path.parent.iterdir() if p.name.endswith(".unpacking")
            ] == []
            shutil.rmtree(out, ignore_errors=True)

    outcomes("archive", Reader(make, read, "*.zip"), tmp_path / "files")


def test_damaged_calibrations_are_read_or_refused(
    hall: Recording, hall_folder: Path, tmp_path: Path
) -> None:
    images = [frame.read_image() for frame in hall.test[3:9]]
    calibration = Map.open(hall_folder).calibrate(images)

    def make(root: Path) -> Path:
        calibration.write(root / "camera.json")
        return root / "camera.json"

    outcomes("calibration", Reader(make, read_calibration), tmp_path / "files")
    outcomes("transform", Reader(make, read_transform), tmp_path / "transform")


def test_damaged_board_poses_are_refused(tmp_path: Path) -> None:
    images = [
        {"image": f"{i}.png", "pose": None, "reason": "no board"} for i in range(3)
    ]

    def make(root: Path) -> Path:
        (root / "board.json").write_text(json.dumps({"format": "x", "images": images}))
        return root / "board.json"

    with pytest.raises(InputError):
        outcomes("board", Reader(make, read_board_poses), tmp_path / "files")
