"""A box room, frames of it through any lens, and networks that need no training."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from evercal.continual.networks.buffer import FeatureBuffer
from evercal.continual.networks.descriptor import GlobalDescriptor
from evercal.features.views import View, cell_centres
from evercal.geometry import SE3, Camera
from evercal.recordings.frame import Frame
from evercal.simulation.box_room import BoxRoom

Shoot = Callable[[Camera, SE3], Frame]
Learnable = Callable[..., tuple[FeatureBuffer, Tensor]]

CAMERA = Camera(160, 120, 131.0, 128.0, 79.5, 59.5)
CHANNELS = 48
ATLAS_FROM_BASE = SE3.exp([5.0, -5.0, 0.0, 0.0, 0.0, 0.7])


def through_lens(room: BoxRoom, camera: Camera, pose: SE3) -> np.ndarray:
    """(h, w, 3) what a camera with distortion sees: a fine ideal image, bent pixel by pixel."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(float)
    rays = camera.unproject(np.stack([u, v], -1))
    low, high = rays.reshape(-1, 3).min(0) - 0.02, rays.reshape(-1, 3).max(0) + 0.02
    focal = 2.0 * camera.fx
    width, height = (int(np.ceil(side * focal)) for side in (high - low)[:2])
    ideal = Camera(width, height, focal, focal, -low[0] * focal, -low[1] * focal)
    image = room.render(ideal, pose)
    image = cv2.GaussianBlur(image, (0, 0), 0.6)
    where = ideal.project(rays).astype(np.float32)
    return cv2.remap(image, where, None, cv2.INTER_LINEAR)  # type: ignore[call-overload]


@pytest.fixture(scope="session")
def box() -> BoxRoom:
    return BoxRoom(41, furniture=5, texture_px=160)


@pytest.fixture(scope="session")
def shoot(box: BoxRoom) -> Shoot:
    """Takes a frame with a camera at a pose."""

    def take(camera: Camera, pose: SE3) -> Frame:
        image = through_lens(box, camera, pose) if camera.distortion else box.render(camera, pose)
        return Frame("frame", image, camera, pose)

    return take


class BlockMean:
    """An encoder of one channel: the mean grey value of each cell."""

    stride, width = 8, 1

    def __call__(self, grey: Tensor) -> Tensor:
        return F.avg_pool2d(grey, 8)


@pytest.fixture(scope="session")
def block_mean() -> BlockMean:
    return BlockMean()


@pytest.fixture(scope="session")
def describe() -> GlobalDescriptor:
    torch.manual_seed(1)
    return GlobalDescriptor(1, maps=2, hidden=4, width=6).eval()


@pytest.fixture(scope="session")
def learnable(box: BoxRoom) -> Learnable:
    """A buffer of a box room whose features are waves of the true point; and those points."""
    waves = np.random.default_rng(0).normal(0, 0.6, (CHANNELS // 2, 3))

    def make(
        scene: int = 0, views: int = 6, lens: Camera | None = None, correctable: bool = False
    ) -> tuple[FeatureBuffer, Tensor]:
        rng = np.random.default_rng(scene)
        buffer = FeatureBuffer(scene, ATLAS_FROM_BASE, correctable)
        everything = []
        for _ in range(views):
            pose, pixels = box.random_view(rng), cell_centres(120, 160, 8)
            rays = (lens or CAMERA).unproject(pixels) @ pose.rotation_matrix().T
            points, _ = box.intersect(pose.translation_m, rays)
            phase = points @ waves.T
            features = np.concatenate([np.sin(phase), np.cos(phase)], 1)
            grid = torch.from_numpy(features.T.reshape(1, CHANNELS, 15, 20)).float()
            intrinsics = np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy], np.float32)
            grey, valid = np.zeros((120, 160), np.uint8), np.ones(300, bool)
            view = View(grey, pixels.astype(np.float32), valid, intrinsics, pose)
            descriptor = torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=(1, 6))))
            buffer.add([view], grid, descriptor, torch.ones(1, 300, dtype=torch.bool))
            everything.append(torch.from_numpy(ATLAS_FROM_BASE.apply(points)).float())
        return buffer, torch.cat(everything)

    return make
