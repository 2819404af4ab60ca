"""Maximally interfered retrieval selects harmed views and does not change the head."""

import copy

import pytest
import torch

from evercal.continual.methods.mir import MaximallyInterferedRetrieval
from evercal.continual.networks.buffer import FeatureBuffer, Rows
from evercal.continual.networks.head import Head
from evercal.continual.networks.hooks import TrainingHooks
from evercal.continual.networks.trainer import FitOptions, HeadTrainer

from ..box_features import Learnable, head_at_cameras
from ..draws import seeded
from .by_hand import stage_start

OPTIONS = FitOptions(iterations=20, batch=96, replay_batch=60)
MIR = MaximallyInterferedRetrieval()


@pytest.fixture(scope="module")
def trained_head(learnable: Learnable) -> tuple[Head, FeatureBuffer]:
    """A head trained on a scene of 24 views, and the scene's rows."""
    buffer, _ = learnable(views=24)
    head = head_at_cameras([buffer])
    options = FitOptions(iterations=300, batch=512, replay_batch=64)
    *_, last = HeadTrainer(head, [buffer], options, 0).run()
    assert last.inlier_share > 0.5
    return head, buffer


@pytest.mark.parametrize("harmed", [3, 17])
def test_views_contradicted_by_new_rows_are_selected(
    trained_head: tuple[Head, FeatureBuffer], harmed: int
) -> None:
    """New rows have the features of one remembered view and other targets."""
    head, buffer = trained_head
    before = copy.deepcopy(head.state_dict())
    rows = buffer.rows(torch.nonzero(buffer.tensors["view"] == harmed)[:, 0])
    rows.target.pixels = rows.target.pixels + torch.tensor([6.0, 0.0])
    actual = [
        MIR.interfered_views(head, rows, buffer, 5e-4, seeded(seed)).tolist()
        for seed in range(5)
    ]
    assert all(len(set(views)) == MIR.chosen for views in actual)
    hits = sum(harmed in views for views in actual)
    assert hits >= 4  # a third by chance
    for name, value in head.state_dict().items():
        assert torch.equal(value, before[name]), name


def test_only_selected_views_are_replayed(learnable: Learnable) -> None:
    old = learnable(0, views=24)[0]
    new = learnable(1)[0]
    captured: list[set[tuple[float, ...]]] = []  # every view has its own descriptor

    def hooks_for(head: Head) -> TrainingHooks:
        hooks = MIR.begin(stage_start(head, [old], replay_rows=60))
        replayed = hooks.replayed

        def watched(
            fresh: Rows, step: int, rate: float, generator: torch.Generator
        ) -> list[Rows]:
            parts = replayed(fresh, step, rate, generator)
            captured.append({tuple(row) for row in parts[0].descriptor.tolist()})
            assert len(parts[0].scene) == 60
            return parts

        hooks.replayed = watched  # type: ignore[method-assign]
        return hooks

    head = head_at_cameras([old, new])
    list(HeadTrainer(head, [new], OPTIONS, 3, hooks_for(head)).run())
    assert len(set.union(*captured)) <= MIR.chosen  # one selection for twenty steps
