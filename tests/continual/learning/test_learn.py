"""`learn`: its events, what it stores, and what it leaves unchanged."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import groupby

import numpy as np
import pytest
import torch
from torch import Tensor

from evercal.continual.learning.stage import Part, StageOptions
from evercal.continual.localizer import NetworkLocalizer
from evercal.continual.methods.penalties import Penalty
from evercal.continual.methods.replay import Replay
from evercal.continual.networks.buffer import Rows
from evercal.continual.networks.head import HeadOutput
from evercal.continual.networks.loss import LossOptions, clamp_px
from evercal.continual.networks.precision import autocast
from evercal.continual.networks.trainer import Progress
from evercal.continual.scenes import LearnedScenes
from evercal.continual.strategies import STRATEGIES, Strategy
from evercal.geometry import SE3, pose_distance
from evercal.mapping.memory_budget import MemoryBudget
from evercal.recordings.frame import Frame, Recording, stated_poses

from ..stages import (
    EmptyScenes,
    Rooms,
    Stages,
    assert_same,
    learn,
    second_stage,
    weights,
)

NETWORK = STRATEGIES["sars_pixels"]
SCENE_BY_SCENE = ["sars_pixels", "gec", "mir", "ewc", "isolation"]


def shortest(options: StageOptions) -> StageOptions:
    """The same options with a single step and a single view per frame."""
    encode = replace(options.encode, views_per_frame=1)
    return replace(options, fit=replace(options.fit, iterations=1), encode=encode)


def posed(frame: Frame) -> SE3:
    assert frame.base_from_camera is not None
    return frame.base_from_camera


def test_events_are_in_order(
    first_stages: Stages, rooms: Rooms, quick: StageOptions
) -> None:
    events: list[Part | Progress] = []
    second_stage(first_stages["sars_pixels"], rooms, quick, events.append)
    kinds = [kind for kind, _ in groupby(type(event) for event in events)]
    assert kinds == [Part, Progress]
    encodings = [event for event in events if isinstance(event, Part)]
    assert [total for total, _ in groupby(event.total for event in encodings)] == [
        60,
        6,
    ]
    for views in (60, 6):
        done = [event.done for event in encodings if event.total == views]
        assert done == sorted(set(done))
        assert done[-1] == views
    steps = [event for event in events if isinstance(event, Progress)]
    assert [(step.step, step.total) for step in steps] == [(i, 8) for i in range(1, 9)]
    for step in steps:
        assert np.isfinite(step.loss)
        assert 0 <= step.inlier_share <= 1


@pytest.mark.parametrize("name", SCENE_BY_SCENE)
def test_stage_leaves_its_input_unchanged(
    name: str, first_stages: Stages, rooms: Rooms, quick: StageOptions
) -> None:
    scenes = first_stages[name]
    before = [weights(head) for head in scenes.heads]
    records = list(scenes.scenes)
    keyframes = list(scenes.keyframes)
    after = second_stage(scenes, rooms, quick)
    for head, state in zip(scenes.heads, before, strict=True):
        assert_same(weights(head), state)
    assert all(a is b for a, b in zip(scenes.scenes, records, strict=True))
    assert all(a is b for a, b in zip(scenes.keyframes, keyframes, strict=True))
    assert [record.name for record in after.scenes] == ["alpha", "beta"]
    assert after.scenes[0].cell == scenes.scenes[0].cell
    assert len(after.keyframes) == len(after.method_states) == 2
    key = "first.0.weight"
    assert not torch.equal(
        weights(after.heads[-1])[key], weights(scenes.heads[-1])[key]
    )


@pytest.mark.parametrize("count", [16, 27])
def test_a_tenth_of_the_frames_is_kept(
    count: int, empty_scenes: EmptyScenes, rooms: Rooms, quick: StageOptions
) -> None:
    scene = replace(rooms[0], train=rooms[0].train[:count])
    after = learn(empty_scenes(NETWORK.name), NETWORK, scene, shortest(quick))
    keyframes = after.keyframes[0]
    assert keyframes is not None
    assert len(keyframes) == after.frames_kept == count // 10


def test_memory_in_bytes_is_respected_and_used(
    empty_scenes: EmptyScenes, rooms: Rooms, quick: StageOptions
) -> None:
    sizes = []
    for budget in (20_000, 60_000, 10**9):
        options = replace(shortest(quick), memory=MemoryBudget(bytes=budget))
        after = learn(empty_scenes("er"), STRATEGIES["er"], rooms[0], options)
        keyframes = after.keyframes[0]
        assert keyframes is not None
        assert 0.6 * budget < keyframes.bytes <= budget or len(keyframes) == 30
        assert len(keyframes) == after.frames_kept
        sizes.append(len(keyframes))
    assert sizes[0] < sizes[1] < sizes[2] == 30


def test_whitening_is_fitted_to_the_first_scene_only(
    first_stages: Stages, rooms: Rooms, quick: StageOptions
) -> None:
    first = first_stages["sars_pixels"]
    before = first.heads[0]
    assert not torch.equal(before.feature_map, torch.eye(before.features))
    after = second_stage(first, rooms, quick).heads[-1]
    assert torch.equal(after.feature_map, before.feature_map)
    assert torch.equal(after.feature_mean, before.feature_mean)


def test_centres_lie_in_the_cell_of_their_scene(
    first_stages: Stages, rooms: Rooms, quick: StageOptions
) -> None:
    after = second_stage(first_stages["sars_pixels"], rooms, quick)
    head = after.heads[0]
    for i, scene in enumerate(rooms[:2]):
        centres = head.centres[head.centre_scene == i].double().numpy()
        assert len(centres) == 3
        cell = after.scenes[i].cell
        positions = stated_poses(scene.train).translation_m
        np.testing.assert_allclose(positions.mean(0), cell.origin_m)
        in_atlas = cell.atlas_from_base.apply(positions)
        assert (centres >= in_atlas.min(0) - 1e-5).all()
        assert (centres <= in_atlas.max(0) + 1e-5).all()
        assert cell.distance_m(centres[0]) < cell.side_m / 2


@dataclass(frozen=True)
class RecordingPenalty(Penalty):
    """Records the arguments of a penalty."""

    calls: list[tuple[HeadOutput, Rows, float]] = field(default_factory=list)

    def __call__(
        self, student: HeadOutput, teacher: HeadOutput | None, rows: Rows, tau_px: float
    ) -> Tensor:
        assert teacher is not None
        self.calls.append((teacher, rows, tau_px))
        return student.points.square().mean()


def test_replayed_rows_are_of_old_scenes_and_the_teacher_is_the_old_head(
    first_stages: Stages, rooms: Rooms, quick: StageOptions
) -> None:
    scenes = first_stages["sars_pixels"]
    keyframes = scenes.keyframes[0]
    assert keyframes is not None
    penalty = RecordingPenalty()
    circle = LossOptions(schedule="circle", clamp_start_px=50.0)
    options = replace(quick, fit=replace(quick.fit, loss=circle))
    learn(
        scenes, Strategy("recorded", Replay("sars_filled", penalty)), rooms[1], options
    )
    # Replayed rows have the clamp of new ones.
    clamps = [tau_px for *_, tau_px in penalty.calls]
    assert clamps == [clamp_px(circle, i / 8) for i in range(8)]
    atlas_from_base = scenes.scenes[0].cell.atlas_from_base
    positions = atlas_from_base.apply(keyframes.base_from_camera.translation_m)
    for teacher, rows, _ in penalty.calls:
        assert len(rows.scene) == 32
        assert not rows.scene.any()
        with torch.no_grad(), autocast():
            expected = scenes.heads[0](
                rows.features.float(), rows.scene, rows.descriptor
            )
        torch.testing.assert_close(teacher.points, expected.points)
        assert not teacher.points.requires_grad
        # Augmentation rotates a camera and does not move it.
        rotation, shift = rows.target.camera_from_atlas.double().split([3, 1], -1)
        centres = -(rotation.transpose(1, 2) @ shift)[..., 0].numpy()
        nearest = np.linalg.norm(centres[:, None] - positions, axis=-1).min(1)
        assert nearest.max() < 1e-5


def test_training_depends_on_the_seed_only(
    first_stages: Stages, rooms: Rooms, quick: StageOptions
) -> None:
    scenes = first_stages["sars_pixels"]
    torch.manual_seed(12345)
    again = second_stage(scenes, rooms, quick)
    same = second_stage(scenes, rooms, quick)
    other = second_stage(scenes, rooms, replace(quick, seed=1))
    assert_same(weights(again.heads[0]), weights(same.heads[0]))
    for name in ("code", "first.1.weight"):
        assert not torch.equal(
            weights(other.heads[0])[name], weights(same.heads[0])[name]
        )


@pytest.mark.parametrize("positions", [1, 2])
def test_camera_that_only_rotates(
    positions: int, empty_scenes: EmptyScenes, rooms: Rooms, quick: StageOptions
) -> None:
    frames = tuple(
        replace(
            frame,
            base_from_camera=SE3(
                posed(frame).rotation_wxyz, np.full(3, float(i % positions))
            ),
        )
        for i, frame in enumerate(rooms[0].train)
    )
    recording = replace(rooms[0], train=frames)
    head = learn(empty_scenes(NETWORK.name), NETWORK, recording, quick).heads[0]
    assert len(head.centres) == positions
    assert all(
        bool(torch.isfinite(value).all()) for value in head.state_dict().values()
    )


def test_replay_prevents_forgetting(
    arcs: tuple[Recording, Recording],
    arc_stage: StageOptions,
    arc_scenes: tuple[LearnedScenes, LearnedScenes],
) -> None:
    def median_error_m(scenes: LearnedScenes, recording: Recording) -> float:
        localizer = NetworkLocalizer(scenes)
        errors = []
        for frame in recording.test[::3]:
            estimate = localizer.localize(frame.read_image(), frame.camera)
            pose = estimate.base_from_camera
            if pose is None or estimate.scene != recording.name:
                errors.append(np.inf)
            else:
                errors.append(pose_distance(pose, posed(frame))[0])
        return float(np.median(errors))

    one, both = arc_scenes
    assert median_error_m(one, arcs[0]) < 0.1
    assert median_error_m(both, arcs[1]) < 0.15
    control = replace(one, strategy="finetune", keyframes=[None])
    short = replace(arc_stage, fit=replace(arc_stage.fit, iterations=200))
    finetuned = learn(control, STRATEGIES["finetune"], arcs[1], short)
    replayed = median_error_m(both, arcs[0])
    assert replayed < 0.15
    assert replayed < median_error_m(finetuned, arcs[0]) / 3
