"""Maximally interfered retrieval: replay what a step on new rows is about to spoil."""

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from evercal.continual.methods.method import StageStart
from evercal.continual.methods.replay import Replay, ReplayHooks
from evercal.continual.networks.buffer import FeatureBuffer, Rows
from evercal.continual.networks.head import Head
from evercal.continual.networks.hooks import TrainingHooks
from evercal.continual.networks.loss import fixed_clamp_loss


@dataclass(frozen=True)
class MaximallyInterferedRetrieval(Replay):
    """Views are replayed whose loss a virtual step on new rows raises most (Aljundi et al., 2019).

    A virtual step down the gradient of the new rows is taken; of some views drawn from memory,
    those are replayed whose loss it raises most.
    """

    citation: ClassVar[str] = "Aljundi et al., Maximally interfered retrieval, NeurIPS 2019"
    candidates: int = 48
    """Views of a scene that are looked at."""
    chosen: int = 8
    """Views of a scene that are replayed until the next choice."""
    view_rows: int = 64
    """Rows by which a view is judged."""
    every_steps: int = 20
    """How often views are chosen anew; the original chooses in every step."""
    clamp_px: float = 50.0
    """Fixed soft clamp of the virtual step's loss and of those it raises, pixels: with a narrow one
    a view that is lost already could not get worse."""

    def begin(self, start: StageStart) -> TrainingHooks:
        """Replay of chosen views; nothing for the first scene."""
        return _MirHooks(self, start) if start.memories else TrainingHooks()


class _MirHooks(ReplayHooks):
    def __init__(self, method: MaximallyInterferedRetrieval, start: StageStart):
        super().__init__(method, start)
        self._rule, self._head, self._views = method, start.head, list[Tensor]()

    def replayed(
        self, fresh: Rows, step: int, rate: float, generator: torch.Generator
    ) -> list[Rows]:
        if step % self._rule.every_steps == 0 or not self._views:
            self._views = [
                interfered_views(self._rule, self._head, fresh, memory, rate, generator)
                for memory in self.memories
            ]
        rows = []
        for memory, views in zip(self.memories, self._views, strict=True):
            view = memory.tensors["view"]
            where = torch.nonzero(torch.isin(view, views.to(view.device)))[:, 0]
            drawn = torch.randint(len(where), (self.each,), generator=generator, device="cpu")
            rows.append(memory.rows(where[drawn.to(where.device)]))
        return rows

    def state(self) -> dict[str, Tensor]:
        return {f"views.{i}": views for i, views in enumerate(self._views)}

    def load(self, state: Mapping[str, Tensor]) -> None:
        self._views = [state[f"views.{i}"] for i in range(len(state))]


def interfered_views(
    method: MaximallyInterferedRetrieval,
    head: Head,
    fresh: Rows,
    memory: FeatureBuffer,
    rate: float,
    generator: torch.Generator,
) -> Tensor:
    """(k,) numbers of the views that a step on new rows would spoil most.

    Args:
        method: how many views and rows.
        head: as it is; not changed.
        fresh: new rows.
        memory: rows of a remembered scene.
        rate: of the virtual step, whose length is that of an optimiser with unit updates.
        generator: of the draws.
    """
    drawn = torch.randperm(memory.views, generator=generator, device="cpu")[: method.candidates]
    view = memory.tensors["view"].cpu()
    starts = torch.searchsorted(view, drawn.to(view.dtype))
    ends = torch.searchsorted(view, drawn.to(view.dtype), right=True)
    offsets = torch.rand(len(drawn), method.view_rows, generator=generator, device="cpu")
    index = (starts[:, None] + offsets * (ends - starts)[:, None]).long()
    rows = memory.rows(index.clamp(max=len(memory) - 1).flatten())
    moved = copy.deepcopy(head)
    before = _losses(method, head, rows, len(drawn))
    points = moved(fresh.features.float(), fresh.scene, fresh.descriptor).points
    cost, _ = fixed_clamp_loss(points, fresh.target, method.clamp_px)
    parameters = list(moved.parameters())
    found = torch.autograd.grad(cost.mean(), parameters, materialize_grads=True)
    with torch.no_grad():
        for parameter, gradient in zip(parameters, found, strict=True):
            size = gradient.square().mean().sqrt().clamp(min=1e-12)
            parameter.sub_(rate * gradient / size)
    spoiled = _losses(method, moved, rows, len(drawn)) - before
    return drawn[spoiled.topk(min(method.chosen, len(drawn))).indices.cpu()]


@torch.no_grad()
def _losses(method: MaximallyInterferedRetrieval, head: Head, rows: Rows, views: int) -> Tensor:
    """(views,) mean loss of each view's rows."""
    points = head(rows.features.float(), rows.scene, rows.descriptor).points
    loss, _ = fixed_clamp_loss(points, rows.target, method.clamp_px)
    return loss.view(views, -1).mean(1)
