"""`learn`: what a stage leaves alone, what it keeps, and that an interruption does not show."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path

import numpy as np
import pytest
import torch
from evercal.mapping.scene_maps import SceneMaps
from torch import Tensor

from evercal.continual.learn import learn
from evercal.continual.methods.penalties import Penalty
from evercal.continual.methods.replay import Replay
from evercal.continual.networks.buffer import Rows
from evercal.continual.networks.head import HeadOutput
from evercal.continual.networks.loss import LossOptions, clamp_px
from evercal.continual.networks.trainer import Progress
from evercal.continual.stage import Encoding, Stage, StageOptions
from evercal.continual.strategies import STRATEGIES, Strategy
from evercal.features.precision import autocast
from evercal.geometry.se3 import SE3, pose_distance
from evercal.localization.acceptance import fitted_record
from evercal.localization.localizer import Localizer
from evercal.mapping.store import Checkpoint
from evercal.recordings.frame import Frame, Recording

from .stages import Blank, Rooms, assert_same, continued, outcome, weights

NETWORK = STRATEGIES["evercal_network"]
ONE_BY_ONE = [name for name, strategy in STRATEGIES.items() if not strategy.jointly]


def test_events_come_in_order(
    first: dict[str, SceneMaps], rooms: Rooms, quick: StageOptions
) -> None:
    # Encode the scene, hand over its rows, encode what is remembered, train, finish.
    events = list(continued(first["evercal_network"], rooms, quick))
    kinds = [kind for kind, _ in groupby(type(event) for event in events)]
    assert kinds == [Encoding, Checkpoint, Encoding, Progress, Stage]
    own, replayed = (
        [event for event in group if isinstance(event, Encoding)]
        for kind, group in groupby(events, type)
        if kind is Encoding
    )
    for part, views in ((own, 60), (replayed, 6)):
        done = [event.done for event in part]
        assert done == sorted(set(done))
        assert done[-1] == views
        assert {event.total for event in part} == {views}
    steps = [event for event in events if isinstance(event, Progress)]
    assert [step.step for step in steps] == list(range(1, 9))
    assert {step.total for step in steps} == {8}
    for step in steps:
        assert np.isfinite(step.loss)
        assert 0 <= step.inlier_share <= 1


@pytest.mark.parametrize("name", ONE_BY_ONE)
def test_a_stage_leaves_what_it_was_given_alone(
    name: str, first: dict[str, SceneMaps], rooms: Rooms, quick: StageOptions
) -> None:
    maps = first[name]
    before = [weights(head) for head in maps.heads]
    slopes = [copy.deepcopy(p.grad) for head in maps.heads for p in head.parameters()]
    scenes, keyframes = list(maps.scenes), list(maps.keyframes)
    modes = [module.training for head in maps.heads for module in head.modules()]
    after = outcome(continued(maps, rooms, quick))
    for head, state in zip(maps.heads, before, strict=True):
        assert_same(weights(head), state)
    parameters = [p for head in maps.heads for p in head.parameters()]
    for parameter, slope in zip(parameters, slopes, strict=True):
        assert (parameter.grad is None) == (slope is None)
        assert slope is None or torch.equal(torch.as_tensor(parameter.grad), slope)
    assert all(a is b for a, b in zip(maps.scenes, scenes, strict=True))
    assert all(a is b for a, b in zip(maps.keyframes, keyframes, strict=True))
    assert [module.training for head in maps.heads for module in head.modules()] == modes
    assert [record.name for record in after.scenes] == ["alpha", "beta"]
    assert after.scenes[0].cell == maps.scenes[0].cell
    assert len(after.keyframes) == 2
    # And it did learn something.
    if STRATEGIES[name].method is not None:
        key = "first.0.weight"
        assert not torch.equal(weights(after.heads[-1])[key], weights(maps.heads[-1])[key])
    else:
        assert after.heads == []
        assert after.keyframes[1] is not None
        assert all(len(marks) for marks in after.keyframes[1].landmarks)


def test_fine_tuning_is_the_same_but_for_the_memory(
    first: dict[str, SceneMaps], rooms: Rooms, quick: StageOptions
) -> None:
    # The control makes the very same first head: there is nothing to replay yet.
    assert_same(weights(first["finetune"].heads[0]), weights(first["evercal_network"].heads[0]))
    assert first["finetune"].keyframes == [None]
    *_, stage = continued(first["finetune"], rooms, quick)
    assert isinstance(stage, Stage)
    assert stage.frames_kept == 0
    assert stage.maps.keyframes == [None, None]
    ours = outcome(continued(first["evercal_network"], rooms, quick)).heads[0]
    assert not torch.equal(ours.code, stage.maps.heads[0].code)


@pytest.mark.parametrize("count", [16, 20, 27, 30])
def test_memory_holds_at_most_a_tenth(
    count: int, blank: Blank, rooms: Rooms, quick: StageOptions
) -> None:
    scene = replace(rooms[0], train=rooms[0].train[:count])
    least = replace(
        quick, fit=replace(quick.fit, iterations=1), encode=replace(quick.encode, views_per_frame=1)
    )
    *_, stage = learn(blank(NETWORK.name), NETWORK, scene, least)
    assert isinstance(stage, Stage)
    keyframes = stage.maps.keyframes[0]
    assert keyframes is not None
    assert len(keyframes.images) == stage.frames_kept
    assert 1 <= len(keyframes.images) <= count / 10
    # They are frames of the scene, in recorded order.
    poses = np.stack([f.base_from_camera.matrix() for f in scene.train if f.base_from_camera])
    kept = keyframes.base_from_camera.matrix()
    places = [int(np.abs(poses - pose).max((1, 2)).argmin()) for pose in kept]
    np.testing.assert_allclose(poses[places], kept, atol=1e-12)
    assert places == sorted(set(places))


def test_memory_may_be_given_in_bytes(blank: Blank, rooms: Rooms, quick: StageOptions) -> None:
    least = replace(
        quick, fit=replace(quick.fit, iterations=1), encode=replace(quick.encode, views_per_frame=1)
    )
    sizes = []
    for budget in (4_000, 12_000, 10**9):
        maps = outcome(
            learn(blank(NETWORK.name), NETWORK, rooms[0], replace(least, memory_bytes=budget))
        )
        keyframes = maps.keyframes[0]
        assert keyframes is not None
        assert keyframes.bytes <= 1.25 * budget  # frames are counted at the size of the first
        sizes.append(len(keyframes.images))
    assert sizes[0] < sizes[1] < sizes[2] == 30


def test_isolation_keeps_one_head_each(
    first: dict[str, SceneMaps], rooms: Rooms, quick: StageOptions
) -> None:
    maps = first["isolation"]
    after = outcome(continued(maps, rooms, quick))
    assert [head.scenes for head in after.heads] == [1, 1]
    assert_same(weights(after.heads[0]), weights(maps.heads[0]))
    assert after.head_for(0) == (after.heads[0], 0)
    assert after.head_for(1) == (after.heads[1], 0)
    shared = outcome(continued(first["evercal_network"], rooms, quick))
    assert [head.scenes for head in shared.heads] == [2]
    assert shared.head_for(1) == (shared.heads[0], 1)


def test_the_input_is_whitened_by_the_first_scene_and_stays_so(
    first: dict[str, SceneMaps], rooms: Rooms, quick: StageOptions
) -> None:
    before = first["evercal_network"].heads[0]
    assert not torch.equal(before.feature_map, torch.eye(before.features))
    shared = outcome(continued(first["evercal_network"], rooms, quick)).heads[0]
    assert torch.equal(shared.feature_map, before.feature_map)
    assert torch.equal(shared.feature_mean, before.feature_mean)
    # A head of its own starts from the last one, the whitening of its input included.
    own = outcome(continued(first["isolation"], rooms, quick)).heads[-1]
    assert torch.equal(own.feature_map, first["isolation"].heads[0].feature_map)


def test_the_new_scene_stands_in_its_cell(
    first: dict[str, SceneMaps], rooms: Rooms, quick: StageOptions
) -> None:
    after = outcome(continued(first["evercal_network"], rooms, quick))
    head = after.heads[0]
    for i, scene in enumerate(rooms[:2]):
        centres = head.centres[head.centre_scene == i].double().numpy()
        assert len(centres) == 3
        cell = after.scenes[i].cell
        positions = np.stack(
            [f.base_from_camera.translation_m for f in scene.train if f.base_from_camera]
        )
        np.testing.assert_allclose(positions.mean(0), cell.origin_m)
        in_atlas = cell.atlas_from_base.apply(positions)
        # Means of groups of cameras lie within the box around all.
        assert (centres >= in_atlas.min(0) - 1e-5).all()
        assert (centres <= in_atlas.max(0) + 1e-5).all()
        assert after.atlas().scene_at(centres[0]) == i


@dataclass(frozen=True)
class Spy(Penalty):
    """Writes down what a penalty is given."""

    seen: list[tuple[HeadOutput, Rows, float]] = field(default_factory=list)

    def __call__(
        self, student: HeadOutput, teacher: HeadOutput | None, rows: Rows, tau_px: float
    ) -> Tensor:
        assert teacher is not None
        self.seen.append((teacher, rows, tau_px))
        return student.points.square().mean()


def test_replayed_rows_are_the_old_scenes_and_their_teacher_stays_as_it_was(
    first: dict[str, SceneMaps], rooms: Rooms, quick: StageOptions
) -> None:
    maps = first["evercal_network"]
    keyframes = maps.keyframes[0]
    assert keyframes is not None
    spy = Spy()
    circle = LossOptions(schedule="circle", clamp_start_px=50.0)
    quick = replace(quick, fit=replace(quick.fit, loss=circle))
    list(learn(maps, Strategy("spied", Replay("sars_filled", spy)), rooms[1], quick))
    seen = spy.seen
    # Replayed rows have the clamp of new ones, whatever the schedule.
    assert [tau_px for *_, tau_px in seen] == [clamp_px(circle, i / 8) for i in range(8)]
    centres = maps.scenes[0].cell.atlas_from_base.apply(keyframes.base_from_camera.translation_m)
    for teacher, rows, _ in seen:
        assert len(rows.scene) == 32
        assert not rows.scene.any()
        with torch.no_grad(), autocast():
            expected = maps.heads[0](rows.features.float(), rows.scene, rows.descriptor)
        torch.testing.assert_close(teacher.points, expected.points)
        assert not teacher.points.requires_grad
        # Every row was seen from a remembered camera: augmentation turns, but does not move it.
        turn, shift = rows.target.camera_from_atlas.double().split([3, 1], -1)
        where = -(turn.transpose(1, 2) @ shift)[..., 0].numpy()
        nearest = np.linalg.norm(where[:, None] - centres, axis=-1).min(1)
        assert nearest.max() < 1e-5


def test_everything_comes_from_the_seed(
    first: dict[str, SceneMaps], rooms: Rooms, quick: StageOptions
) -> None:
    torch.manual_seed(12345)  # the state of the world does not matter
    again = outcome(continued(first["evercal_network"], rooms, quick))
    torch.rand(7)
    same = outcome(continued(first["evercal_network"], rooms, quick))
    other = outcome(continued(first["evercal_network"], rooms, replace(quick, seed=1)))
    assert_same(weights(again.heads[0]), weights(same.heads[0]))
    assert not torch.equal(other.heads[0].code, same.heads[0].code)
    name = "first.1.weight"
    assert not torch.equal(weights(other.heads[0])[name], weights(same.heads[0])[name])


def test_test_frames_are_not_looked_at(blank: Blank, rooms: Rooms, quick: StageOptions) -> None:
    alpha = rooms[0]
    ghosts = tuple(
        Frame("ghost", Path("nowhere.png"), frame.camera, frame.base_from_camera)
        for frame in alpha.train[:2]
    )
    seen = outcome(learn(blank(NETWORK.name), NETWORK, replace(alpha, test=ghosts), quick))
    unseen = outcome(learn(blank(NETWORK.name), NETWORK, alpha, quick))
    assert_same(weights(seen.heads[0]), weights(unseen.heads[0]))


def test_training_sees_images_as_the_localizer_does(
    blank: Blank, rooms: Rooms, quick: StageOptions
) -> None:
    # The working size is the store's, whatever the plan for views says.
    plan = replace(quick.encode, views_per_frame=1, view=replace(quick.encode.view, short_side=96))
    stage = replace(quick, encode=plan, fit=replace(quick.fit, iterations=1))
    maps = blank("evercal_network")
    for event in learn(maps, NETWORK, rooms[0], stage):
        if isinstance(event, Checkpoint) and event.rows:
            cells = len(event.rows["features"]) / len(event.rows["intrinsics"])
            assert cells == (64 // 8) * (48 // 8)


@pytest.mark.parametrize("places", [1, 2])
def test_a_camera_that_stands_still(
    places: int, blank: Blank, rooms: Rooms, quick: StageOptions
) -> None:
    # Turning on the spot, or at fewer spots than there are centres to find.
    frames = tuple(
        replace(
            frame, base_from_camera=SE3(frame.base_from_camera.rotation_wxyz, np.ones(3) * spot)
        )
        for i, frame in enumerate(rooms[0].train)
        if frame.base_from_camera
        for spot in [float(i % places)]
    )
    head = outcome(
        learn(blank(NETWORK.name), NETWORK, replace(rooms[0], train=frames), quick)
    ).heads[0]
    assert len(head.centres) == places
    assert all(bool(torch.isfinite(value).all()) for value in head.state_dict().values())


def test_replay_keeps_an_old_scene(
    arcs: tuple[Recording, Recording],
    arc_stage: StageOptions,
    arc_maps: tuple[SceneMaps, SceneMaps],
) -> None:
    def median_error_m(maps: SceneMaps, scene: Recording) -> float:
        localizer, errors = Localizer(maps), []
        for frame in scene.test[::3]:
            found = localizer.localize(frame.read_image(), frame.camera)
            ok = found.scene == scene.name and found.base_from_camera is not None
            assert frame.base_from_camera is not None
            if ok and found.base_from_camera is not None:
                errors.append(pose_distance(found.base_from_camera, frame.base_from_camera)[0])
            else:
                errors.append(np.inf)
        return float(np.median(errors))

    before, after = arc_maps
    assert median_error_m(before, arcs[0]) < 0.1
    assert median_error_m(after, arcs[1]) < 0.15
    control = replace(before, strategy="finetune", keyframes=[None])
    short = replace(arc_stage, fit=replace(arc_stage.fit, iterations=200))
    forgot = outcome(learn(control, STRATEGIES["finetune"], arcs[1], short))
    kept = median_error_m(after, arcs[0])
    assert kept < 0.15
    assert kept < median_error_m(forgot, arcs[0]) / 3


def test_memory_auto_keeps_few_keyframes_that_locate_the_other_frames(
    hall: Recording, hall_maps: SceneMaps
) -> None:
    nothing = replace(hall_maps, heads=[], scenes=[], keyframes=[], method_states=[])
    *_, stage = learn(nothing, STRATEGIES["evercal"], hall, StageOptions(memory_auto=True))
    assert isinstance(stage, Stage)
    kept = stage.maps.keyframes[0]
    assert kept is not None
    assert len(kept) == stage.frames_kept < int(0.3 * len(hall.train))
    stage.maps.scenes[0] = fitted_record(stage.maps, hall.test[::10])
    localizer = Localizer(stage.maps)
    for frame in hall.train[1::7]:
        found = localizer.localize(frame.read_image(), frame.camera).base_from_camera
        assert found is not None
        assert frame.base_from_camera is not None
        assert pose_distance(found, frame.base_from_camera)[0] < 0.01
