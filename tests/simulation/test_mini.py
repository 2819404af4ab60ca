"""The rooms that come with the package: complete, small, honest; grey views lie over them."""

import cv2
import numpy as np
import pytest

from evercal.geometry import SE3, pose_distance
from evercal.simulation.mini import FOLDER, CellRoom, mini_rooms, untextured_renders


@pytest.fixture(scope="module")
def rooms() -> tuple[CellRoom, ...]:
    return mini_rooms()


def poses(frames: tuple) -> SE3:
    return SE3.stack([frame.base_from_camera for frame in frames])


def test_three_rooms_in_twelve_megabytes(rooms: tuple[CellRoom, ...]) -> None:
    assert [room.scene.name for room in rooms] == ["bedroom", "kitchen", "living"]
    for room in rooms:
        assert (len(room.scene.train), len(room.scene.test)) == (91, 39)
        assert room.scene.test[7].read_image().shape == (240, 320, 3)
        assert room.fixed is not None
        assert len(room.fixed.test) == 25
        apart, angle = pose_distance(poses(room.fixed.test), poses(room.fixed.test)[0])
        assert max(apart.max(), angle.max()) < 1e-9
        assert len({frame.joints_rad for frame in room.fixed.test}) == 25
    assert sum(path.stat().st_size for path in FOLDER.rglob("*")) <= 12e6


def test_test_frames_are_not_training_frames(rooms: tuple[CellRoom, ...]) -> None:
    for room in rooms:
        train, test = poses(room.scene.train), poses(room.scene.test)
        metres, radians = pose_distance(test[:, None], train[None])
        near = ((metres < 0.05) & (radians < np.deg2rad(5))).any(1)
        same = (metres < 0.01) & (radians < np.deg2rad(1))
        assert near.mean() <= 0.1
        assert not same.any()


def test_clay_views_lie_over_the_images(rooms: tuple[CellRoom, ...]) -> None:
    pytest.importorskip("mitsuba", reason="the extra 'sim' is not installed")
    room = rooms[1]
    assert room.model is not None
    frame = room.scene.test[5]
    pose = frame.base_from_camera
    assert pose is not None
    off = pose @ SE3.exp([0.1, 0.05, 0, 0, 0, 0.05])
    right, wrong = untextured_renders(room.model, [frame, frame], [pose, off])
    assert right.shape == frame.read_image().shape

    def edges(image: np.ndarray) -> np.ndarray:
        grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (0, 0), 1.5)
        return np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))

    seen = edges(frame.read_image()).ravel()
    agreement = [np.corrcoef(seen, edges(view).ravel())[0, 1] for view in (right, wrong)]
    assert agreement[0] > agreement[1] + 0.2
