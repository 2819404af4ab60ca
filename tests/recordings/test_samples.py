"""The packaged recordings: complete and small. tests/rooms compares them with their simulator."""

import json
from pathlib import Path

import numpy as np
import pytest

from evercal.geometry import SE3, pose_distance, pose_distance_mm_deg
from evercal.recordings import load_recording
from evercal.recordings.samples import (
    CELL,
    FOLDER,
    SampleRoom,
    copy_samples,
    sample_rooms,
)

from .checks import refused


@pytest.fixture(scope="module")
def rooms() -> tuple[SampleRoom, ...]:
    return sample_rooms()


def poses(frames: tuple) -> SE3:
    return SE3.stack([frame.base_from_camera for frame in frames])


def test_rooms_are_complete_and_small(rooms: tuple[SampleRoom, ...]) -> None:
    assert [room.scene.name for room in rooms] == ["bedroom", "kitchen", "living"]
    for room in rooms:
        assert (len(room.scene.train), len(room.scene.test)) == (91, 39)
        assert room.scene.test[7].read_image().shape == (240, 320, 3)
        assert room.fixed is not None
        assert len({frame.joints_rad for frame in room.fixed.test}) == 25
        fixed = poses(room.fixed.test)
        metres, radians = pose_distance(fixed, fixed[0])
        assert max(metres.max(), radians.max()) < 1e-9
    assert sum(path.stat().st_size for path in FOLDER.rglob("*")) <= 13e6


def test_bumped_recordings_are_shifted_and_changed_ones_have_no_training_frames(
    rooms: tuple[SampleRoom, ...],
) -> None:
    for room in rooms:
        assert room.fixed is not None
        assert room.bumped is not None
        assert room.changed is not None
        metres, _ = pose_distance(poses(room.fixed.test), poses(room.bumped.test))
        np.testing.assert_allclose(metres, 0.005, atol=1e-9)
        assert (len(room.changed.train), len(room.changed.test)) == (0, 20)


def true_pose(name: str) -> SE3:
    pose = json.loads((CELL / "truth.json").read_text())[name]
    return SE3(np.array(pose["quaternion_wxyz"]), np.array(pose["translation_m"]))


def test_cell_is_complete_and_small() -> None:
    wrist = load_recording(CELL / "wrist")
    assert len(wrist.train) == 60
    assert all(frame.base_from_camera is None for frame in wrist.train)
    assert len(list((CELL / "tripod").glob("*.jpg"))) == 12
    assert sum(path.stat().st_size for path in CELL.rglob("*")) < 2.5e6
    millimetres, degrees = pose_distance_mm_deg(
        true_pose("base_from_camera"), true_pose("base_from_bumped_camera")
    )
    assert millimetres == pytest.approx(5, abs=0.01)
    assert degrees == pytest.approx(0.3, abs=1e-3)


def test_copies_are_complete_and_never_overwrite(tmp_path: Path) -> None:
    target = tmp_path / "new" / "samples"
    copy_samples(target)
    names = sorted(path.name for path in target.iterdir())
    assert names == ["bedroom", "cell", "kitchen", "living"]
    assert len(load_recording(target / "kitchen").train) == 91
    assert len(load_recording(target / "cell/wrist").train) == 60
    refused("not empty", copy_samples, target)
    refused("is a file", copy_samples, target / "cell/bumped.jpg")
