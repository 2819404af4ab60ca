"""The folder formats of 7-Scenes and 12-Scenes."""

import shutil
import time
from pathlib import Path

import numpy as np
import pytest

from evercal.continual.benchmark.suites import load_suite
from evercal.geometry import SE3, Camera
from evercal.recordings import load_recording, write_image

from ..checks import assert_pose, refused


def write_pose(file: Path, matrix: np.ndarray) -> None:
    np.savetxt(file, matrix, " % .7e", delimiter="\t ")


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
    recording = load_recording(kitchen)
    assert recording.name == "kitchen"
    names = [frame.name for frame in (*recording.train, *recording.test)]
    assert names == [f"seq-0{s}/frame-00000{i}" for s in (2, 1, 3) for i in range(3)]
    assert (len(recording.test), recording.untracked) == (3, 0)
    frame = recording.train[1]
    assert_pose(frame.base_from_camera, SE3.exp([2, 1, 0.0, 0.1, 0.2, 0.6]), 1e-6)
    assert frame.read_image().shape == (48, 64, 3)


def test_camera_is_the_default_or_that_of_the_intrinsics_file(kitchen: Path) -> None:
    default = Camera(64, 48, 52.5, 52.5, 31.5, 23.5)
    assert load_recording(kitchen).train[0].camera == default
    (kitchen / "camera-intrinsics.txt").write_text("51 0 30\n0 52 23.5\n0 0 1\n")
    stated = Camera(64, 48, 51.0, 52.0, 30.0, 23.5)
    assert load_recording(kitchen).test[0].camera == stated


def test_untracked_frames_are_left_out_and_counted(kitchen: Path) -> None:
    write_pose(kitchen / "seq-01/frame-000001.pose.txt", np.full((4, 4), np.inf))
    write_pose(kitchen / "seq-03/frame-000000.pose.txt", np.full((4, 4), np.nan))
    recording = load_recording(kitchen)
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
    frame = load_recording(kitchen).train[4]
    assert frame.base_from_camera is not None
    rotation = frame.base_from_camera.rotation_matrix()
    np.testing.assert_allclose(rotation, drifted[:3, :3] / 1.001, atol=1e-6)
    assert int(frame.read_image().max()) == 0


INFO = """m_versionNumber = 4
m_sensorName = StructureSensor
m_colorWidth = 128
m_colorHeight = 96
m_depthWidth = 64
m_depthHeight = 48
m_depthShift = 1000
m_calibrationColorIntrinsic = 116 0 65.5 0 0 114 47.5 0 0 0 1 0 0 0 0 1
m_calibrationColorExtrinsic = 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1
m_frames.size = 5
"""
SPLIT = (
    "sequence0 [frames=2]  [start=0 ; end=1]\nsequence1 [frames=3]  [start=2 ; end=4]\n"
)


def write(root: Path) -> Path:
    """Five frames of 64x48, the fourth of them untracked."""
    (root / "data").mkdir(parents=True)
    (root / "info.txt").write_text(INFO)
    (root / "split.txt").write_text(SPLIT)
    for i in range(5):
        stem = root / "data" / f"frame-{i:06d}"
        image = np.full((48, 64, 3), 40 * i, np.uint8)
        write_image(stem.with_suffix(".color.jpg"), image)
        matrix = SE3.exp([1.0, i, 0.0, 0.1 * i, 0.2, 0.3]).matrix()
        if i == 3:
            matrix[:] = -np.inf
        np.savetxt(stem.with_suffix(".pose.txt"), matrix, "%.7f")
    return root


@pytest.fixture
def apartment(tmp_path: Path) -> Path:
    return write(tmp_path / "apt1" / "kitchen")


def test_first_sequence_is_for_testing(apartment: Path) -> None:
    recording = load_recording(apartment)
    assert recording.name == "kitchen"
    names = [frame.name[-1] for frame in (*recording.test, *recording.train)]
    assert (names, len(recording.test)) == (["0", "1", "2", "4"], 2)
    assert recording.untracked == 1
    pose = recording.train[1].base_from_camera
    assert_pose(pose, SE3.exp([1.0, 4, 0.0, 0.4, 0.2, 0.3]), 1e-5)
    assert abs(float(recording.train[1].read_image().mean()) - 160) < 2


def test_intrinsics_are_scaled_to_the_images(apartment: Path) -> None:
    camera = load_recording(apartment).train[0].camera
    assert (camera.width, camera.height, camera.fx, camera.fy) == (64, 48, 58, 57)
    # The corner of the image stays where it is: (65.5 + 0.5) / 2 - 0.5.
    assert (camera.cx, camera.cy) == (32.5, 23.5)


def test_suite_loads_scenes_and_names_missing_ones(apartment: Path) -> None:
    data = apartment.parents[1]
    write(data / "apt1" / "living")
    scenes = load_suite("i12s", data, ["apt1/living", "apt1/kitchen"])
    assert [recording.name for recording in scenes] == ["apt1-kitchen", "apt1-living"]
    message = "apt2/bed is missing; get it from https://graphics"
    refused(message, load_suite, "i12s", data)


POSE = "seq-02/frame-000002.pose.txt"
SEVEN = [
    ("TestSplit.txt", None, r"TestSplit\.txt: split file is missing"),
    ("TestSplit.txt", b"office", r"TestSplit\.txt.*'office'"),
    ("TestSplit.txt", b"sequence9", r"TestSplit\.txt.*seq-09"),
    ("TestSplit.txt", b"sequence1", "seq-01 comes twice in TrainSplit.txt and Test"),
    ("TestSplit.txt", b"\x89PNG\r\n\x1a\n", r"TestSplit\.txt: .*not a text file"),
    ("*Split.txt", b"\n", "are empty"),
    ("seq-02/*.png", None, "seq-02: no images"),
    (POSE, None, r"seq-02/frame-000002\.pose\.txt: .*is missing"),
    (POSE, b"1 2 3", r"frame-000002\.pose\.txt: expected.*got 3"),
    (POSE, b"x " * 16, r"frame-000002\.pose\.txt: expected"),
    (POSE, b"", r"frame-000002\.pose\.txt: expected"),
    (
        POSE,
        b"2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1",
        r"frame-000002\.pose\.txt: the left 3x3 block",
    ),
    ("seq-0*/*.png", b"no image", r"color\.png: not a readable image"),
    ("seq-02/frame-000000.color.jpg", b"", "'frame-000000' comes twice; keep its"),
    (
        "camera-intrinsics.txt",
        b"525 525",
        r"camera-intrinsics\.txt: .* 9 numbers, got 2",
    ),
    (
        "camera-intrinsics.txt",
        b"0 0 0 0 0 0 0 0 1",
        r"camera-intrinsics\.txt: camera fx",
    ),
]
TWELVE = [
    ("split.txt", None, r"split\.txt: .*is missing"),
    ("split.txt", b"sequence0 frames=2", r"split\.txt: the first line holds no"),
    (
        "split.txt",
        b"sequence0 [frames=9]",
        r"split\.txt: 9 test frames, but .* has 5 images",
    ),
    ("info.txt", b"m_colorWidth = 128", r"info\.txt: 'camera_matrix' is missing"),
    (
        "info.txt",
        INFO.replace("116 0 65.5", "wide").encode(),
        r"info\.txt: 'camera_matrix' is missing",
    ),
    (
        "data/frame-000002.pose.txt",
        b"1 0 0",
        r"frame-000002\.pose\.txt: expected a 4x4",
    ),
    ("data/frame-000002.pose.txt", None, r"frame-000002\.pose\.txt: .*is missing"),
    ("data/*.jpg", None, "no images"),
]


@pytest.mark.parametrize(
    ("scene", "file", "content", "message"),
    [*(("kitchen", *row) for row in SEVEN), *(("apartment", *row) for row in TWELVE)],
)
def test_broken_files_are_refused(
    request: pytest.FixtureRequest,
    scene: str,
    file: str,
    content: bytes | None,
    message: str,
) -> None:
    root = request.getfixturevalue(scene)
    for path in list(root.glob(file)) or [root / file]:
        path.unlink() if content is None else path.write_bytes(content)
    refused(message, load_recording, root)


def test_missing_folders_are_refused(kitchen: Path) -> None:
    for folder, message in (
        (kitchen / "seq-02", "seq-02"),
        (kitchen, "no such folder"),
    ):
        shutil.rmtree(folder)
        refused(message, load_recording, kitchen)


def test_blank_lines_of_a_calibration_cost_nothing(apartment: Path) -> None:
    info = apartment / "info.txt"
    before = load_recording(apartment)
    info.write_text("\n" * 100_000 + info.read_text())
    began = time.process_time()
    assert load_recording(apartment).train[0].camera == before.train[0].camera
    assert time.process_time() - began < 2
