"""Maximally interfered retrieval: replay of views that a step on new rows harms most."""

import copy

import torch
from torch import Generator, Tensor

from evercal.classes import frozen
from evercal.continual.methods.method import StageStart
from evercal.continual.methods.replay import Replay, ReplayHooks
from evercal.continual.networks.buffer import FeatureBuffer, Rows, random_indices
from evercal.continual.networks.head import Head
from evercal.continual.networks.hooks import TrainingHooks
from evercal.continual.networks.loss import fixed_clamp_loss


@frozen
class MaximallyInterferedRetrieval(Replay):
    """MIR (Aljundi et al., 2019): replays the views whose loss a virtual step raises most.

    The virtual step follows the negative gradient of the new rows. Candidates are random views of
    each remembered scene.
    """

    candidates: int = 48
    """Candidate views per scene."""
    chosen: int = 8
    """Views per scene that are replayed until the next selection."""
    view_rows: int = 64
    """Rows from which a view's loss is estimated."""
    every_steps: int = 20
    """Steps between selections; the original selects in every step."""
    clamp_px: float = 50.0
    """Fixed soft clamp of the virtual step and its losses, pixels. It is wide, because under a
    narrow clamp the loss of a forgotten view is constant."""

    def hooks(self, start: StageStart) -> TrainingHooks:
        """Replay the selected views."""
        return _MirHooks(self, start)

    def interfered_views(
        self,
        head: Head,
        fresh: Rows,
        memory: FeatureBuffer,
        rate: float,
        generator: Generator,
    ) -> Tensor:
        """Select the views (k,) of a remembered scene that a step on new rows harms most.

        The head is not changed. `rate` is the root mean square change of each parameter in the
        virtual step.
        """
        shuffled = torch.randperm(memory.views, generator=generator, device="cpu")
        drawn = shuffled[: self.candidates]
        starts = memory.starts
        first = starts[drawn, None]
        sizes = starts.diff()[drawn, None]
        shape = (len(drawn), self.view_rows)
        offsets = torch.rand(shape, generator=generator, device="cpu")
        index = (first + offsets * sizes).long()
        rows = memory.rows(index.clamp(max=len(memory) - 1).flatten())
        moved = copy.deepcopy(head)
        before = self._view_losses(head, rows)
        parameters = list(moved.parameters())
        cost = self._losses(moved, fresh).mean()
        gradients = torch.autograd.grad(cost, parameters, materialize_grads=True)
        with torch.no_grad():
            for parameter, gradient in zip(parameters, gradients, strict=True):
                size = gradient.square().mean().sqrt().clamp(min=1e-12)
                parameter.sub_(rate * gradient / size)
        harm = self._view_losses(moved, rows) - before
        worst = harm.topk(min(self.chosen, len(drawn)))
        return drawn[worst.indices.cpu()]

    def _losses(self, head: Head, rows: Rows) -> Tensor:
        points = head(rows.features.float(), rows.scene, rows.descriptor).points
        losses, _ = fixed_clamp_loss(points, rows.target, self.clamp_px)
        return losses

    @torch.no_grad()
    def _view_losses(self, head: Head, rows: Rows) -> Tensor:
        return self._losses(head, rows).view(-1, self.view_rows).mean(1)


class _MirHooks(ReplayHooks):
    carried = ("_views",)

    def __init__(self, method: MaximallyInterferedRetrieval, start: StageStart):
        super().__init__(method, start)
        self._options = method
        self._head = start.head
        self._views = list[Tensor]()

    def replayed(
        self, fresh: Rows, step: int, rate: float, generator: Generator
    ) -> list[Rows]:
        method = self._options
        if step % method.every_steps == 0 or not self._views:
            self._views = [
                method.interfered_views(self._head, fresh, memory, rate, generator)
                for memory in self.memories
            ]
        replayed = []
        for memory, views in zip(self.memories, self._views, strict=True):
            view = memory.tensors["view"]
            usable = torch.nonzero(torch.isin(view, views.to(view.device)))[:, 0]
            drawn = random_indices(len(usable), self.each, generator)
            replayed.append(memory.rows(usable[drawn.to(usable.device)]))
        return replayed
