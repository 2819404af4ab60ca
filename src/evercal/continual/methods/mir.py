"""Which remembered views a step on new rows is about to spoil (MIR)."""

import copy

import torch
from torch import Tensor

from evercal.networks.buffer import FeatureBuffer, Rows
from evercal.networks.head import Head
from evercal.networks.loss import fixed_clamp_loss

CANDIDATES = 48
CHOSEN = 8
ROWS = 64
"""Of a view that its loss is judged by."""


def mir_views(
    head: Head, fresh: Rows, buffer: FeatureBuffer, rate: float, generator: torch.Generator
) -> Tensor:
    """Maximally interfered retrieval (Aljundi et al., NeurIPS 2019).

    A virtual step down the gradient of the new rows is taken; of some views drawn from memory,
    those are replayed whose loss it raises most.

    Args:
        head: as it is; not changed.
        fresh: new rows.
        buffer: of a remembered scene.
        rate: of the virtual step, whose length is that of an optimiser with unit updates.
        generator: of the draws.

    Returns:
        (k,) numbers of views, at most 8.
    """
    drawn = torch.randperm(buffer.views, generator=generator)[:CANDIDATES]
    view = buffer.tensors["view"]
    starts = torch.searchsorted(view, drawn.to(view.dtype))
    ends = torch.searchsorted(view, drawn.to(view.dtype), right=True)
    offsets = torch.rand(len(drawn), ROWS, generator=generator)
    index = (starts[:, None] + offsets * (ends - starts)[:, None]).long()
    rows = buffer.rows(index.clamp(max=len(buffer) - 1).flatten())
    moved = copy.deepcopy(head)
    before = _losses(head, rows, len(drawn))
    points = moved(fresh.features.float(), fresh.scene, fresh.descriptor).points
    cost, _ = fixed_clamp_loss(points, fresh.target)
    parameters = list(moved.parameters())
    found = torch.autograd.grad(cost.mean(), parameters, materialize_grads=True)
    with torch.no_grad():
        for parameter, gradient in zip(parameters, found, strict=True):
            size = gradient.square().mean().sqrt().clamp(min=1e-12)
            parameter.sub_(rate * gradient / size)
    spoiled = _losses(moved, rows, len(drawn)) - before
    return drawn[spoiled.topk(min(CHOSEN, len(drawn))).indices]


@torch.no_grad()
def _losses(head: Head, rows: Rows, views: int) -> Tensor:
    """(views,) mean loss of each view's rows."""
    points = head(rows.features.float(), rows.scene, rows.descriptor).points
    loss, _ = fixed_clamp_loss(points, rows.target)
    return loss.view(views, -1).mean(1)
