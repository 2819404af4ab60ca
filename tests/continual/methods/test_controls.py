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
def test_every_scene_has_a_head_of_its_own(
    condition: str,
    offsets: str,
    empty_scenes: EmptyScenes,
    rooms: Rooms,
    quick: StageOptions,
) -> None:
    """The second scene is learned as if it were the first, and leaves the first head alone."""
    isolation = STRATEGIES["isolation"]
    shape = replace(quick.head, offsets=offsets, condition=condition)  # pyright: ignore
    options = replace(quick, head=shape)
    first = learn(empty_scenes("isolation"), isolation, rooms[0], options)
    before = weights(first.heads[0])
    trained = learn(first, isolation, rooms[1], options)
    after = weights(trained.heads[0])
    assert all(torch.equal(value, before[name]) for name, value in after.items())
    second = trained.heads[1]
    assert (second.scenes, len(second.centres)) == (1, 3)
    assert not torch.equal(second.feature_map, first.heads[0].feature_map) or (
        condition == "descriptor"
    )
    assert [first.head_for(0)[1], trained.head_for(1)[1]] == [0, 0]
