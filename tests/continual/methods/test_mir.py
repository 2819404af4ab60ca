"""Maximally interfered retrieval: what a step spoils is found, and the head stays as it was."""

import copy
from collections.abc import Callable
from itertools import islice

import pytest
import torch
from torch import Tensor

from evercal.continual.methods.mir import CHOSEN, mir_views
from evercal.networks.buffer import FeatureBuffer, Rows
from evercal.networks.head import Head, HeadOptions, HeadOutput
from evercal.networks.trainer import FitOptions, HeadTrainer, Replay

Learnable = Callable[..., tuple[FeatureBuffer, Tensor]]
OPTIONS = FitOptions(iterations=20, batch=96, replay_batch=60)


def cost(output: HeadOutput, rows: Rows, progress: float) -> Tensor:
    return output.points.abs().mean()


def head_of(buffers: list[FeatureBuffer]) -> Head:
    torch.manual_seed(0)
    head = Head(48, 6, HeadOptions(width=32))
    for buffer in buffers:
        matrix = buffer.tensors["camera_from_atlas"][:3].double()
        head.grow((-matrix[:, :, :3].mT @ matrix[:, :, 3:])[..., 0].float(), seed=buffer.scene)
    return head


@pytest.fixture(scope="module")
def taught(learnable: Learnable) -> tuple[Head, FeatureBuffer]:
    """A head that knows a scene of 24 views."""
    buffer, _ = learnable(views=24)
    head = head_of([buffer])
    options = FitOptions(iterations=600, batch=512, replay_batch=64)
    *_, last = HeadTrainer(head, [buffer], None, options, 0).run()
    assert last.inlier_share > 0.5
    return head, buffer


@pytest.mark.parametrize("harmed", [3, 17])
def test_views_that_the_new_rows_contradict_are_found(
    taught: tuple[Head, FeatureBuffer], harmed: int
) -> None:
    """New rows look like one remembered view and want their points elsewhere."""
    head, buffer = taught
    before = copy.deepcopy(head.state_dict())
    rows = buffer.rows(torch.nonzero(buffer.tensors["view"] == harmed)[:, 0])
    rows.target.pixels = rows.target.pixels + torch.tensor([6.0, 0.0])
    found = [
        mir_views(head, rows, buffer, 5e-4, torch.Generator().manual_seed(seed)).tolist()
        for seed in range(5)
    ]
    assert all(len(set(views)) == CHOSEN for views in found)
    hits = sum(harmed in views for views in found)
    assert hits >= 4  # by chance a third of them
    for name, value in head.state_dict().items():
        assert torch.equal(value, before[name]), name


def test_only_chosen_views_are_replayed_and_a_stop_does_not_show(learnable: Learnable) -> None:
    old, _ = learnable(0, views=24)
    new, _ = learnable(1)
    seen: list[set[int]] = []

    def watched(output: HeadOutput, rows: Rows, progress: float) -> Tensor:
        seen.append(set(old.tensors["view"][rows.index].tolist()))
        return cost(output, rows, progress)

    head = head_of([old, new])
    twin, third = copy.deepcopy(head), copy.deepcopy(head)
    list(HeadTrainer(head, [new], Replay([old], watched, choose_views=mir_views), OPTIONS, 3).run())
    assert len(set.union(*seen)) <= CHOSEN  # one choice lasts for these twenty steps
    first = HeadTrainer(twin, [new], Replay([old], cost, choose_views=mir_views), OPTIONS, 3)
    list(islice(first.run(), 7))
    second = HeadTrainer(third, [new], Replay([old], cost, choose_views=mir_views), OPTIONS, 3)
    second.load({key: value.clone() for key, value in first.state().items()})
    list(second.run())
    for (name, value), other in zip(
        head.state_dict().items(), third.state_dict().values(), strict=True
    ):
        assert torch.equal(value, other), name
