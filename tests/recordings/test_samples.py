"""The rooms that come with the package: complete, small, honest; grey views lie over them."""

import cv2
import numpy as np
import pytest

from evercal.geometry import SE3, pose_distance
from evercal.recordings.samples import FOLDER, SampleRoom, sample_rooms
from evercal.simulation.cell import SUITES
from evercal.simulation.cell_paths import changed_shots
from evercal.simulation.changed_room import changed_room
from evercal.simulation.furnished.rooms import room as simulated
from evercal.simulation.untextured import untextured_renders


@pytest.fixture(scope="module")
def rooms() -> tuple[SampleRoom, ...]:
    return sample_rooms()


def poses(frames: tuple) -> SE3:
    return SE3.stack([frame.base_from_camera for frame in frames])


def alike(a: np.ndarray, b: np.ndarray) -> float:
    """How well the edges of two images lie over each other; 1 is the same image."""

    def edges(image: np.ndarray) -> np.ndarray:
        grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (0, 0), 1.5)
        return np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))

    return float(np.corrcoef(edges(a).ravel(), edges(b).ravel())[0, 1])


def test_three_rooms_are_complete_and_small(rooms: tuple[SampleRoom, ...]) -> None:
    assert [room.scene.name for room in rooms] == ["bedroom", "kitchen", "living"]
    for room in rooms:
        assert (len(room.scene.train), len(room.scene.test)) == (91, 39)
        assert room.scene.test[7].read_image().shape == (240, 320, 3)
        assert room.fixed is not None
        assert len(room.fixed.test) == 25
        apart, angle = pose_distance(poses(room.fixed.test), poses(room.fixed.test)[0])
        assert max(apart.max(), angle.max()) < 1e-9
        assert len({frame.joints_rad for frame in room.fixed.test}) == 25
    assert sum(path.stat().st_size for path in FOLDER.rglob("*")) <= 13e6


def test_bumped_and_changed_recordings_match_the_simulator(rooms: tuple[SampleRoom, ...]) -> None:
    for room, (name, kind, seed) in zip(rooms, SUITES["sim-mini"].rooms, strict=True):
        assert room.fixed is not None
        assert room.bumped is not None
        metres, angle = pose_distance(poses(room.fixed.test), poses(room.bumped.test))
        np.testing.assert_allclose(metres, 0.005, atol=1e-9)
        assert angle.max() < 1e-9
        assert room.changed is not None
        assert (room.changed.name, len(room.changed.train)) == (f"{name}-changed", 0)
        assert {frame.read_image().shape for frame in room.changed.test} == {(240, 320, 3)}
        # What is in the package is what the simulator's room and paths are today.
        after, train = changed_room(simulated(kind, seed), 0), poses(room.scene.train)
        shots = changed_shots(after, 20, train, seed=0)
        changed_poses = poses(room.changed.test).matrix()
        np.testing.assert_allclose(
            changed_poses, [shot.base_from_camera.matrix() for shot in shots], atol=1e-6
        )
        assert not np.allclose(changed_poses, poses(room.scene.test[:20]).matrix(), atol=1e-2)
        joints = {frame.joints_rad for frame in room.scene.train + room.scene.test}
        assert not joints & {frame.joints_rad for frame in room.changed.test}
    assert (SampleRoom(rooms[0].scene).bumped, SampleRoom(rooms[0].scene).changed) == (None, None)


def test_test_frames_differ_from_training_frames(rooms: tuple[SampleRoom, ...]) -> None:
    for room in rooms:
        train, test = poses(room.scene.train), poses(room.scene.test)
        metres, radians = pose_distance(test[:, None], train[None])
        near = ((metres < 0.05) & (radians < np.deg2rad(5))).any(1)
        same = (metres < 0.01) & (radians < np.deg2rad(1))
        assert near.mean() <= 0.1
        assert not same.any()


def test_untextured_renders_match_the_images(rooms: tuple[SampleRoom, ...]) -> None:
    pytest.importorskip("mitsuba", reason="the extra 'sim' is not installed")
    room = rooms[1]
    frame = room.scene.test[5]
    pose = frame.base_from_camera
    assert pose is not None
    off = pose @ SE3.exp([0.1, 0.05, 0, 0, 0, 0.05])
    right, wrong = untextured_renders(SUITES["sim-mini"].rooms[1][1:], [frame, frame], [pose, off])
    assert right.shape == frame.read_image().shape
    image = frame.read_image()
    assert alike(image, right) > alike(image, wrong) + 0.2
