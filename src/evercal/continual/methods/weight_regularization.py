"""Weights are tied to where they were, each by how much it mattered: EWC, SI, MAS.

Importances are scaled to mean 1, so that one strength means the same for all of them. Rows of the
parameters that later scenes append are free.
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
"""Of each image whose gradient is taken."""
MEAN_ROWS = 8192
"""By which the mean of a scene's points is told."""


@dataclass(frozen=True)
class WeightRegularization(Method):
    """What the three share: cost = strength / 2 x mean over weights of sum_s I_s (w - w_s)^2."""

    strength: float = 1e6
    """What the mean squared change costs, weighted by importances of mean 1."""
    running: bool = False
    """Keep one running sum of importances and the newest weights, not one of each per scene."""
    decay: float = 0.9
    """Of the running sum with every scene."""
    images: int = 200
    """Drawn from the finished scene for its importances."""

    def begin(self, start: StageStart) -> TrainingHooks:
        """The cost of moving; nothing for the first scene."""
        return _TiedWeights(self, start)

    def after_scene(self, scene: FinishedScene) -> dict[str, Tensor]:
        """`anchor.NAME` and `importance.NAME` of every parameter, half precision."""
        found = scaled_to_mean_one(self.importance(scene))
        if self.running and scene.earlier:
            for name, value in found.items():
                old = scene.earlier[-1][f"importance.{name}"].to(value)
                value[: len(old)] += self.decay * old
        anchors = {f"anchor.{k}": _half(v.detach()) for k, v in scene.head.named_parameters()}
        return anchors | {f"importance.{k}": _half(v) for k, v in found.items()}

    def needed(self, states: Sequence[MethodState]) -> Sequence[MethodState]:
        """The newest alone where there is a running sum."""
        return states[-1:] if self.running else states

    def importance(self, scene: FinishedScene) -> dict[str, Tensor]:
        """How much every weight mattered for a finished scene, by parameter name."""
        raise NotImplementedError


class _TiedWeights(TrainingHooks):
    def __init__(self, method: WeightRegularization, start: StageStart):
        self.method, self._head = method, start.head
        self._ties = [_ties(state, start.head) for state in method.needed(start.states)]

    def regularizer(self) -> Tensor | None:
        if not self._ties:
            return None
        return self.method.strength * tie_cost(self._head, self._ties)


def tie_cost(head: Head, ties: Sequence[Mapping[str, tuple[Tensor, Tensor]]]) -> Tensor:
    """Half the mean over weights of sum_s I_s (w - w_s)^2.

    Args:
        head: as it is.
        ties: for each earlier scene, by parameter name: anchor and importance, for its first rows.
    """
    cost = torch.zeros((), device=head.centres.device)
    count = 0
    for name, value in head.named_parameters():
        count += value.numel()
        for tie in ties:
            anchor, importance = tie[name]
            cost = cost + (importance * (value[: len(anchor)] - anchor).square()).sum()
    return 0.5 / count * cost


def _ties(state: MethodState, head: Head) -> dict[str, tuple[Tensor, Tensor]]:
    return {
        name: (state[f"anchor.{name}"].to(value), state[f"importance.{name}"].to(value))
        for name, value in head.named_parameters()
    }


@dataclass(frozen=True)
class ElasticWeightConsolidation(WeightRegularization):
    """EWC: importance is the diagonal of the empirical Fisher information.

    At the clamp of the end (a Laplace-like likelihood): the mean over images of the squared
    gradient of an image's mean loss. `running` is the online form (Schwarz et al., ICML 2018).
    """

    citation: ClassVar[str] = "Kirkpatrick et al., PNAS 2017; online: Schwarz et al., ICML 2018"

    def importance(self, scene: FinishedScene) -> dict[str, Tensor]:
        """Mean squared gradients."""

        def loss(rows: Rows) -> Tensor:
            points = scene.output(rows).points
            return fixed_clamp_loss(points, rows.target)[0].mean()

        return mean_over_images(scene.head, scene.rows(), self.images, loss, torch.square)


@dataclass(frozen=True)
class MemoryAwareSynapses(WeightRegularization):
    """MAS: importance is how much the squared length of the output reacts to a weight.

    The output is the predicted point, from the mean of the points predicted for the scene: its
    length in the atlas would only tell where the scene lies.
    """

    citation: ClassVar[str] = "Aljundi et al., Memory aware synapses, ECCV 2018"
    running: bool = True
    decay: float = 1.0

    def importance(self, scene: FinishedScene) -> dict[str, Tensor]:
        """Mean absolute gradients."""
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
    """SI: importance is the share of the fall of the loss that a weight's path brought about.

    With every step the product of gradient and change is added up; in the end it is divided by the
    squared way from start to end. What the optimisers really changed is what counts.
    """

    citation: ClassVar[str] = "Zenke et al., Continual learning through SI, ICML 2017"
    first_scene_alike: ClassVar[bool] = False
    strength: float = 1e7
    running: bool = True
    decay: float = 1.0
    damping: float = 0.1
    """Added to the squared way, as a share of its mean."""

    def begin(self, start: StageStart) -> TrainingHooks:
        """Adds up the path, from the first scene on."""
        return _PathIntegral(self, start)

    def importance(self, scene: FinishedScene) -> dict[str, Tensor]:
        """Path integrals over squared ways."""
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
        """Adds gradient x change to the path; the step stays as it is.

        The gradient is that of the new rows alone: the part of the ties is taken off again.
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
        """max(path, 0) / (way^2 + damping x mean way^2), by parameter name."""
        ways = {k: (v.detach() - self._first[k]).square() for k, v in head.named_parameters()}
        mean = sum(float(w.sum()) for w in ways.values()) / sum(w.numel() for w in ways.values())
        floor = max(self._damping * mean, 1e-30)
        return {k: self._path[k].clamp(min=0) / (way + floor) for k, way in ways.items()}

    def state(self) -> dict[str, Tensor]:
        return {f"path.{k}": v for k, v in self._path.items()} | {
            f"first.{k}": v for k, v in self._first.items()
        }

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
    """By parameter name, the mean over images of the size of the gradient of a value."""
    generator = torch.Generator().manual_seed(buffer.scene)
    parameters = dict(head.named_parameters())
    total = {name: torch.zeros_like(p) for name, p in parameters.items()}
    view = buffer.tensors["view"].cpu()
    drawn = torch.randperm(buffer.views, generator=generator, device="cpu")[:images]
    for number in drawn.tolist():
        index = torch.nonzero(view == number)[:, 0]
        some = torch.randint(len(index), (IMAGE_ROWS,), generator=generator, device="cpu")
        found = torch.autograd.grad(
            value(buffer.rows(index[some])), list(parameters.values()), materialize_grads=True
        )
        for name, gradient in zip(parameters, found, strict=True):
            total[name] += size(gradient) / len(drawn)
    return total


def scaled_to_mean_one(importance: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The importances, divided by their mean over all weights."""
    count = sum(value.numel() for value in importance.values())
    mean = sum(float(value.sum()) for value in importance.values()) / count
    return {name: value / max(mean, 1e-30) for name, value in importance.items()}


def _half(value: Tensor) -> Tensor:
    return value.clamp(max=torch.finfo(torch.half).max).half().cpu()
