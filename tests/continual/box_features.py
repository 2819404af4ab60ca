"""Networks and features of a box room that need no training."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from evercal.continual.networks.buffer import FeatureBuffer
from evercal.continual.networks.descriptor import GlobalDescriptor
from evercal.continual.networks.head import Head, HeadOptions, fresh_head
from evercal.features.views import View, cell_centres
from evercal.geometry import SE3, Camera
from evercal.simulation.box_room import BoxRoom

Learnable = Callable[..., tuple[FeatureBuffer, Tensor]]

CAMERA = Camera(160, 120, 131.0, 128.0, 79.5, 59.5)
CHANNELS = 48
ATLAS_FROM_BASE = SE3.exp([5.0, -5.0, 0.0, 0.0, 0.0, 0.7])


@pytest.fixture(scope="session")
def describe() -> GlobalDescriptor:
    torch.manual_seed(1)
    return GlobalDescriptor(1, maps=2, hidden=4, width=6).eval()


@pytest.fixture(scope="session")
def learnable(box: BoxRoom) -> Learnable:
    """Make a buffer of a box room whose features are waves of the true points, and the points."""
    waves = np.random.default_rng(0).normal(0, 0.6, (CHANNELS // 2, 3))

    def make(
        scene: int = 0,
        views: int = 6,
        lens: Camera | None = None,
    ) -> tuple[FeatureBuffer, Tensor]:
        rng = np.random.default_rng(scene)
        buffer = FeatureBuffer(scene, ATLAS_FROM_BASE)
        everything = []
        for _ in range(views):
            pose = box.random_view(rng)
            pixels = cell_centres(120, 160, 8)
            rays = (lens or CAMERA).unproject(pixels) @ pose.rotation_matrix().T
            points, _ = box.intersect(pose.translation_m, rays)
            phase = points @ waves.T
            features = np.concatenate([np.sin(phase), np.cos(phase)], 1)
            intrinsics = np.array(
                [CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy], np.float32
            )
            grey = np.zeros((120, 160), np.uint8)
            valid = np.ones(300, bool)
            view = View(grey, pixels.astype(np.float32), valid, intrinsics, pose)
            descriptor = torch.nn.functional.normalize(
                torch.from_numpy(rng.normal(size=6)), dim=0
            )
            rows = torch.from_numpy(features).float()
            buffer.append(
                view, (rows, descriptor.float()), torch.ones(300, dtype=torch.bool)
            )
            everything.append(torch.from_numpy(ATLAS_FROM_BASE.apply(points)).float())
        return buffer, torch.cat(everything)

    return make


def head_at_cameras(
    buffers: list[FeatureBuffer], options: HeadOptions | None = None
) -> Head:
    """A head for scenes of `learnable`, with centres at three cameras of each."""
    head = fresh_head(CHANNELS, 6, options or HeadOptions(width=32), seed=0)
    for buffer in buffers:
        matrix = buffer.tensors["camera_from_atlas"][:3].double().numpy()
        cameras = SE3.from_matrix(matrix).inverse().translation_m
        head.grow(torch.from_numpy(cameras).float(), seed=buffer.scene)
    return head
