"""EWC: weights are tied to earlier values in proportion to their importance."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from evercal.continual.methods.method import FinishedScene, Method, StageStart
from evercal.continual.networks.hooks import TrainingHooks
from evercal.continual.networks.loss import fixed_clamp_loss

IMAGE_ROWS = 256
"""Rows of each image from which a gradient is computed."""


@dataclass(frozen=True)
class ElasticWeightConsolidation(Method):
    """The cost is strength / 2 x mean over weights of sum_s I_s (w - w_s)^2.

    The importance I_s of a weight for scene s is the diagonal of the empirical Fisher information:
    the mean over images of the squared gradient of an image's mean loss, with a fixed clamp (a
    Laplace-like likelihood). Importances are scaled to mean 1. Parameter rows that later scenes
    append are free.
    """

    citation: ClassVar[str] = "Kirkpatrick et al., PNAS 2017"
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
        anchors = {
            f"anchor.{k}": _half(v.detach()) for k, v in scene.head.named_parameters()
        }
        return anchors | {f"importance.{k}": _half(v) for k, v in importances.items()}


class _TiedWeights(TrainingHooks):
    def __init__(self, method: ElasticWeightConsolidation, start: StageStart):
        self.method = method
        self._head = start.head
        # Of each earlier scene, by parameter name: anchor and importance of the first rows.
        named = list(start.head.named_parameters())
        self._ties = [
            {k: (s[f"anchor.{k}"].to(v), s[f"importance.{k}"].to(v)) for k, v in named}
            for s in start.states
        ]

    def regularizer(self) -> Tensor | None:
        if not self._ties:
            return None
        cost = torch.zeros((), device=self._head.device)
        for name, value in self._head.named_parameters():
            for tie in self._ties:
                anchor, importance = tie[name]
                cost = (
                    cost + (importance * (value[: len(anchor)] - anchor).square()).sum()
                )
        count = sum(value.numel() for value in self._head.parameters())
        return self.method.strength * (0.5 / count * cost)


def fisher_information(scene: FinishedScene, images: int) -> dict[str, Tensor]:
    """Average the squared gradients of the losses of some images, by parameter name."""
    buffer = scene.rows()
    generator = torch.Generator().manual_seed(buffer.scene)
    names, values = zip(*scene.head.named_parameters(), strict=True)
    total = dict(zip(names, map(torch.zeros_like, values), strict=True))
    starts = buffer.starts.tolist()
    drawn = torch.randperm(buffer.views, generator=generator, device="cpu")[:images]
    for number in drawn.tolist():
        start, end = starts[number : number + 2]
        some = torch.randint(
            end - start, (IMAGE_ROWS,), generator=generator, device="cpu"
        )
        rows = buffer.rows(start + some)
        loss, _ = fixed_clamp_loss(scene.output(rows).points, rows.target)
        gradients = torch.autograd.grad(loss.mean(), values, materialize_grads=True)
        for name, gradient in zip(names, gradients, strict=True):
            total[name] += gradient.square() / len(drawn)
    return total


def scaled_to_mean_one(importance: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Divide importances by their mean over all weights."""
    count = sum(value.numel() for value in importance.values())
    mean = sum(float(value.sum()) for value in importance.values()) / count
    return {name: value / max(mean, 1e-30) for name, value in importance.items()}


def _half(value: Tensor) -> Tensor:
    return value.clamp(max=torch.finfo(torch.half).max).half().cpu()
