"""EWC, SI and MAS: weights are tied to earlier values in proportion to their importance.

Importances are scaled to mean 1, so a strength has the same meaning for all methods. Parameter rows
that later scenes append are free.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from evercal.continual.methods.method import FinishedScene, Method, MethodState, StageStart
from evercal.continual.networks.buffer import FeatureBuffer, Rows
from evercal.continual.networks.head import Head
from evercal.continual.networks.hooks import ProposedStep, TrainingHooks
from evercal.continual.networks.loss import fixed_clamp_loss

IMAGE_ROWS = 256
"""Rows of each image from which a gradient is computed."""
MEAN_ROWS = 8192
"""Rows from which the mean of a scene's points is estimated."""


@dataclass(frozen=True)
class WeightRegularization(Method):
    """Base of the three, with cost strength / 2 x mean over weights of sum_s I_s (w - w_s)^2."""

    strength: float = 1e6
    """Weight of the mean squared change, weighted by importances of mean 1."""
    running: bool = False
    """Use one running sum of importances and the newest weights instead of a pair per scene."""
    decay: float = 0.9
    """Factor of the running sum with every scene."""
    images: int = 200
    """Images of the finished scene from which importances are computed."""

    def begin(self, start: StageStart) -> TrainingHooks:
        """Add the cost of changing weights; it is zero for the first scene."""
        return _TiedWeights(self, start)

    def after_scene(self, scene: FinishedScene) -> dict[str, Tensor]:
        """Return `anchor.NAME` and `importance.NAME` of every parameter, half precision."""
        importances = scaled_to_mean_one(self.importance(scene))
        if self.running and scene.earlier:
            for name, value in importances.items():
                old = scene.earlier[-1][f"importance.{name}"].to(value)
                value[: len(old)] += self.decay * old
        anchors = {f"anchor.{k}": _half(v.detach()) for k, v in scene.head.named_parameters()}
        return anchors | {f"importance.{k}": _half(v) for k, v in importances.items()}

    def needed(self, states: Sequence[MethodState]) -> Sequence[MethodState]:
        """Select the newest state if there is a running sum, else all."""
        return states[-1:] if self.running else states

    def importance(self, scene: FinishedScene) -> dict[str, Tensor]:
        """Compute the importance of every weight for a finished scene, by parameter name."""
        raise NotImplementedError


class _TiedWeights(TrainingHooks):
    def __init__(self, method: WeightRegularization, start: StageStart):
        self.method, self._head = method, start.head
        # Of each earlier scene, by parameter name: anchor and importance of the first rows.
        named = list(start.head.named_parameters())
        self._ties = [
            {k: (s[f"anchor.{k}"].to(v), s[f"importance.{k}"].to(v)) for k, v in named}
            for s in method.needed(start.states)
        ]

    def regularizer(self) -> Tensor | None:
        if not self._ties:
            return None
        cost = torch.zeros((), device=self._head.device)
        for name, value in self._head.named_parameters():
            for tie in self._ties:
                anchor, importance = tie[name]
                cost = cost + (importance * (value[: len(anchor)] - anchor).square()).sum()
        count = sum(value.numel() for value in self._head.parameters())
        return self.method.strength * (0.5 / count * cost)


@dataclass(frozen=True)
class ElasticWeightConsolidation(WeightRegularization):
    """EWC: importance is the diagonal of the empirical Fisher information.

    It is the mean over images of the squared gradient of an image's mean loss, with a fixed clamp
    (a Laplace-like likelihood). `running` is the online form (Schwarz et al., ICML 2018).
    """

    citation: ClassVar[str] = "Kirkpatrick et al., PNAS 2017; online: Schwarz et al., ICML 2018"

    def importance(self, scene: FinishedScene) -> dict[str, Tensor]:
        """Compute mean squared gradients."""

        def loss(rows: Rows) -> Tensor:
            points = scene.output(rows).points
            return fixed_clamp_loss(points, rows.target)[0].mean()

        return mean_over_images(scene.head, scene.rows(), self.images, loss, torch.square)


@dataclass(frozen=True)
class MemoryAwareSynapses(WeightRegularization):
    """MAS: importance is the sensitivity of the squared output length to a weight.

    The output is the predicted point relative to the mean point of the scene. Its length in the
    atlas would depend on the position of the scene.
    """

    citation: ClassVar[str] = "Aljundi et al., Memory aware synapses, ECCV 2018"
    running: bool = True
    decay: float = 1.0

    def importance(self, scene: FinishedScene) -> dict[str, Tensor]:
        """Compute mean absolute gradients."""
        buffer = scene.rows()

        def points(rows: Rows) -> Tensor:
            return scene.output(rows).points

        with torch.no_grad():
            drawn = buffer.draw(MEAN_ROWS, torch.Generator().manual_seed(scene.number))
            middle = points(drawn).mean(0)

        def length(rows: Rows) -> Tensor:
            return (points(rows) - middle).square().sum(-1).mean()

        return mean_over_images(scene.head, buffer, self.images, length, torch.abs)


@dataclass(frozen=True)
class SynapticIntelligence(WeightRegularization):
    """SI: importance is a weight's contribution to the fall of the loss.

    The product of gradient and applied change is summed over the steps, then divided by the squared
    distance from start to end.
    """

    citation: ClassVar[str] = "Zenke et al., Continual learning through SI, ICML 2017"
    first_scene_alike: ClassVar[bool] = False
    strength: float = 1e7
    running: bool = True
    decay: float = 1.0
    damping: float = 0.1
    """Added to the squared distance, as a share of its mean."""

    def begin(self, start: StageStart) -> TrainingHooks:
        """Accumulate the path, from the first scene on."""
        return _PathIntegral(self, start)

    def importance(self, scene: FinishedScene) -> dict[str, Tensor]:
        """Divide path integrals by squared distances."""
        assert isinstance(scene.hooks, _PathIntegral)
        return scene.hooks.importance(scene.head)


class _PathIntegral(_TiedWeights):
    edits_steps = True

    def __init__(self, method: SynapticIntelligence, start: StageStart):
        super().__init__(method, start)
        self._damping = method.damping
        named = dict(start.head.named_parameters())
        self._path = {name: torch.zeros_like(value) for name, value in named.items()}
        self._first = {name: value.detach().clone() for name, value in named.items()}

    def edit_step(self, proposed: ProposedStep) -> None:
        """Add gradient x change to the path, without editing the step.

        The gradient is that of the new rows, so the gradient of the ties is subtracted.
        """
        named = dict(self._head.named_parameters())
        count = sum(value.numel() for value in named.values())
        for name, value in named.items():
            gradient = proposed.gradients[name].clone()
            before = value.detach() - proposed.changes[name]
            for tie in self._ties:
                anchor, importance = tie[name]
                pull = importance * (before[: len(anchor)] - anchor)
                gradient[: len(anchor)] -= self.method.strength / count * pull
            self._path[name] -= gradient * proposed.changes[name]

    def importance(self, head: Head) -> dict[str, Tensor]:
        """Compute max(path, 0) / (distance^2 + damping x mean distance^2), by parameter name."""
        squared = {k: (v.detach() - self._first[k]).square() for k, v in head.named_parameters()}
        count = sum(value.numel() for value in squared.values())
        mean = sum(float(value.sum()) for value in squared.values()) / count
        floor = max(self._damping * mean, 1e-30)
        return {k: self._path[k].clamp(min=0) / (value + floor) for k, value in squared.items()}

    def state(self) -> dict[str, Tensor]:
        first = {f"first.{k}": v for k, v in self._first.items()}
        return first | {f"path.{k}": v for k, v in self._path.items()}

    def load(self, state: Mapping[str, Tensor]) -> None:
        for name in self._path:
            device = self._path[name].device
            self._path[name] = state[f"path.{name}"].to(device, copy=True)
            self._first[name] = state[f"first.{name}"].to(device, copy=True)


def mean_over_images(
    head: Head,
    buffer: FeatureBuffer,
    images: int,
    value: Callable[[Rows], Tensor],
    size: Callable[[Tensor], Tensor],
) -> dict[str, Tensor]:
    """Average `size` of the gradients of `value` over some images, by parameter name."""
    generator = torch.Generator().manual_seed(buffer.scene)
    parameters = dict(head.named_parameters())
    total = {name: torch.zeros_like(p) for name, p in parameters.items()}
    view = buffer.tensors["view"].cpu()
    drawn = torch.randperm(buffer.views, generator=generator, device="cpu")[:images]
    for number in drawn.tolist():
        index = torch.nonzero(view == number)[:, 0]
        some = torch.randint(len(index), (IMAGE_ROWS,), generator=generator, device="cpu")
        gradients = torch.autograd.grad(
            value(buffer.rows(index[some])), list(parameters.values()), materialize_grads=True
        )
        for name, gradient in zip(parameters, gradients, strict=True):
            total[name] += size(gradient) / len(drawn)
    return total


def scaled_to_mean_one(importance: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Divide importances by their mean over all weights."""
    count = sum(value.numel() for value in importance.values())
    mean = sum(float(value.sum()) for value in importance.values()) / count
    return {name: value / max(mean, 1e-30) for name, value in importance.items()}


def _half(value: Tensor) -> Tensor:
    return value.clamp(max=torch.finfo(torch.half).max).half().cpu()
