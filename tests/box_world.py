"""A box room, frames of it with any distortion, and an encoder that needs no training."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from evercal.geometry import SE3, Camera
from evercal.recordings.frame import Frame, Recording
from evercal.simulation.box_room import BoxRoom, default_camera

from .encoders import BlockMean

Shoot = Callable[[Camera, SE3], Frame]


def render_distorted(room: BoxRoom, camera: Camera, pose: SE3) -> np.ndarray:
    """(h, w, 3) image of a camera with distortion: a fine ideal image, distorted by pixel."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(float)
    rays = camera.unproject(np.stack([u, v], -1))
    low = rays.reshape(-1, 3).min(0) - 0.02
    high = rays.reshape(-1, 3).max(0) + 0.02
    focal = 2.0 * camera.fx
    width, height = (int(np.ceil(side * focal)) for side in (high - low)[:2])
    ideal = Camera(width, height, focal, focal, -low[0] * focal, -low[1] * focal)
    image = room.render(ideal, pose)
    image = cv2.GaussianBlur(image, (0, 0), 0.6)
    where = ideal.project(rays).astype(np.float32)
    return cv2.remap(image, where, None, cv2.INTER_LINEAR)  # type: ignore[call-overload]


def box_room_scene(
    seed: int, train: int, test: int, camera: Camera | None = None
) -> Recording:
    """A recording `box-room-SEED`: one sweep of training frames and another of test frames."""
    room = BoxRoom(seed)
    intrinsics = camera or default_camera()

    def record(split: str, count: int, path_seed: int) -> tuple[Frame, ...]:
        poses = room.path(count, path_seed)
        return tuple(
            Frame(
                f"{split}-{i:06d}",
                room.render(intrinsics, poses[i]),
                intrinsics,
                poses[i],
            )
            for i in range(count)
        )

    name = f"box-room-{seed}"
    return Recording(name, record("train", train, 1), record("test", test, 2))


@pytest.fixture(scope="session")
def box() -> BoxRoom:
    return BoxRoom(41, furniture=5, texture_px=160)


@pytest.fixture(scope="session")
def shoot(box: BoxRoom) -> Shoot:
    """Takes a frame with a camera at a pose."""

    def take(camera: Camera, pose: SE3) -> Frame:
        image = (
            render_distorted(box, camera, pose)
            if camera.distortion
            else box.render(camera, pose)
        )
        return Frame("frame", image, camera, pose)

    return take


@pytest.fixture(scope="session")
def block_mean() -> BlockMean:
    return BlockMean()
