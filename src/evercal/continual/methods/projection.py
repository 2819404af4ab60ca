"""Gradient projection memory: steps stay out of the subspaces that earlier scenes use."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from evercal.continual.methods.method import FinishedScene, Method, StageStart
from evercal.continual.methods.preconditioning import input_moments
from evercal.networks.hooks import ProposedStep, TrainingHooks


@dataclass(frozen=True)
class GradientProjectionMemory(Method):
    """GPM: a change of a matrix is freed of the directions in which earlier inputs vary.

    Of a finished scene the main directions of every layer's inputs are kept, so many that they hold
    the given share of what is left of the inputs outside the directions kept before. Later changes
    are projected off them; the original projects the gradient and steps with SGD. What an earlier
    scene owns alone (its code, logits and offsets) does not move.
    """

    citation: ClassVar[str] = "Saha et al., Gradient projection memory, ICLR 2021"
    kept_share: float = 0.97
    """Share of the squared inputs that the kept directions hold."""

    def begin(self, start: StageStart) -> TrainingHooks:
        """Projected steps; nothing for the first scene."""
        return _ProjectedSteps(start) if start.states else TrainingHooks()

    def after_scene(self, scene: FinishedScene) -> dict[str, Tensor]:
        """`basis.NAME` (inputs, k) of every matrix, half precision: orthonormal columns."""
        before = scene.earlier[-1] if scene.earlier else {}
        moments = input_moments(scene.head, [scene.rows()], scene.number)
        found = {}
        for name, moment in moments.items():
            old = before.get(f"basis.{name}", torch.zeros(len(moment), 0)).to(moment)
            found[f"basis.{name}"] = grown_basis(old, moment, self.kept_share).half().cpu()
        return found


class _ProjectedSteps(TrainingHooks):
    edits_steps = True

    def __init__(self, start: StageStart):
        named = dict(start.head.named_parameters())
        self._bases = {
            name.removeprefix("basis."): basis.to(named[name.removeprefix("basis.")])
            for name, basis in start.states[-1].items()
        }
        self._earlier = len(start.states)
        scene = start.head.centre_scene
        self._own = torch.nonzero(scene < self._earlier)[:, 0] if len(scene) else scene
        self._per_centre = start.head.options.offsets == "per_centre"

    def edit_step(self, proposed: ProposedStep) -> None:
        proposed.changes["code"][: self._earlier] = 0.0
        if self._per_centre:
            for name in ("logit", "logit_bias", "offset", "offset_bias"):
                proposed.changes[name][self._own] = 0.0
        for name, basis in self._bases.items():
            change = proposed.changes[name]
            proposed.changes[name] = change - (change @ basis) @ basis.T


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
