"""The 7-Scenes folder format."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from evercal.geometry import SE3, Camera, pose_distance
from evercal.recordings import load_recording, write_image
from evercal.recordings.formats import seven_scenes

from ..checks import refused


def write_pose(file: Path, matrix: np.ndarray) -> None:
    rows = ("\t ".join(f" {value: .7e}" for value in row) for row in matrix)
    file.write_text("\n".join(rows) + "\n")


@pytest.fixture
def kitchen(tmp_path: Path) -> Path:
    """Two training sequences and one test sequence of three frames, 64x48."""
    root = tmp_path / "kitchen"
    root.mkdir()
    (root / "TrainSplit.txt").write_text("sequence2\r\nsequence1 \n\n")
    (root / "TestSplit.txt").write_text("sequence3")
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    for sequence in (1, 2, 3):
        folder = root / f"seq-{sequence:02d}"
        folder.mkdir()
        for i in range(3):
            write_image(folder / f"frame-{i:06d}.color.png", image)
            pose = SE3.exp([sequence, i, 0.0, 0.1 * i, 0.2, 0.3 * sequence])
            write_pose(folder / f"frame-{i:06d}.pose.txt", pose.matrix())
    return root


def test_frames_are_in_the_order_of_the_split_files(kitchen: Path) -> None:
    recording = seven_scenes.load(kitchen)
    assert recording.name == "kitchen"
    assert [frame.name for frame in recording.train] == [
        f"seq-0{sequence}/frame-00000{i}" for sequence in (2, 1) for i in range(3)
    ]
    assert [frame.name for frame in recording.test] == [f"seq-03/frame-00000{i}" for i in range(3)]
    assert recording.untracked == 0
    frame = recording.train[1]
    assert frame.base_from_camera is not None
    expected = SE3.exp([2, 1, 0.0, 0.1, 0.2, 0.6])
    assert max(pose_distance(frame.base_from_camera, expected)) < 1e-6
    assert frame.read_image().shape == (48, 64, 3)


def test_camera_is_the_default_or_that_of_the_intrinsics_file(kitchen: Path) -> None:
    assert seven_scenes.load(kitchen).train[0].camera == Camera(64, 48, 52.5, 52.5, 31.5, 23.5)
    (kitchen / "camera-intrinsics.txt").write_text("51 0 30\n0 52 23.5\n0 0 1\n")
    assert seven_scenes.load(kitchen).test[0].camera == Camera(64, 48, 51.0, 52.0, 30.0, 23.5)


def test_untracked_frames_are_left_out_and_counted(kitchen: Path) -> None:
    write_pose(kitchen / "seq-01/frame-000001.pose.txt", np.full((4, 4), np.inf))
    write_pose(kitchen / "seq-03/frame-000000.pose.txt", np.full((4, 4), np.nan))
    recording = seven_scenes.load(kitchen)
    assert recording.untracked == 2
    names = [frame.name for frame in (*recording.train, *recording.test)]
    assert not {"seq-01/frame-000001", "seq-03/frame-000000"} & set(names)


def test_rotation_with_few_digits_and_jpeg_frames_are_accepted(kitchen: Path) -> None:
    file = kitchen / "seq-01/frame-000001.pose.txt"
    drifted = np.loadtxt(file)
    drifted[:3, :3] *= 1.001
    write_pose(file, drifted)
    image = kitchen / "seq-01/frame-000001.color.png"
    write_image(image.with_suffix(".jpg"), np.zeros((48, 64, 3), np.uint8))
    image.unlink()
    frame = seven_scenes.load(kitchen).train[4]
    assert frame.base_from_camera is not None
    rotation = frame.base_from_camera.rotation_matrix()
    np.testing.assert_allclose(rotation, drifted[:3, :3] / 1.001, atol=1e-6)
    assert int(frame.read_image().max()) == 0


POSE = "seq-02/frame-000002.pose.txt"
BREAKS = [
    ("TestSplit.txt", None, r"TestSplit\.txt: split file is missing"),
    ("TestSplit.txt", b"office", r"TestSplit\.txt.*'office'"),
    ("TestSplit.txt", b"sequence9", r"TestSplit\.txt.*seq-09"),
    ("TestSplit.txt", b"sequence1", "seq-01 is in both"),
    ("TestSplit.txt", b"\xff\xfe", r"TestSplit\.txt: .*not a text file"),
    ("*Split.txt", b"\n", "are empty"),
    ("seq-02/*.png", None, "seq-02: no images"),
    (POSE, None, r"seq-02/frame-000002\.pose\.txt: .*is missing"),
    (POSE, b"1 2 3", r"frame-000002\.pose\.txt: expected.*got 3 words"),
    (POSE, b"x " * 16, r"frame-000002\.pose\.txt: expected"),
    (POSE, b"", r"frame-000002\.pose\.txt: expected"),
    (POSE, b"2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1", r"frame-000002\.pose\.txt: the left 3x3 block"),
    ("seq-02/frame-000000.color.png", b"no image", r"color\.png: not a readable image"),
    ("seq-02/frame-000000.color.jpg", b"", r"frame-000000\.color is there as \.png and as \.jpg"),
    ("camera-intrinsics.txt", b"525 525", r"camera-intrinsics\.txt: expected a 3x3"),
    ("camera-intrinsics.txt", b"0 0 0 0 0 0 0 0 1", r"camera-intrinsics\.txt: camera fx"),
]


@pytest.mark.parametrize(("file", "content", "message"), BREAKS)
def test_broken_files_are_refused_in_one_line(
    kitchen: Path, file: str, content: bytes | None, message: str
) -> None:
    for path in list(kitchen.glob(file)) or [kitchen / file]:
        path.unlink() if content is None else path.write_bytes(content)
    refused(message, load_recording, kitchen)


def test_missing_folders_are_refused(kitchen: Path) -> None:
    for folder, message in ((kitchen / "seq-02", "seq-02"), (kitchen, "no such folder")):
        shutil.rmtree(folder)
        refused(message, load_recording, kitchen)
