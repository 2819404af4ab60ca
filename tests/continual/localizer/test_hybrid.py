"""Localization by a map and a network together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from evercal.continual.learning.learn import learn
from evercal.continual.learning.stage import StageOptions
from evercal.continual.localizer import HybridLocalizer, NetworkLocalizer
from evercal.continual.networks.atlas import Atlas
from evercal.continual.networks.descriptor import load_descriptor
from evercal.continual.networks.head import Head, HeadOptions, HeadOutput
from evercal.continual.scenes import LearnedScenes, SceneRecord
from evercal.continual.strategies import STRATEGIES
from evercal.features.encoder import load_encoder
from evercal.geometry import SE3, pose_distance
from evercal.localization.learned import SceneLocalizer
from evercal.mapping.build import BuiltMap
from evercal.mapping.memory_budget import MemoryBudget
from evercal.recordings.frame import Frame, Recording, stated_poses
from evercal.simulation.box_room import BoxRoom

from ..stages import outcome


@pytest.fixture(scope="module")
def untrained(arcs: tuple[Recording, Recording], arc_stage: StageOptions) -> LearnedScenes:
    """A hybrid of the first arc after a dozen steps; half of the frames are keyframes."""
    fit = replace(arc_stage.fit, iterations=12)
    options = replace(arc_stage, fit=fit, memory=MemoryBudget(share=0.5))
    empty = LearnedScenes(load_encoder(), load_descriptor(), "evercal_hybrid", 120)
    return outcome(learn(empty, STRATEGIES["evercal_hybrid"], arcs[0], options))


def posed(frame: Frame) -> SE3:
    assert frame.base_from_camera is not None
    return frame.base_from_camera


def median_error_m(localizer: SceneLocalizer, recording: Recording) -> float:
    """Median error of every third test frame; a frame that is not located counts as infinite."""
    errors = []
    for frame in recording.test[::3]:
        pose = localizer.localize(frame.read_image(), frame.camera).base_from_camera
        errors.append(np.inf if pose is None else pose_distance(pose, posed(frame))[0])
    return float(np.median(errors))


def test_map_locates_what_the_network_cannot(
    untrained: LearnedScenes, arcs: tuple[Recording, Recording]
) -> None:
    assert median_error_m(HybridLocalizer(untrained), arcs[0]) < 0.05
    assert median_error_m(NetworkLocalizer(untrained), arcs[0]) > 0.2


class HallHead(Head):
    """The true points of one image of the hall, in the cell of one scene."""

    def __init__(self, features: int, descriptor: int, points: np.ndarray):
        super().__init__(features, descriptor, HeadOptions(width=4, condition="descriptor"))
        self.points = torch.from_numpy(points).float()

    def forward(
        self, features: Tensor, scene: Tensor | int, descriptor: Tensor | None
    ) -> HeadOutput:
        zero = torch.zeros(len(features), 1)
        return HeadOutput(zero, zero[..., None].expand(-1, -1, 3), self.points, zero)


MOTION = SE3.exp([2.0, 0, 0, 0, 0, 0])


def hall_twice(
    hall: Recording, built: BuiltMap, room: BoxRoom, frame: Frame, cell: int, shift: SE3
) -> LearnedScenes:
    """Two scenes of the hall with different keyframes; base frames are `MOTION` apart.

    Args:
        hall: recording of the first scene, `hall`; the second one is `there`.
        built: map of the hall.
        room: the hall.
        frame: whose points the head predicts.
        cell: scene in whose cell the points are predicted.
        shift: of the predicted points, in the base frame of that scene.
    """
    encoder, descriptor = load_encoder(), load_descriptor()
    here, there = (built.take(np.arange(i, 7, 2)).scene for i in (0, 1))
    poses = MOTION @ there.keyframes.base_from_camera
    moved = replace(there.keyframes, base_from_camera=poses)
    there = replace(there, name="there", keyframes=moved)
    positions, atlas, records = stated_poses(hall.train).translation_m, Atlas(), []
    for scene_map, there_from_hall in ((here, SE3.identity()), (there, MOTION)):
        records.append(
            SceneRecord(
                scene_map.name,
                frame.camera,
                atlas.place(there_from_hall.apply(positions)),
                torch.zeros(1, descriptor.width).half(),
                30,
                map=scene_map,
            )
        )
    pose = posed(frame)
    rows, columns = 240 // encoder.stride, 320 // encoder.stride
    v, u = np.mgrid[0:rows, 0:columns] * encoder.stride + (encoder.stride - 1) / 2
    rays = frame.camera.unproject(np.stack([u.ravel(), v.ravel()], -1))
    points, _ = room.intersect(pose.translation_m, rays @ pose.rotation_matrix().T)
    in_atlas = (records[cell].cell.atlas_from_base @ shift).apply(points)
    head = HallHead(encoder.width, descriptor.width, in_atlas)
    for _ in records:
        head.grow(torch.zeros(2, 3), 0)
    return LearnedScenes(encoder, descriptor, "evercal_hybrid", 240, [head], records)


@pytest.mark.parametrize(("cell", "shift"), [(0, SE3.identity()), (1, MOTION)])
def test_descriptor_conditioned_head_predicts_the_scene(
    cell: int, shift: SE3, hall: Recording, hall_room: BoxRoom, hall_built: BuiltMap
) -> None:
    frame = hall.test[11]
    scenes = hall_twice(hall, hall_built, hall_room, frame, cell, shift)
    estimate = HybridLocalizer(scenes).localize(frame.read_image(), frame.camera)
    assert estimate.status == "ok"
    assert estimate.base_from_camera is not None
    expected = {"hall": posed(frame), "there": MOTION @ posed(frame)}[str(estimate.scene)]
    assert pose_distance(estimate.base_from_camera, expected)[0] < 0.005


def test_landmarks_are_not_aligned_to_a_pose_in_another_scene(
    hall: Recording, hall_room: BoxRoom, hall_built: BuiltMap
) -> None:
    """Points of the hall in the cell of `there` fit the landmarks of the first scene only."""
    frame = hall.test[0]
    scenes = hall_twice(hall, hall_built, hall_room, frame, 1, SE3.identity())
    estimate = HybridLocalizer(scenes).localize(frame.read_image(), frame.camera)
    assert (estimate.status, estimate.scene) in (("ok", "hall"), ("unknown_scene", None))
