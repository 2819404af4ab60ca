"""A world with an oracle for a head: its answers are right or wrong as each test wants them.

An image of one grey level L stands for view L. The fake encoder passes each cell's level on, the
oracle looks up what that view sees at that cell and says the true point, in closed form.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import cast

import numpy as np
import pytest
import torch
from evercal.mapping.scene_maps import SceneMaps, SceneRecord
from torch import Tensor, nn
from torch.nn import functional as F

from evercal.continual.networks.atlas import Atlas
from evercal.continual.networks.descriptor import GlobalDescriptor
from evercal.continual.networks.head import Head, HeadOptions, HeadOutput
from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3, pose_distance
from evercal.localization.estimate import PoseEstimate
from evercal.simulation.box_room import BoxRoom, default_camera

SHORT = 120
CAMERA = default_camera(160, 120)


@cache
def room() -> BoxRoom:
    """The room that all views show."""
    return BoxRoom(5, furniture=3, texture_px=16)


class LevelEncoder:
    """Each cell's mean grey level is its feature."""

    stride, width = 8, 1

    def __call__(self, grey: Tensor) -> Tensor:
        return F.avg_pool2d(grey, 8)


class LevelDescriptor(nn.Module):
    """The descriptor that was registered for the image's level."""

    def __init__(self) -> None:
        super().__init__()
        self.maps: dict[int, list[float]] = {}
        self.width = 4

    def forward(self, features: Tensor) -> Tensor:
        levels = (255 * features.mean((1, 2, 3))).round().int().tolist()
        rows = [self.maps.get(level, [0.0, 0.0, 0.0, 1.0]) for level in levels]
        return F.normalize(torch.tensor(rows), dim=-1)


class Oracle(Head):
    """Says the points it was told, for (scene, level); nonsense otherwise."""

    def __init__(self, condition: str) -> None:
        options = HeadOptions(width=4, condition=condition)  # pyright: ignore[reportArgumentType]
        super().__init__(1, 4, options)
        self.told: dict[tuple[int, int], Tensor] = {}
        self.asked: list[int] = []

    def forward(
        self, features: Tensor, scene: Tensor | int, descriptor: Tensor | None
    ) -> HeadOutput:
        assert isinstance(scene, int)
        self.asked.append(scene)
        # Without a scene to ask for (condition `descriptor`), any scene's truth is said.
        coded = self.options.condition == "code"
        told = {key[1]: value for key, value in self.told.items() if key[0] == scene or not coded}
        levels = (255 * features[:, 0]).round().int().tolist()
        noise = torch.randn(len(levels), 3, generator=torch.Generator().manual_seed(0)) * 3
        rows = [
            told[level][i] if level in told and i < len(told[level]) else noise[i]
            for i, level in enumerate(levels)
        ]
        zero = torch.zeros(len(rows), 1)
        return HeadOutput(zero, zero[..., None].expand(-1, -1, 3), torch.stack(rows), zero)


@dataclass
class World:
    """Some scenes of one room, and the images that show them."""

    maps: SceneMaps
    oracle: Oracle
    levels: int = 10
    truth: dict[int, SE3] = field(default_factory=dict)

    def view(
        self,
        scene: int,
        camera: Camera = CAMERA,
        size: tuple[int, int] | None = None,
        right: float = 1.0,
        say: int | None = None,
    ) -> np.ndarray:
        """A new view of a scene: an image; what the oracle says of it is registered.

        Args:
            scene: what the image shows.
            camera: what took it, any size.
            size: width and height of the image; the camera's when None.
            right: share of cells that are told the truth.
            say: the scene that is told of it, when not the one that it shows.
        """
        width, height = size or (camera.width, camera.height)
        level, self.levels = self.levels, self.levels + 1
        rng = np.random.default_rng(level)
        base_from_camera = room().random_view(rng)
        scale = SHORT / min(width, height)
        small = camera.resized(round(width * scale), round(height * scale))
        grid = [(8 * j + 3.5, 8 * i + 3.5) for i in range(small.height // 8)
                for j in range(small.width // 8)]  # fmt: skip
        rays = small.unproject(np.array(grid)) @ base_from_camera.rotation_matrix().T
        points, _ = room().intersect(base_from_camera.translation_m, rays)
        points[rng.permutation(len(points))[round(right * len(points)) :]] = rng.normal(0, 5, 3)
        cell = self.maps.scenes[scene].cell
        told = torch.from_numpy(cell.atlas_from_base.apply(points)).float()
        self.oracle.told[scene if say is None else say, level] = told
        nearest = [0.0] * 4
        nearest[scene] = 1.0
        cast(LevelDescriptor, self.maps.descriptor).maps[level] = nearest
        self.truth[level] = base_from_camera
        return np.full((height, width, 3), level, np.uint8)

    def looks_like(self, image: np.ndarray, descriptor: list[float]) -> None:
        """Gives an image another descriptor than that of the scene it shows."""
        cast(LevelDescriptor, self.maps.descriptor).maps[int(image[0, 0, 0])] = descriptor

    def assert_right(self, found: PoseEstimate, image: np.ndarray, scene: str) -> None:
        """The answer is `ok` and the pose that the image was registered with."""
        assert (found.status, found.reason, found.scene) == ("ok", "", scene)
        assert found.base_from_camera is not None
        metres, radians = pose_distance(found.base_from_camera, self.truth[int(image[0, 0, 0])])
        assert metres < 1e-4
        assert radians < 1e-4


def world(
    cameras: tuple[Camera, ...] = (CAMERA, CAMERA), condition: str = "code", threshold: float = 0.0
) -> World:
    """Scenes `scene-0`, `scene-1`, ...; prototypes are unit vectors."""
    oracle, atlas, scenes = Oracle(condition), Atlas(), []
    for i, camera in enumerate(cameras):
        oracle.grow(torch.zeros(1, 3), 0)
        cell = atlas.place(np.array([[0.0, 0, 1], [1, 1, 1]]) + 0.3 * i)
        prototypes = torch.eye(4)[i : i + 1].half()
        record = SceneRecord(f"scene-{i}", camera, cell, prototypes, 100)
        scenes.append(replace(record, inlier_threshold=threshold))
    descriptor = cast(GlobalDescriptor, LevelDescriptor())
    maps = SceneMaps(
        LevelEncoder(), descriptor, "evercal_network", SHORT, [oracle], scenes, [None] * 9
    )
    return World(maps, oracle)


@pytest.fixture(name="world")
def _world() -> Callable[..., World]:
    """Makes scenes `scene-0`, `scene-1`, ... from their cameras."""
    return world
