"""The controls: fine-tuning, and isolation with a head per scene."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
import torch

from evercal.continual.methods.method import FineTuning, Isolation
from evercal.continual.networks.hooks import TrainingHooks

from ..stages import learn, outcome, second_stage, weights
from .by_hand import stage_start, wave_head

if TYPE_CHECKING:
    from evercal.continual.learning.stage import StageOptions
    from evercal.continual.networks.head import Head

    from ..stages import EmptyScenes, Rooms


def saved(head: Head) -> bytes:
    """Serialise a head."""
    file = io.BytesIO()
    torch.save(head.state_dict(), file)
    return file.getvalue()


def test_controls_add_nothing_to_training() -> None:
    for method in (FineTuning(), Isolation()):
        hooks = method.begin(stage_start(wave_head(1), []))
        assert type(hooks) is TrainingHooks
        assert not method.replays


@pytest.mark.parametrize("offsets", ["per_centre", "shared"])
@pytest.mark.parametrize("condition", ["code", "descriptor"])
def test_new_head_starts_from_the_shared_weights_of_the_last(
    condition: str,
    offsets: str,
    empty_scenes: EmptyScenes,
    rooms: Rooms,
    quick: StageOptions,
) -> None:
    """Without training, the second head differs from the first only in the scene's parameters."""
    from evercal.continual.strategies import STRATEGIES

    isolation = STRATEGIES["isolation"]
    shape = replace(quick.head, offsets=offsets, condition=condition)  # pyright: ignore
    options = replace(quick, head=shape)
    scenes = outcome(learn(empty_scenes("isolation"), isolation, rooms[0], options))
    before = saved(scenes.heads[0])
    untrained = replace(options, fit=replace(quick.fit, iterations=0))
    same = outcome(second_stage(scenes, rooms, untrained))
    trained = outcome(second_stage(scenes, rooms, options))
    third = outcome(learn(trained, isolation, rooms[2], untrained))
    own = {"code", "logit", "logit_bias", "centres"}
    own |= {"offset", "offset_bias"} if offsets == "per_centre" else set()
    for heads in (same.heads, trained.heads, third.heads):
        assert saved(heads[0]) == before
    assert saved(third.heads[1]) == saved(trained.heads[1])
    for new, last in (
        (same.heads[1], scenes.heads[0]),
        (third.heads[2], trained.heads[1]),
    ):
        assert new.scenes == 1
        assert len(new.centres) == 3
        for name, value in weights(new).items():
            if name == "centre_scene":
                continue
            assert torch.equal(value, weights(last)[name]) != (name in own), name
    assert not torch.equal(
        weights(trained.heads[1])["first.1.weight"], weights(scenes.heads[0])["first.1.weight"]
    )
    assert [scenes.head_for(0)[1], trained.head_for(1)[1], third.head_for(2)[1]] == [0, 0, 0]
