"""All scenes at once: as many steps and rows as learning them in turn, one head for all."""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby

import numpy as np
import pytest
import torch
from evercal.mapping.scene_maps import SceneMaps

from evercal.continual.learn_jointly import learn_jointly
from evercal.continual.networks.head import Head
from evercal.continual.networks.trainer import Progress
from evercal.continual.stage import Encoding, Stage, StageOptions
from evercal.continual.strategies import STRATEGIES
from evercal.mapping.build import Mapping

from .stages import Blank, Rooms, outcome, weights


@pytest.fixture(scope="module")
def joint(blank: Blank, rooms: Rooms, quick: StageOptions) -> tuple[list[object], SceneMaps]:
    """Events of three rooms, and what is known then."""
    events = list(learn_jointly(blank("joint"), STRATEGIES["joint"], rooms, quick))
    return list(events), outcome(events)


def test_steps_are_those_of_as_many_stages(joint: tuple[list[object], SceneMaps]) -> None:
    events, _ = joint
    kinds = [kind for kind, _ in groupby(type(event) for event in events)]
    assert kinds == [Encoding, Progress, Stage]
    steps = [event for event in events if isinstance(event, Progress)]
    assert [step.step for step in steps] == list(range(1, 3 * 8 + 1))
    last = events[-1]
    assert isinstance(last, Stage)
    assert (last.iterations, last.frames_kept) == (24, 0)


@pytest.mark.parametrize(("scenes", "expected"), [(1, 64), (2, 96), (3, 96)])
def test_a_step_has_the_rows_of_one_that_learns_and_replays(
    scenes: int,
    expected: int,
    blank: Blank,
    rooms: Rooms,
    quick: StageOptions,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """64 new ones and 32 replayed; of a single scene there is nothing to replay."""
    seen: list[torch.Tensor] = []
    forward = Head.forward

    def watched(self: Head, features, scene, descriptor):
        if self.training:
            seen.append(torch.as_tensor(scene).expand(len(features)))
        return forward(self, features, scene, descriptor)

    monkeypatch.setattr(Head, "forward", watched)
    short = replace(quick, fit=replace(quick.fit, iterations=2))
    list(learn_jointly(blank("joint"), STRATEGIES["joint"], rooms[:scenes], short))
    assert len(seen) == 2 * scenes
    for scene in seen:
        each = expected // scenes
        assert torch.bincount(scene, minlength=scenes).tolist() == [each] * scenes


def test_one_head_knows_every_scene_in_its_own_cell(
    joint: tuple[list[object], SceneMaps], rooms: Rooms
) -> None:
    maps = joint[1]
    assert [record.name for record in maps.scenes] == ["alpha", "beta", "gamma"]
    assert [head.scenes for head in maps.heads] == [3]
    assert maps.keyframes == [None] * 3
    assert maps.memory_bytes == 0
    head = maps.heads[0]
    assert not head.training
    assert head.centre_scene.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    for i, scene in enumerate(rooms):
        assert maps.head_for(i) == (head, i)
        places = np.stack(
            [f.base_from_camera.translation_m for f in scene.train if f.base_from_camera]
        )
        inside = maps.scenes[i].cell.atlas_from_base.apply(places)
        centres = head.centres[head.centre_scene == i].numpy()
        assert (centres >= inside.min(0) - 1e-5).all()
        assert (centres <= inside.max(0) + 1e-5).all()
        assert maps.scenes[i].refined_camera is not None


def test_every_scene_is_trained_and_the_start_is_left_alone(
    joint: tuple[list[object], SceneMaps], blank: Blank, rooms: Rooms, quick: StageOptions
) -> None:
    nothing = blank("joint")
    still = replace(quick, fit=replace(quick.fit, iterations=0))
    start = outcome(learn_jointly(nothing, STRATEGIES["joint"], rooms, still))
    assert nothing.scenes == nothing.heads == []
    code = joint[1].heads[0].code - start.heads[0].code
    assert bool((code.abs().amax((1, 2)) > 1e-4).all())
    # The whitening is fitted to the rows of all, before the first step.
    for name in ("feature_mean", "feature_map"):
        assert torch.equal(weights(start.heads[0])[name], weights(joint[1].heads[0])[name])
    alone = outcome(learn_jointly(blank("joint"), STRATEGIES["joint"], rooms[:1], still))
    assert not torch.equal(alone.heads[0].feature_mean, start.heads[0].feature_mean)


def test_it_may_build_maps_beside(blank: Blank, rooms: Rooms, quick: StageOptions) -> None:
    short = replace(quick, fit=replace(quick.fit, iterations=1))
    events = list(learn_jointly(blank("joint_map"), STRATEGIES["joint_map"], rooms[:2], short))
    assert any(isinstance(event, Mapping) for event in events)
    maps = outcome(events)
    for keyframes in maps.keyframes:
        assert keyframes is not None
        assert len(keyframes) == 3
        assert all(len(marks) for marks in keyframes.landmarks)
    assert maps.memory_bytes == sum(k.bytes for k in maps.keyframes if k is not None)
