"""Replay with steps that are damped along the inputs of remembered scenes."""

from collections.abc import Sequence
from dataclasses import field

import torch
from torch import Tensor, nn

from evercal.classes import frozen
from evercal.continual.methods.method import StageStart
from evercal.continual.methods.penalties import AnchoredReprojection, Penalty
from evercal.continual.methods.replay import Replay, ReplayHooks
from evercal.continual.networks.buffer import FeatureBuffer
from evercal.continual.networks.head import Head
from evercal.continual.networks.hooks import ProposedStep, TrainingHooks

ROWS = 8192
"""Rows of a scene from which second moments are estimated."""


@frozen
class PreconditionedReplay(Replay):
    """Anchored replay of SARS keyframes with preconditioned steps."""

    citation = "this project: anchored replay with preconditioned steps"
    selector: str = "sars_filled"
    penalty: Penalty = field(default_factory=AnchoredReprojection)
    weight: float = 0.5
    every_scene: bool = True
    strength: float = 0.5
    """Damping of a step along the inputs of each remembered scene; 0 disables it."""

    def hooks(self, start: StageStart) -> TrainingHooks:
        """Replay with preconditioned steps."""
        return _PreconditionedHooks(self, start)


class _PreconditionedHooks(ReplayHooks):
    edits_steps = True

    def __init__(self, method: PreconditionedReplay, start: StageStart):
        super().__init__(method, start)
        self._fixed = owned_rows(start.head, start.memories)
        self._damping: dict[str, Tensor] = {}
        moments = input_moments(start.head, start.memories, start.seed)
        for name, moment in moments.items():
            unit = torch.eye(len(moment), dtype=moment.dtype, device=moment.device)
            damping = torch.linalg.inv(unit + method.strength * moment)
            self._damping[name] = damping.float()

    def edit_step(self, proposed: ProposedStep) -> None:
        """Damp changes of shared matrices, and undo changes of rows owned by remembered scenes.

        The code, logits and offsets of a remembered scene are fixed, because training them on a few
        keyframes would overfit. The matrices are shared. Replay constrains a matrix only on the
        keyframes, and it may drift along other inputs of the scene.

        C_s is the second moment of a layer's inputs over replayed rows of scene s, and c_s the mean
        of its diagonal. A change D of the matrix becomes D (I + strength sum_s C_s / c_s)^-1.
        Outputs for inputs of remembered scenes then hardly change, while unused directions stay
        free for the new scene. Scenes have equal weight in the sum, like precisions in sequential
        Laplace approximations.

        This is a soft form of orthogonal weight modification (Zeng et al., Nature Machine
        Intelligence 2019) and gradient projection memory (Saha et al., ICLR 2021). Nothing is
        stored, because C_s is computed from the remembered frames.
        """
        changes = proposed.changes
        for name, rows in self._fixed.items():
            changes[name][rows] = 0.0
        for name, damping in self._damping.items():
            changes[name] = changes[name] @ damping


def owned_rows(head: Head, memories: Sequence[FeatureBuffer]) -> dict[str, Tensor]:
    """Return the rows owned by remembered scenes, by parameter name; empty for shared centres."""
    if head.options.centres != "grow":
        return {}
    numbers = [memory.scene for memory in memories]
    scenes = torch.tensor(numbers, device=head.centre_scene.device)
    owned = {"code": scenes}
    if head.options.offsets == "per_centre":
        centres = torch.nonzero(torch.isin(head.centre_scene, scenes))[:, 0]
        owned |= dict.fromkeys(head.owned_by_centres, centres)
    return owned


def input_moments(
    head: Head, memories: Sequence[FeatureBuffer], seed: int
) -> dict[str, Tensor]:
    """Sum second moments (inputs, inputs) of layers over scenes, by the name of the weight.

    The mean of the diagonal is 1 per scene; the moments are double.
    """
    moments = {}
    handles = []

    def observe(name: str, layer: nn.Module) -> None:
        def accumulate(_: nn.Module, inputs: tuple[Tensor], __: Tensor) -> None:
            x = inputs[0].double()
            moment = x.T @ x
            mean = moment.trace() / len(moment)
            scaled = moment / mean.clamp(min=1e-12)
            moments[name] = moments.get(name, 0) + scaled

        handles.append(layer.register_forward_hook(accumulate))

    for name, layer in head.named_modules():
        if isinstance(layer, nn.Linear):
            observe(f"{name}.weight", layer)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for memory in memories:
            drawn = memory.draw(ROWS, generator)
            head(drawn.features.float(), drawn.scene, drawn.descriptor)
    for handle in handles:
        handle.remove()
    return moments
