"""Replay, and weight updates that leave alone what remembered scenes use."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor, nn

from evercal.continual.methods.method import StageStart
from evercal.continual.methods.penalties import AnchoredReprojection, Penalty
from evercal.continual.methods.replay import Replay, ReplayHooks
from evercal.continual.networks.buffer import FeatureBuffer
from evercal.continual.networks.head import Head
from evercal.continual.networks.hooks import ProposedStep, TrainingHooks

ROWS = 8192
"""Of every remembered scene."""


@dataclass(frozen=True)
class PreconditionedReplay(Replay):
    """Anchored replay of SARS keyframes, and steps that spare what remembered scenes use."""

    citation: ClassVar[str] = "this project: anchored replay with preconditioned steps"
    selector: str = "sars_filled"
    penalty: Penalty = field(default_factory=AnchoredReprojection)
    weight: float = 0.5
    strength: float = 0.5
    """How strongly steps spare the directions that each remembered scene uses; 0 not at all."""

    def begin(self, start: StageStart) -> TrainingHooks:
        """Replay with preconditioned steps; nothing for the first scene."""
        return _PreconditionedHooks(self, start) if start.memories else TrainingHooks()


class _PreconditionedHooks(ReplayHooks):
    edits_steps = True

    def __init__(self, method: PreconditionedReplay, start: StageStart):
        super().__init__(method, start)
        self._held = held_rows(start.head, start.memories)
        seen = input_moments(start.head, start.memories, start.seed)
        self._damping = {
            name: torch.linalg.inv(
                torch.eye(len(moment), dtype=moment.dtype, device=moment.device)
                + method.strength * moment
            ).float()
            for name, moment in seen.items()
        }

    def edit_step(self, proposed: ProposedStep) -> None:
        """Damps changes of shared matrices, and undoes those of what a remembered scene owns.

        What belongs to one remembered scene alone (its code, logits and offsets) does not move:
        trained on a few frames, it would fit those and lose the others. The matrices are shared.
        Replay holds a scene where its few frames look; a matrix drifts in every other direction
        that the scene's images use, too. With C_s the second moment of a layer's inputs over
        replayed rows of scene s and c_s the mean of its diagonal, a change D of the matrix W
        becomes D (I + strength sum_s C_s / c_s)^-1: what W says about inputs of remembered scenes
        hardly moves, and directions that they leave free stay free for the new scene. The sum lets
        every scene count alike however many there are, as precisions add up in sequential Laplace
        approximations. A soft form of orthogonal weight modification (Zeng et al., Nature Machine
        Intelligence 2019) and gradient projection memory (Saha et al., ICLR 2021); nothing is
        stored for it, as C_s comes from the remembered frames.
        """
        for name, where in self._held.items():
            proposed.changes[name][where] = 0.0
        for name, damping in self._damping.items():
            proposed.changes[name] = proposed.changes[name] @ damping


def held_rows(head: Head, memories: Sequence[FeatureBuffer]) -> dict[str, Tensor]:
    """By parameter name, the rows that remembered scenes own; none where centres are shared."""
    if head.options.centres != "grow":
        return {}
    scenes = torch.tensor([memory.scene for memory in memories], device=head.centre_scene.device)
    held = {"code": scenes}
    if head.options.offsets == "per_centre":
        own = torch.nonzero(torch.isin(head.centre_scene, scenes))[:, 0]
        held |= dict.fromkeys(("logit", "logit_bias", "offset", "offset_bias"), own)
    return held


def input_moments(
    head: Head, memories: Sequence[FeatureBuffer], seed: int, rows: int = ROWS
) -> dict[str, Tensor]:
    """By weight name, the second moment of a layer's inputs, its mean diagonal 1 a scene; summed.

    Args:
        head: as it is before the stage.
        memories: rows of remembered scenes, one buffer each.
        seed: of the rows that are looked at.
        rows: of each scene.

    Returns:
        (inputs, inputs) double for every linear layer of the head.
    """
    names = {m: f"{name}.weight" for name, m in head.named_modules() if isinstance(m, nn.Linear)}
    used: dict[str, Tensor] = {}

    def look(layer: nn.Module, inputs: tuple[Tensor, ...], _: Tensor) -> None:
        assert isinstance(layer, nn.Linear)
        x = inputs[0].double()
        moment = x.T @ x
        scaled = moment / (moment.trace() / len(moment)).clamp(min=1e-12)
        name = names[layer]
        used[name] = used[name] + scaled if name in used else scaled

    handles = [layer.register_forward_hook(look) for layer in names]
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for memory in memories:
            drawn = memory.draw(rows, generator)
            head(drawn.features.float(), drawn.scene, drawn.descriptor)
    for handle in handles:
        handle.remove()
    return used
