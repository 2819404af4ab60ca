"""`benchmarks guard`: recordings that every build reads, and what rows say."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.guard import summary
from benchmarks.guard_recordings import all_cases, far_cases, write
from benchmarks.rows import Row
from evercal.recordings import load_recording
from evercal.recordings.frame import Recording
from evercal.recordings.samples import sample_rooms


@pytest.fixture(scope="module")
def few() -> Recording:
    scene = sample_rooms()[0].scene
    return replace(scene, train=scene.train[:2], test=scene.test[:1])


def test_recordings_are_read_as_they_were_written(
    few: Recording, tmp_path: Path
) -> None:
    write(tmp_path / "few", few)
    read = load_recording(tmp_path / "few")
    assert (len(read.train), len(read.test)) == (2, 1)
    for frame, same in zip(few.train + few.test, read.train + read.test, strict=True):
        assert frame.base_from_camera is not None
        assert same.base_from_camera is not None
        change = frame.base_from_camera.inverse() @ same.base_from_camera
        assert np.abs(change.log()).max() < 1e-9
        assert same.camera == frame.camera
        assert (same.read_image() == frame.read_image()).all()


def test_names_of_recordings_are_unique(tmp_path: Path) -> None:
    cases = [*all_cases(None), *far_cases(tmp_path)]
    names = [name for case in cases for name in case.make]
    assert len({*names}) == len(names)
    assert "stabilised-living-3px" in names


def test_refused_images_count_in_accuracy_and_not_in_ellipsoids() -> None:
    seconds: Row = {"ask_s": 0.5, "learn_s": 2.0}
    lie: Row = {"status": "ok", "mm": 15.0, "deg": 0.5, "position": 30.0, "pose": 40.0}
    right: Row = {"status": "ok", "mm": 5.0, "deg": 0.1, "position": 2.0, "pose": 5.0}
    refused: Row = {"status": "unknown_scene"}
    row = summary([seconds | answer for answer in (lie, right, refused, right)])
    assert (row["n"], row["2_cm"], row["1_cm"], row["refused"]) == (4, 75, 50, 25)
    for inside in ("inside_position", "inside_pose"):
        assert row[inside] == pytest.approx(200 / 3)
    assert (row["wrong"], row["ask_s"], row["learn_s"]) == (1, 2, 2)
