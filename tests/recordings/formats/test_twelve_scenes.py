"""The 12-Scenes folder format, on a small folder written here in the official layout."""

from pathlib import Path

import numpy as np
import pytest

from evercal.continual.benchmark.suites import load_suite
from evercal.geometry import SE3
from evercal.recordings import load_recording, write_image

from ..checks import assert_pose, refused

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
SPLIT = "sequence0 [frames=2]  [start=0 ; end=1]\nsequence1 [frames=3]  [start=2 ; end=4]\n"


def write(root: Path) -> Path:
    """Five frames of 64x48, the fourth of them untracked."""
    (root / "data").mkdir(parents=True)
    (root / "info.txt").write_text(INFO)
    (root / "split.txt").write_text(SPLIT)
    for i in range(5):
        stem = root / "data" / f"frame-{i:06d}"
        write_image(stem.with_suffix(".color.jpg"), np.full((48, 64, 3), 40 * i, np.uint8))
        matrix = SE3.exp([1.0, i, 0.0, 0.1 * i, 0.2, 0.3]).matrix()
        if i == 3:
            matrix[:] = -np.inf
        rows = (" ".join(f"{value:.7f}" for value in row) for row in matrix)
        stem.with_suffix(".pose.txt").write_text("\n".join(rows) + "\n")
    return root


@pytest.fixture
def apartment(tmp_path: Path) -> Path:
    return write(tmp_path / "apt1" / "kitchen")


def test_first_sequence_is_for_testing(apartment: Path) -> None:
    recording = load_recording(apartment)
    assert recording.name == "kitchen"
    assert [frame.name for frame in recording.test] == ["frame-000000", "frame-000001"]
    assert [frame.name for frame in recording.train] == ["frame-000002", "frame-000004"]
    assert recording.untracked == 1
    pose = recording.train[1].base_from_camera
    assert_pose(pose, SE3.exp([1.0, 4, 0.0, 0.4, 0.2, 0.3]), 1e-5)
    assert abs(float(recording.train[1].read_image().mean()) - 160) < 2


def test_camera_is_scaled_to_the_images(apartment: Path) -> None:
    camera = load_recording(apartment).train[0].camera
    assert (camera.width, camera.height, camera.fx, camera.fy) == (64, 48, 58, 57)
    # The corner of the image stays where it is: (65.5 + 0.5) / 2 - 0.5.
    assert (camera.cx, camera.cy) == (32.5, 23.5)


def test_suite_loads_scenes_and_names_missing_ones(apartment: Path) -> None:
    data = apartment.parents[1]
    write(data / "apt1" / "living")
    scenes = load_suite("i12s", data, ["apt1/living", "apt1/kitchen"])
    assert [recording.name for recording in scenes] == ["apt1-kitchen", "apt1-living"]
    refused("apt2/bed is missing; get it from https://graphics", load_suite, "i12s", data)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("split.txt", None, r"split\.txt: .*is missing"),
        ("split.txt", "sequence0 frames=2", r"split\.txt: the first line holds no"),
        ("split.txt", "sequence0 [frames=9]", r"split\.txt: 9 test frames, but .* has 5 images"),
        ("info.txt", "m_colorWidth = 128", r"info\.txt: needs m_colorWidth"),
        ("info.txt", INFO.replace("116 0 65.5", "wide"), r"info\.txt: needs m_colorWidth"),
        ("data/frame-000002.pose.txt", "1 0 0", r"frame-000002\.pose\.txt: expected a 4x4"),
        ("data/frame-000002.pose.txt", None, r"frame-000002\.pose\.txt: .*is missing"),
        ("data/*.jpg", None, "no images"),
    ],
)
def test_broken_files_are_refused(
    apartment: Path, file: str, text: str | None, message: str
) -> None:
    for path in apartment.glob(file):
        path.unlink() if text is None else path.write_text(text)
    refused(message, load_recording, apartment)
