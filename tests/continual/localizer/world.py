"""Scenes with an exact head, so that localization has a true answer.

An image of one grey level stands for one view. The encoder returns the level of each patch, and the
head looks up the true points of that view, in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from evercal.continual.localizer import NetworkLocalizeOptions, NetworkLocalizer
from evercal.continual.networks.atlas import Atlas
from evercal.continual.networks.descriptor import GlobalDescriptor
from evercal.continual.networks.head import Head, HeadOptions, HeadOutput
from evercal.continual.scenes import LearnedScenes, SceneRecord
from evercal.geometry import SE3, Camera, pose_distance
from evercal.localization.estimate import PoseEstimate
from evercal.simulation.box_room import BoxRoom, default_camera

from ...encoders import BlockMean
from ..draws import normal

SHORT_SIDE = 120
CAMERA = default_camera(160, 120)


@cache
def room() -> BoxRoom:
    """The room of all views."""
    return BoxRoom(5, furniture=3, texture_px=16)


class LevelDescriptor(nn.Module):
    """Descriptors that are registered for grey levels."""

    def __init__(self) -> None:
        super().__init__()
        self.descriptors: dict[int, list[float]] = {}
        self.width = 4

    def forward(self, features: Tensor) -> Tensor:
        levels = (255 * features.mean((1, 2, 3))).round().int().tolist()
        rows = [self.descriptors.get(level, [0.0, 0.0, 0.0, 1.0]) for level in levels]
        return F.normalize(torch.tensor(rows), dim=-1)


class ExactHead(Head):
    """Points that are registered for (scene, grey level); noise for others."""

    def __init__(self, condition: str) -> None:
        options = HeadOptions(width=4, condition=condition)  # pyright: ignore[reportArgumentType]
        super().__init__(1, 4, options)
        self.points: dict[tuple[int, int], Tensor] = {}
        self.scenes_asked: list[int] = []

    def forward(
        self, features: Tensor, scene: Tensor | int, descriptor: Tensor | None
    ) -> HeadOutput:
        assert isinstance(scene, int)
        self.scenes_asked.append(scene)
        # With condition `descriptor`, the output does not depend on the scene's index.
        coded = self.options.condition == "code"
        points = {
            key[1]: value
            for key, value in self.points.items()
            if key[0] == scene or not coded
        }
        levels = (255 * features[:, 0]).round().int().tolist()
        noise = normal(len(levels), 3) * 3
        rows = [
            points[level][i] if level in points and i < len(points[level]) else noise[i]
            for i, level in enumerate(levels)
        ]
        zero = torch.zeros(len(rows), 1)
        return HeadOutput(
            zero, zero[..., None].expand(-1, -1, 3), torch.stack(rows), zero
        )


@dataclass
class World:
    """Scenes of one room, and images that show them."""

    scenes: LearnedScenes
    head: ExactHead
    levels: int = 10
    poses: dict[int, SE3] = field(default_factory=dict)

    def view(
        self,
        scene: int,
        camera: Camera = CAMERA,
        size: tuple[int, int] | None = None,
        correct: float = 1.0,
        predicted_for: int | None = None,
        noise_m: float = 0.0,
    ) -> np.ndarray:
        """An image of a new view, by default of the camera's size.

        The head predicts the true points for a share of `correct` patches, with noise, if it is
        asked for the scene, or for `predicted_for`.
        """
        width, height = size or (camera.width, camera.height)
        level = self.levels
        self.levels = self.levels + 1
        rng = np.random.default_rng(level)
        pose = room().random_view(rng)
        scale = SHORT_SIDE / min(width, height)
        small = camera.resized(round(width * scale), round(height * scale))
        rays = small.unproject(patch_centres(small)) @ pose.rotation_matrix().T
        points, _ = room().intersect(pose.translation_m, rays)
        points += noise_m * rng.normal(size=points.shape)
        wrong = rng.permutation(len(points))[round(correct * len(points)) :]
        points[wrong] = rng.normal(0, 5, 3)
        index = scene if predicted_for is None else predicted_for
        atlas_from_base = self.scenes.scenes[scene].cell.atlas_from_base
        self.head.points[index, level] = torch.from_numpy(
            atlas_from_base.apply(points)
        ).float()
        descriptor = [0.0] * 4
        descriptor[scene] = 1.0
        self.poses[level] = pose
        image = np.full((height, width, 3), level, np.uint8)
        self.describe(image, descriptor)
        return image

    def pose(self, image: np.ndarray) -> SE3:
        """The true pose of an image."""
        return self.poses[int(image[0, 0, 0])]

    def describe(self, image: np.ndarray, descriptor: list[float]) -> None:
        """Register another descriptor for an image."""
        descriptors = cast(LevelDescriptor, self.scenes.descriptor).descriptors
        descriptors[int(image[0, 0, 0])] = descriptor

    def localize(
        self,
        image: np.ndarray,
        camera: Camera | None = None,
        options: NetworkLocalizeOptions | None = None,
    ) -> PoseEstimate:
        """Localize an image in the scenes as they are."""
        return NetworkLocalizer(self.scenes, options).localize(image, camera)

    def assert_located(
        self, image: np.ndarray, scene: int, camera: Camera | None = None
    ) -> PoseEstimate:
        """Assert that an image is localized at its true pose in a scene."""
        estimate = self.localize(image, camera)
        name = f"scene-{scene}"
        assert (estimate.status, estimate.reason, estimate.scene) == ("ok", "", name)
        assert estimate.base_from_camera is not None
        metres, radians = pose_distance(estimate.base_from_camera, self.pose(image))
        assert metres < 1e-4
        assert radians < 1e-4
        return estimate


def patch_centres(camera: Camera) -> np.ndarray:
    """(n, 2) pixels of the centres of all patches."""
    rows = camera.height // 8
    columns = camera.width // 8
    return np.array(
        [(8 * j + 3.5, 8 * i + 3.5) for i in range(rows) for j in range(columns)]
    )


def make_world(
    cameras: tuple[Camera, ...] = (CAMERA, CAMERA),
    condition: str = "code",
    threshold: float = 0.0,
) -> World:
    """Scenes `scene-0`, `scene-1`, ... whose prototypes are unit vectors."""
    head = ExactHead(condition)
    atlas = Atlas()
    records = []
    for i, camera in enumerate(cameras):
        head.grow(torch.zeros(1, 3), 0)
        cell = atlas.place(np.array([[0.0, 0, 1], [1, 1, 1]]) + 0.3 * i)
        record = SceneRecord(
            f"scene-{i}", camera, cell, torch.eye(4)[i : i + 1].half(), 100
        )
        records.append(replace(record, inlier_threshold=threshold))
    descriptor = cast(GlobalDescriptor, LevelDescriptor())
    scenes = LearnedScenes(
        BlockMean(), descriptor, "sars_pixels", SHORT_SIDE, [head], records
    )
    return World(scenes, head)
