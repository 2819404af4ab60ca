"""The controls: fine-tuning, and isolation with a head per scene."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
import torch

from evercal.continual.methods.method import FineTuning, Isolation
from evercal.continual.networks.hooks import TrainingHooks
from evercal.continual.strategies import STRATEGIES

from ..stages import learn, weights
from .by_hand import stage_start, wave_head

if TYPE_CHECKING:
    from evercal.continual.learning.stage import StageOptions

    from ..stages import EmptyScenes, Rooms


def test_controls_add_nothing_to_training() -> None:
    for method in (FineTuning(), Isolation()):
        assert type(method.begin(stage_start(wave_head(1), []))) is TrainingHooks
        assert not method.replays


@pytest.mark.parametrize(
    ("condition", "offsets"), [("code", "per_centre"), ("descriptor", "shared")]
)
def test_new_head_starts_from_the_shared_weights_of_the_last(
    condition: str,
    offsets: str,
    empty_scenes: EmptyScenes,
    rooms: Rooms,
    quick: StageOptions,
) -> None:
    """Without training, the second head differs from the first only in the scene's parameters."""
    isolation = STRATEGIES["isolation"]
    shape = replace(quick.head, offsets=offsets, condition=condition)  # pyright: ignore
    options = replace(quick, head=shape)
    untrained = replace(options, fit=replace(quick.fit, iterations=0))
    first = learn(empty_scenes("isolation"), isolation, rooms[0], options)
    before = weights(first.heads[0])
    own = {"code", "logit", "logit_bias", "centres"}
    own |= {"offset", "offset_bias"} if offsets == "per_centre" else set()
    same = learn(first, isolation, rooms[1], untrained)
    for name, value in weights(same.heads[1]).items():
        if name != "centre_scene":
            assert torch.equal(value, before[name]) != (name in own), name
    assert (same.heads[1].scenes, len(same.heads[1].centres)) == (1, 3)
    trained = learn(first, isolation, rooms[1], options)
    for scenes in (same, trained):
        after = weights(scenes.heads[0])
        assert all(torch.equal(value, before[name]) for name, value in after.items())
    assert not torch.equal(
        weights(trained.heads[1])["first.1.weight"], before["first.1.weight"]
    )
    assert [first.head_for(0)[1], trained.head_for(1)[1]] == [0, 0]
