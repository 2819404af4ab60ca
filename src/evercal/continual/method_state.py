"""What methods keep of a finished scene beside its keyframes, and what follows from it.

A state is named tensors; it is stored with the scene and counts as memory.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from evercal.networks.buffer import FeatureBuffer
from evercal.networks.head import Head
from evercal.networks.loss import fixed_clamp_loss

MethodState = Mapping[str, Tensor]

REFERENCE_ROWS = 8192
FISHER_IMAGES = 200
FISHER_ROWS = 256
FISHER_DECAY = 0.9
EWC_STRENGTH = 100.0


@dataclass(frozen=True)
class FinishedScene:
    """A scene that was just learned."""

    head: Head
    """As it is now."""
    buffer: FeatureBuffer
    """Rows of the scene's training frames."""
    remembered: Callable[[], FeatureBuffer]
    """Rows of the frames that stay in memory, as they are."""
    earlier: Sequence[MethodState]
    """What was kept of earlier scenes."""


def after_scene_reference(scene: FinishedScene) -> dict[str, Tensor]:
    """`reference`: the loss on remembered rows, which later stages compare theirs with (GEC)."""
    buffer = scene.remembered()
    rows = buffer.draw(REFERENCE_ROWS, torch.Generator().manual_seed(buffer.scene))
    with torch.no_grad():
        points = scene.head(rows.features.float(), buffer.scene, rows.descriptor).points
        cost, _ = fixed_clamp_loss(points, rows.target)
    return {"reference": cost.mean()}


def after_scene_points(scene: FinishedScene) -> dict[str, Tensor]:
    """`points` (m, 3) half and `origin` (3,): what the head says now about remembered rows (DER).

    Half floats are fine enough near the origin, the mean of the points.
    """
    buffer = scene.remembered()
    rows = buffer.rows(torch.arange(len(buffer)))
    with torch.no_grad():
        points = scene.head(rows.features.float(), buffer.scene, rows.descriptor).points
    origin = points.mean(0)
    return {"points": (points - origin).half(), "origin": origin}


def after_scene_fisher(scene: FinishedScene) -> dict[str, Tensor]:
    """`anchor.NAME` and `fisher.NAME` of every parameter: where it stands, and how much it matters.

    The diagonal of the empirical Fisher matrix at the clamp of the end (a Laplace-like likelihood):
    the mean over images of the squared gradient of an image's mean loss, scaled to mean 1.
    """
    head, buffer = scene.head, scene.buffer
    generator = torch.Generator().manual_seed(buffer.scene)
    parameters = dict(head.named_parameters())
    total = {name: torch.zeros_like(value) for name, value in parameters.items()}
    view = buffer.tensors["view"]
    drawn = torch.randperm(buffer.views, generator=generator)[:FISHER_IMAGES]
    for number in drawn.tolist():
        index = torch.nonzero(view == number)[:, 0]
        some = index[torch.randint(len(index), (FISHER_ROWS,), generator=generator)]
        rows = buffer.rows(some)
        points = head(rows.features.float(), buffer.scene, rows.descriptor).points
        cost, _ = fixed_clamp_loss(points, rows.target)
        found = torch.autograd.grad(cost.mean(), list(parameters.values()), materialize_grads=True)
        for name, gradient in zip(parameters, found, strict=True):
            total[name] += gradient.square()
    count = sum(value.numel() for value in total.values())
    mean = sum(float(value.sum()) for value in total.values()) / count
    fisher = {name: value / max(mean, 1e-30) for name, value in total.items()}
    return _named(parameters, fisher)


def after_scene_fisher_online(scene: FinishedScene) -> dict[str, Tensor]:
    """The same as a running sum over scenes, with one anchor (Schwarz et al., ICML 2018)."""
    method_states = after_scene_fisher(scene)
    if not scene.earlier:
        return method_states
    before = scene.earlier[-1]
    for name in [name for name in method_states if name.startswith("fisher.")]:
        old = before[name].float()
        now = method_states[name].float()
        now[: len(old)] += FISHER_DECAY * old
        method_states[name] = _half(now)
    return method_states


def ewc_penalty(head: Head, method_states: Sequence[MethodState]) -> Tensor:
    """EWC (Kirkpatrick et al., PNAS 2017): strength / 2 times sum of F (theta - anchor)^2.

    Over the parameters that were there when a scene was finished; rows of later scenes are free.
    """
    cost = torch.zeros(())
    for name, value in head.named_parameters():
        for state in method_states:
            anchor, fisher = state[f"anchor.{name}"], state[f"fisher.{name}"]
            moved = value[: len(anchor)] - anchor.float()
            cost = cost + (fisher.float() * moved.square()).sum()
    return 0.5 * EWC_STRENGTH / _count(head) * cost


def ewc_online_penalty(head: Head, method_states: Sequence[MethodState]) -> Tensor:
    """The same with the newest notes alone, which hold the sum over scenes."""
    return ewc_penalty(head, method_states[-1:])


def _count(head: Head) -> int:
    return sum(value.numel() for value in head.parameters())


def _named(parameters: Mapping[str, Tensor], fisher: Mapping[str, Tensor]) -> dict[str, Tensor]:
    method_states = {f"anchor.{name}": _half(value.detach()) for name, value in parameters.items()}
    return method_states | {f"fisher.{name}": _half(value) for name, value in fisher.items()}


def _half(value: Tensor) -> Tensor:
    return value.clamp(max=torch.finfo(torch.half).max).half()
