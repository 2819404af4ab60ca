"""EWC: weights are tied to earlier values in proportion to their importance."""

from collections.abc import Mapping

import torch
from torch import Generator, Tensor

from evercal.classes import frozen
from evercal.continual.methods.method import FinishedScene, Method, StageStart
from evercal.continual.networks.buffer import Rows, random_indices
from evercal.continual.networks.head import HeadOutput
from evercal.continual.networks.hooks import TrainingHooks
from evercal.continual.networks.loss import fixed_clamp_loss

IMAGE_ROWS = 256
"""Rows of each image from which a gradient is computed."""


@frozen
class ElasticWeightConsolidation(Method):
    """EWC (Kirkpatrick et al., PNAS 2017).

    The cost is strength / 2 x mean over weights of sum_s I_s (w - w_s)^2.

    The importance I_s of a weight for scene s is the diagonal of the empirical Fisher information:
    the mean over images of the squared gradient of an image's mean loss, with a fixed clamp (a
    Laplace-like likelihood). Importances are scaled to mean 1. Parameter rows that later scenes
    append are free.
    """

    weight_field = "strength"
    strength: float = 1e6
    """Weight of the mean squared change, weighted by importances of mean 1."""
    images: int = 200
    """Images of the finished scene from which importances are computed."""

    def begin(self, start: StageStart) -> TrainingHooks:
        """Add the cost of changing weights; it is zero for the first scene."""
        return _TiedWeights(self, start)

    def after_scene(self, scene: FinishedScene) -> dict[str, Tensor]:
        """Return `anchor.NAME` and `importance.NAME` of every parameter, half precision."""
        importances = scaled_to_mean_one(fisher_information(scene, self.images))
        state = {}
        for name, value in scene.head.named_parameters():
            state[f"anchor.{name}"] = _half(value.detach())
        for name, importance in importances.items():
            state[f"importance.{name}"] = _half(importance)
        return state


class _TiedWeights(TrainingHooks):
    def __init__(self, method: ElasticWeightConsolidation, start: StageStart):
        self.method = method
        self._head = start.head
        self._ties: list[dict[str, Tensor]] = []
        for state in start.states:
            self._ties.append({k: v.to(start.head.code) for k, v in state.items()})

    def cost(self, output: HeadOutput, rows: Rows, tau_px: float) -> Tensor | None:
        if not self._ties:
            return None
        cost = torch.zeros((), device=self._head.device)
        count = 0
        for name, value in self._head.named_parameters():
            count += value.numel()
            for tie in self._ties:
                anchor = tie[f"anchor.{name}"]
                importance = tie[f"importance.{name}"]
                change = value[: len(anchor)] - anchor
                cost = cost + (importance * change.square()).sum()
        return self.method.strength * (0.5 / count * cost)


def fisher_information(scene: FinishedScene, images: int) -> dict[str, Tensor]:
    """Average the squared gradients of the losses of some images, by parameter name."""
    buffer = scene.rows()
    generator = Generator().manual_seed(buffer.scene)
    parameters = dict(scene.head.named_parameters())
    total = {name: torch.zeros_like(value) for name, value in parameters.items()}
    starts = buffer.starts.tolist()
    shuffled = torch.randperm(buffer.views, generator=generator, device="cpu")
    drawn = shuffled[:images].tolist()
    for view in drawn:
        start = starts[view]
        count = starts[view + 1] - start
        rows = buffer.rows(start + random_indices(count, IMAGE_ROWS, generator))
        loss, _ = fixed_clamp_loss(scene.output(rows).points, rows.target)
        gradients = torch.autograd.grad(
            loss.mean(), list(parameters.values()), materialize_grads=True
        )
        for name, gradient in zip(total, gradients, strict=True):
            total[name] += gradient.square() / len(drawn)
    return total


def scaled_to_mean_one(importance: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Divide importances by their mean over all weights."""
    count = 0
    total = 0.0
    for value in importance.values():
        count += value.numel()
        total += float(value.sum())
    mean = total / count
    return {name: value / max(mean, 1e-30) for name, value in importance.items()}


def _half(value: Tensor) -> Tensor:
    return value.clamp(max=torch.finfo(torch.half).max).half().cpu()
