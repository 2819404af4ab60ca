"""Gradient projection memory: steps are orthogonal to the inputs of earlier scenes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from evercal.continual.methods.method import FinishedScene, Method, MethodState, StageStart
from evercal.continual.methods.preconditioning import ROWS, input_moments
from evercal.continual.networks.buffer import FeatureBuffer
from evercal.continual.networks.head import Head
from evercal.continual.networks.hooks import ProposedStep, TrainingHooks

OUTPUTS = "outputs"
"""Name of the basis of the last hidden layer, the input of logits and offsets."""


@dataclass(frozen=True)
class GradientProjectionMemory(Method):
    """GPM: changes of a matrix are projected off the main input directions of earlier scenes.

    After each scene, the basis of every layer's inputs grows until it holds the given share of the
    squared inputs. Later changes are projected off the basis after the optimisers; the original
    projects the gradient and steps with SGD. Biases, which the original's networks lack, are fixed
    after the first scene. Code, logits and offsets owned by an earlier scene are fixed, too.
    Outputs that scenes share are projected like a layer.
    """

    citation: ClassVar[str] = "Saha et al., Gradient projection memory, ICLR 2021"
    kept_share: float = 0.9
    """Share of the squared inputs that the basis holds."""

    def begin(self, start: StageStart) -> TrainingHooks:
        """Project the steps, from the second scene on."""
        return _ProjectedSteps(start) if start.states else TrainingHooks()

    def after_scene(self, scene: FinishedScene) -> dict[str, Tensor]:
        """Return `basis.NAME` (inputs, k) of every matrix: orthonormal columns, half precision."""
        before = scene.earlier[-1] if scene.earlier else {}
        buffer = scene.rows()
        moments = input_moments(scene.head, [buffer], scene.number)
        moments[OUTPUTS] = _hidden_moment(scene.head, buffer)
        bases = {}
        for name, moment in moments.items():
            empty = moment.new_zeros(len(moment), 0)
            old = before.get(f"basis.{name}", empty).to(moment)
            bases[f"basis.{name}"] = grown_basis(old, moment, self.kept_share).half().cpu()
        return bases

    def needed(self, states: Sequence[MethodState]) -> Sequence[MethodState]:
        """Select the newest state, whose bases contain all earlier ones."""
        return states[-1:]


class _ProjectedSteps(TrainingHooks):
    edits_steps = True

    def __init__(self, start: StageStart):
        head = start.head
        # Columns stored in half precision are orthonormal to three digits only.
        bases: dict[str, Tensor] = {
            name.removeprefix("basis."): torch.linalg.qr(basis.to(head.logit)).Q
            for name, basis in start.states[-1].items()
        }
        outputs = bases.pop(OUTPUTS)
        shared = ["offset"] if head.options.offsets == "shared" else []
        if head.options.condition == "descriptor":
            shared = ["logit", "offset"]  # all scenes share all outputs
        self._bases: dict[str, Tensor] = bases | dict.fromkeys(shared, outputs)
        layers = [k.removesuffix("weight") + "bias" for k in bases]
        self._fixed = [*layers, *(f"{name}_bias" for name in shared)]
        earlier = len(start.states)
        own = torch.nonzero(head.centre_scene < earlier)[:, 0]
        self._fixed_rows = {"code": torch.arange(earlier, device=own.device)}
        for name in {"logit", "offset"} - set(shared):
            self._fixed_rows |= {name: own, f"{name}_bias": own}

    def edit_step(self, proposed: ProposedStep) -> None:
        changes = proposed.changes
        for name, where in self._fixed_rows.items():
            changes[name][where] = 0.0
        for name in self._fixed:
            changes[name].zero_()
        for name, basis in self._bases.items():
            changes[name] = changes[name] - (changes[name] @ basis) @ basis.T


@torch.no_grad()
def _hidden_moment(head: Head, buffer: FeatureBuffer) -> Tensor:
    """Compute the (width, width) second moment of the last hidden layer over a scene, double."""
    rows = buffer.draw(ROWS, torch.Generator().manual_seed(buffer.scene))
    hidden = head.hidden(rows.features.float(), rows.scene, rows.descriptor).double()
    return hidden.T @ hidden


def grown_basis(old: Tensor, moment: Tensor, share: float) -> Tensor:
    """Extend a basis by the fewest directions that reach a share of the squared inputs.

    Args:
        old: (n, j) orthonormal columns.
        moment: (n, n) second moment of a layer's inputs.
        share: Share of the trace of `moment` that the columns must hold (equation 9 of GPM).

    Returns:
        (n, k) orthonormal columns whose span contains the old ones.
    """
    total = moment.trace()
    held = torch.trace(old.T @ moment @ old) if old.shape[1] else total.new_zeros(())
    free = torch.eye(len(moment), dtype=moment.dtype, device=moment.device) - old @ old.T
    values, vectors = torch.linalg.eigh(free @ moment @ free)
    values, vectors = values.flip(0).clamp(min=0), vectors.flip(1)
    missing = share * total - held
    if missing <= 0:
        return old
    count = int((values.cumsum(0) < missing).sum()) + 1
    count = min(count, len(moment) - old.shape[1])
    return torch.linalg.qr(torch.cat([old, vectors[:, :count]], 1)).Q
