"""Joint training: the steps and rows of as many stages, and one head for all scenes."""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby

import pytest
import torch

from evercal.continual.learning.learn import learn_jointly
from evercal.continual.learning.stage import Part, StageOptions
from evercal.continual.networks.head import Head
from evercal.continual.networks.trainer import Progress
from evercal.continual.scenes import LearnedScenes
from evercal.recordings.frame import stated_poses

from ..stages import EmptyScenes, Rooms, weights


@pytest.fixture(scope="module")
def scenes(
    empty_scenes: EmptyScenes, rooms: Rooms, quick: StageOptions
) -> LearnedScenes:
    """Three rooms, learned with the steps of three stages."""
    events: list[Part | Progress] = []
    after = learn_jointly(empty_scenes("joint"), rooms, quick, events.append)
    kinds = [kind for kind, _ in groupby(type(event) for event in events)]
    assert kinds == [Part, Progress]
    steps = [event.step for event in events if isinstance(event, Progress)]
    assert steps == list(range(1, 3 * 8 + 1))
    assert after.frames_kept == 0
    return after


@pytest.mark.parametrize(("count", "rows"), [(1, 64), (2, 96), (3, 96)])
def test_steps_have_the_rows_of_learning_and_replay(
    count: int,
    rows: int,
    empty_scenes: EmptyScenes,
    rooms: Rooms,
    quick: StageOptions,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """64 new rows and, with several scenes, 32 replayed ones."""
    batches: list[torch.Tensor] = []
    forward = Head.forward

    def recorded(self: Head, features, scene, descriptor):
        if self.training:
            batches.append(torch.as_tensor(scene).expand(len(features)))
        return forward(self, features, scene, descriptor)

    monkeypatch.setattr(Head, "forward", recorded)
    short = replace(quick, fit=replace(quick.fit, iterations=2))
    learn_jointly(empty_scenes("joint"), rooms[:count], short)
    assert len(batches) == 2 * count
    for batch in batches:
        assert (
            torch.bincount(batch, minlength=count).tolist() == [rows // count] * count
        )


def test_one_head_has_the_centres_of_every_scene(
    scenes: LearnedScenes, rooms: Rooms
) -> None:
    assert [record.name for record in scenes.scenes] == ["alpha", "beta", "gamma"]
    assert [head.scenes for head in scenes.heads] == [3]
    assert scenes.keyframes == [None] * 3
    assert scenes.memory_bytes == 0
    head = scenes.heads[0]
    assert not head.training
    assert head.centre_scene.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    for i, scene in enumerate(rooms):
        assert scenes.head_for(i) == (head, i)
        positions = stated_poses(scene.train).translation_m
        in_atlas = scenes.scenes[i].cell.atlas_from_base.apply(positions)
        centres = head.centres[head.centre_scene == i].numpy()
        assert (centres >= in_atlas.min(0) - 1e-5).all()
        assert (centres <= in_atlas.max(0) + 1e-5).all()


def test_every_scene_is_trained(
    scenes: LearnedScenes, empty_scenes: EmptyScenes, rooms: Rooms, quick: StageOptions
) -> None:
    empty = empty_scenes("joint")
    untrained = replace(quick, fit=replace(quick.fit, iterations=0))
    start = learn_jointly(empty, rooms, untrained)
    assert empty.scenes == empty.heads == []
    change = scenes.heads[0].code - start.heads[0].code
    assert bool((change.abs().amax((1, 2)) > 1e-4).all())
    # The whitening is fitted to the rows of all scenes before the first step.
    for name in ("feature_mean", "feature_map"):
        assert torch.equal(
            weights(start.heads[0])[name], weights(scenes.heads[0])[name]
        )
    one = learn_jointly(empty_scenes("joint"), rooms[:1], untrained)
    assert not torch.equal(one.heads[0].feature_mean, start.heads[0].feature_mean)
