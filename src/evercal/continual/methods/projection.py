"""Gradient projection memory: steps stay out of the subspaces that earlier scenes use."""

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
"""Names the basis of the last hidden layer, from which logits and offsets are read."""


@dataclass(frozen=True)
class GradientProjectionMemory(Method):
    """GPM: a change of a matrix is freed of the directions in which earlier inputs vary.

    Of a finished scene the main directions of every layer's inputs are kept, so many that they and
    those kept before hold the given share of the squared inputs. Later changes are projected off
    them; the original projects the gradient and steps with SGD. Biases, which the original's
    networks lack, stay as the first scene left them. What an earlier scene owns alone (its code,
    logits and offsets) does not move; outputs that scenes share are projected like a layer.
    """

    citation: ClassVar[str] = "Saha et al., Gradient projection memory, ICLR 2021"
    kept_share: float = 0.9
    """Share of the squared inputs that the kept directions hold."""

    def begin(self, start: StageStart) -> TrainingHooks:
        """Projected steps; nothing for the first scene."""
        return _ProjectedSteps(start) if start.states else TrainingHooks()

    def after_scene(self, scene: FinishedScene) -> dict[str, Tensor]:
        """`basis.NAME` (inputs, k) of every matrix, half precision: orthonormal columns."""
        before = scene.earlier[-1] if scene.earlier else {}
        buffer = scene.rows()
        moments = input_moments(scene.head, [buffer], scene.number)
        moments[OUTPUTS] = hidden_moment(scene.head, buffer)
        found = {}
        for name, moment in moments.items():
            none = moment.new_zeros(len(moment), 0)
            old = before.get(f"basis.{name}", none).to(moment)
            found[f"basis.{name}"] = grown_basis(old, moment, self.kept_share).half().cpu()
        return found

    def needed(self, states: Sequence[MethodState]) -> Sequence[MethodState]:
        """The newest bases hold all earlier ones."""
        return states[-1:]


class _ProjectedSteps(TrainingHooks):
    edits_steps = True

    def __init__(self, start: StageStart):
        head = start.head
        found = {k.removeprefix("basis."): b for k, b in start.states[-1].items()}
        # Stored in half precision, columns are orthonormal to three digits only.
        bases: dict[str, Tensor] = {}
        for name, basis in found.items():
            bases[name] = torch.linalg.qr(basis.to(head.logit)).Q
        outputs = bases.pop(OUTPUTS)
        shared = _shared_outputs(head)
        self._bases: dict[str, Tensor] = bases | dict.fromkeys(shared, outputs)
        layers = [k.removesuffix("weight") + "bias" for k in bases]
        self._still = [*layers, *(f"{name}_bias" for name in shared)]
        earlier = len(start.states)
        own = torch.nonzero(head.centre_scene < earlier)[:, 0]
        self._held = {"code": torch.arange(earlier, device=own.device)}
        for name in {"logit", "offset"} - set(shared):
            self._held |= {name: own, f"{name}_bias": own}

    def edit_step(self, proposed: ProposedStep) -> None:
        changes = proposed.changes
        for name, where in self._held.items():
            changes[name][where] = 0.0
        for name in self._still:
            changes[name].zero_()
        for name, basis in self._bases.items():
            changes[name] = changes[name] - (changes[name] @ basis) @ basis.T


def _shared_outputs(head: Head) -> list[str]:
    """Which of the outputs every scene uses, by parameter name."""
    if head.options.condition == "descriptor":
        return ["logit", "offset"]
    return ["offset"] if head.options.offsets == "shared" else []


@torch.no_grad()
def hidden_moment(head: Head, buffer: FeatureBuffer) -> Tensor:
    """(width, width) second moment of the last hidden layer over a scene's rows, double."""
    rows = buffer.draw(ROWS, torch.Generator().manual_seed(buffer.scene))
    hidden = head.hidden(rows.features.float(), rows.scene, rows.descriptor).double()
    return hidden.T @ hidden


def grown_basis(old: Tensor, moment: Tensor, share: float) -> Tensor:
    """(n, k) orthonormal columns: the old ones and as many new ones as it takes.

    Args:
        old: (n, j) orthonormal columns.
        moment: (n, n) second moment of a layer's inputs.
        share: of the trace of `moment` that the columns together are to hold (equation 9 of the
            paper).
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
