"""The packaged recordings: complete, small, and equal to what the simulator states."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance, pose_distance_mm_deg
from evercal.recordings import load_recording
from evercal.recordings.samples import CELL, FOLDER, SampleRoom, copy_samples, sample_rooms
from evercal.simulation.cell import SUITES
from evercal.simulation.cell_paths import changed_shots
from evercal.simulation.changed_room import changed_room
from evercal.simulation.furnished.rooms import room as simulated_room
from evercal.simulation.untextured import untextured_renders


@pytest.fixture(scope="module")
def rooms() -> tuple[SampleRoom, ...]:
    return sample_rooms()


def poses(frames: tuple) -> SE3:
    return SE3.stack([frame.base_from_camera for frame in frames])


def edge_correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Correlation of the edge strengths of two images; 1 for the same image."""

    def edges(image: np.ndarray) -> np.ndarray:
        grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (0, 0), 1.5)
        return np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))

    return float(np.corrcoef(edges(a).ravel(), edges(b).ravel())[0, 1])


def test_rooms_are_complete_and_small(rooms: tuple[SampleRoom, ...]) -> None:
    assert [room.scene.name for room in rooms] == ["bedroom", "kitchen", "living"]
    for room in rooms:
        assert (len(room.scene.train), len(room.scene.test)) == (91, 39)
        assert room.scene.test[7].read_image().shape == (240, 320, 3)
        assert room.fixed is not None
        assert len({frame.joints_rad for frame in room.fixed.test}) == 25
        metres, radians = pose_distance(poses(room.fixed.test), poses(room.fixed.test)[0])
        assert max(metres.max(), radians.max()) < 1e-9
    assert sum(path.stat().st_size for path in FOLDER.rglob("*")) <= 13e6


@pytest.mark.slow
def test_bumped_and_changed_recordings_match_the_simulator(rooms: tuple[SampleRoom, ...]) -> None:
    for room, (name, kind, seed) in zip(rooms, SUITES["sim-mini"].rooms, strict=True):
        assert room.fixed is not None
        assert room.bumped is not None
        metres, radians = pose_distance(poses(room.fixed.test), poses(room.bumped.test))
        np.testing.assert_allclose(metres, 0.005, atol=1e-9)
        assert radians.max() < 1e-9
        assert room.changed is not None
        assert (room.changed.name, len(room.changed.train)) == (f"{name}-changed", 0)
        after, train = changed_room(simulated_room(kind, seed), 0), poses(room.scene.train)
        shots = changed_shots(after, 20, train, seed=0)
        expected = [shot.base_from_camera.matrix() for shot in shots]
        np.testing.assert_allclose(poses(room.changed.test).matrix(), expected, atol=1e-6)


@pytest.mark.slow
def test_untextured_renders_align_with_the_images(rooms: tuple[SampleRoom, ...]) -> None:
    pytest.importorskip("mitsuba", reason="the extra 'sim' is not installed")
    frame = rooms[1].scene.test[5]
    pose = frame.base_from_camera
    assert pose is not None
    wrong_pose = pose @ SE3.exp([0.1, 0.05, 0, 0, 0, 0.05])
    right, wrong = untextured_renders(
        SUITES["sim-mini"].rooms[1][1:], [frame, frame], [pose, wrong_pose]
    )
    image = frame.read_image()
    assert right.shape == image.shape
    assert edge_correlation(image, right) > edge_correlation(image, wrong) + 0.2


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
    assert sorted(path.name for path in target.iterdir()) == [
        "bedroom",
        "cell",
        "kitchen",
        "living",
    ]
    assert len(load_recording(target / "kitchen").train) == 91
    assert len(load_recording(target / "cell/wrist").train) == 60
    with pytest.raises(InputError, match="not empty"):
        copy_samples(target)
    with pytest.raises(InputError, match="is a file"):
        copy_samples(target / "cell/bumped.jpg")
