"""Remembered scenes as constraints: no step may raise their losses.

The originals project the gradient and let plain SGD take the step. Here AdamW and Muon take it, and
their momentum, scales and decay could oppose the memory although the gradient does not; so what is
projected is the change of the weights after the optimisers, the step that is really taken. With
g_t the gradient of scene t's loss, a change u alters that loss by <g_t, u> to first order.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from evercal.continual.methods.method import FinishedScene, StageStart
from evercal.continual.methods.penalties import Reprojection
from evercal.continual.methods.replay import EpisodicMemory, MemoryHooks, by_scene
from evercal.continual.networks.buffer import Rows, diffused
from evercal.continual.networks.head import HeadOutput
from evercal.continual.networks.hooks import ProposedStep, TrainingHooks
from evercal.continual.networks.loss import fixed_clamp_loss

REFERENCE_ROWS = 8192


@dataclass(frozen=True)
class ConstrainedStep(EpisodicMemory):
    """What GEM, A-GEM and GEC share: losses of remembered scenes that are not minimised."""

    clamp_px: float = 50.0
    """Fixed soft clamp of remembered losses, pixels, so that losses of different times compare.
    It must be wide: beyond it a row that is forgotten has no gradient left."""

    def begin(self, start: StageStart) -> TrainingHooks:
        """Constrained steps; nothing for the first scene."""
        return ConstraintHooks(self, start) if start.memories else TrainingHooks()

    def edit(
        self, changes: Tensor, g: Tensor, proposed: ProposedStep, references: Tensor
    ) -> Tensor:
        """The change that is allowed.

        Args:
            changes: (p,) what the optimisers would change, all weights one after the other.
            g: (t, p) gradients of the losses that `constrained` gives.
            proposed: the step.
            references: (t,) the losses when the scenes were just learned; NaN where not kept.
        """
        raise NotImplementedError

    def constrained(self, losses: list[Tensor]) -> list[Tensor]:
        """The losses that may not rise, made of one loss for each remembered scene."""
        return losses

    def loss(self, output: HeadOutput, rows: Rows) -> Tensor:
        """Mean loss of remembered rows at the fixed clamp."""
        cost, _ = fixed_clamp_loss(output.points, rows.target, self.clamp_px)
        return cost.mean()


class ConstraintHooks(MemoryHooks):
    """Asks for the gradient of every remembered scene and lets the method edit the step."""

    edits_steps = True

    def __init__(self, method: ConstrainedStep, start: StageStart):
        super().__init__(start)
        self._rule = method
        unknown = torch.tensor(torch.nan, device="cpu")
        kept = [start.states[memory.scene].get("reference", unknown) for memory in self.memories]
        self._references = torch.stack(kept)

    def constraints(self, output: HeadOutput, rows: Rows) -> list[Tensor]:
        """The losses that may not rise."""
        parts = by_scene(output, rows, self.memories)
        return self._rule.constrained([self._rule.loss(o, r) for o, r in parts])

    def edit_step(self, proposed: ProposedStep) -> None:
        """Projects the step."""
        names = list(proposed.changes)
        g = torch.stack([_flat(constraint, names) for constraint in proposed.constraints])
        references = self._references.to(g)
        allowed = self._rule.edit(_flat(proposed.changes, names), g, proposed, references)
        start = 0
        for name in names:
            like = proposed.changes[name]
            proposed.changes[name] = allowed[start : start + like.numel()].view_as(like)
            start += like.numel()


@dataclass(frozen=True)
class AveragedGem(ConstrainedStep):
    """A-GEM: the step may not raise the mean of the remembered losses."""

    citation: ClassVar[str] = "Chaudhry et al., Efficient lifelong learning with A-GEM, ICLR 2019"

    def constrained(self, losses: list[Tensor]) -> list[Tensor]:
        """The mean alone."""
        return [torch.stack(losses).mean()]

    def edit(
        self, changes: Tensor, g: Tensor, proposed: ProposedStep, references: Tensor
    ) -> Tensor:
        """Takes out of the change what raises the mean loss."""
        return nearest_change(changes, g, g.new_zeros(1))


@dataclass(frozen=True)
class Gem(ConstrainedStep):
    """GEM: the step may not raise the loss of any remembered scene.

    The original keeps the dual variables above a margin, in units of SGD's gradient. Here a step
    goes down every remembered loss by at least that share of its own length, whether or not it was
    about to raise one: a constraint holds to first order, and without a margin what the step does
    to second order adds up.
    """

    citation: ClassVar[str] = "Lopez-Paz and Ranzato, Gradient episodic memory, NeurIPS 2017"
    margin: float = 1.0
    """Least length that is added against every gradient g_t, as a share of the step's."""

    def edit(
        self, changes: Tensor, g: Tensor, proposed: ProposedStep, references: Tensor
    ) -> Tensor:
        """The nearest change with <g_t, u> <= 0 for every scene, beyond the margin."""
        pushed = changes - self.margin * changes.norm() * F.normalize(g, dim=1).sum(0)
        return nearest_change(pushed, g, g.new_zeros(len(g)))


@dataclass(frozen=True)
class EpisodicConstraint(ConstrainedStep):
    """GEC, several constraints, with the references of its appendix.

    With h_t = loss_t - (1 + slack) reference_t, the original asks <v, g_t> >= alpha h_t of a
    gradient v and steps by -eta v; so a step u has <g_t, u> <= -alpha eta h_t. A remembered scene
    whose loss has risen by over 5 % since it was learned must get better by that share of what it
    lost, others may get worse by so much. Both sides are changes of a loss, so nothing has to be
    normalised. The first steps are plain replay. The original's look-ahead step before each g_t is
    left out: with one network trained at a rate that changes all the time it has no natural size.
    """

    citation: ClassVar[str] = "Lai et al., GEC, NeurIPS 2025, several constraints"
    alpha: float = 512.0
    """Share of h_t that a step of unit length makes up for (no unit)."""
    eta: float = 0.03
    """The original's learning rate; here it is only the length that alpha is meant for."""
    slack: float = 0.05
    """Share by which a remembered loss may rise."""
    longest: float = 1.0
    """What is added to a step is at most so long as the step itself. A scene whose rows all lie
    beyond the clamp has lost much and has a short gradient: unbounded, it asks for a step that
    destroys the network."""
    warm_steps: int = 5
    """Steps of plain replay at the start of a stage."""
    moving: bool = False
    """Compare with the losses of the step before, as the original's Algorithm 1 does; then no step
    may raise a loss by over 5 %, and nothing stops many small ones."""

    def begin(self, start: StageStart) -> TrainingHooks:
        """Constrained steps after the warm-up."""
        return _EpisodicHooks(self, start) if start.memories else TrainingHooks()

    def edit(
        self, changes: Tensor, g: Tensor, proposed: ProposedStep, references: Tensor
    ) -> Tensor:
        """The nearest change with <g_t, u> <= -alpha eta h_t for every scene."""
        if proposed.step < self.warm_steps:
            return changes
        h = proposed.losses - (1 + self.slack) * references
        # Warmed up and annealed like every other step: at the end nothing moves any more.
        most = -self.alpha * self.eta * proposed.schedule * h
        known = torch.isfinite(h)
        added = nearest_change(changes, g[known], most[known]) - changes
        limit = self.longest * changes.norm() / added.norm().clamp(min=1e-12)
        return changes + limit.clamp(max=1.0) * added

    def after_scene(self, scene: FinishedScene) -> dict[str, Tensor]:
        """`reference`: the loss on remembered rows as they are replayed."""
        buffer = scene.remembered()
        rows = buffer.draw(REFERENCE_ROWS, torch.Generator().manual_seed(scene.number))
        if scene.diffusion:
            noise = torch.Generator(rows.features.device).manual_seed(scene.number)
            rows = diffused(rows, scene.diffusion, noise)
        with torch.no_grad():
            output = scene.output(rows)
            return {"reference": self.loss(output, rows).cpu()}


class _EpisodicHooks(ConstraintHooks):
    def __init__(self, method: EpisodicConstraint, start: StageStart):
        super().__init__(method, start)
        self._steps, self._warm, self._moving = 0, method.warm_steps, method.moving
        if method.moving:
            self._references = torch.full_like(self._references, torch.nan)

    def cost(self, output: HeadOutput, rows: Rows, tau_px: float) -> Tensor | None:
        """Plain replay during the first steps, averaged over the scenes."""
        if self._steps >= self._warm:
            return None
        return Reprojection()(output, None, rows, tau_px)

    def edit_step(self, proposed: ProposedStep) -> None:
        super().edit_step(proposed)
        self._steps = proposed.step + 1
        if self._moving:
            self._references = proposed.losses

    def state(self) -> dict[str, Tensor]:
        return {"steps": torch.tensor(self._steps, device="cpu"), "references": self._references}

    def load(self, state: Mapping[str, Tensor]) -> None:
        self._steps, self._references = int(state["steps"]), state["references"]


def nearest_change(changes: Tensor, g: Tensor, most: Tensor) -> Tensor:
    """The change u nearest to a given one with <g_t, u> <= most_t for every t.

    u = changes - sum_t lambda_t g_t with lambda >= 0. The dual, min 1/2 l'Gl - l'b with G = g g'
    and b = g changes - most, is a least-squares problem in the root of G. Every constraint is
    first divided by the length of its gradient, which changes nothing about what it allows.

    Args:
        changes: (p,).
        g: (t, p).
        most: (t,) allowed increase of each loss.
    """
    if not len(g):
        return changes
    size = g.norm(dim=1)
    some = size > 0  # what no change can alter asks for none
    g, most = g[some] / size[some, None], most.to(g)[some] / size[some]
    over = (g @ changes - most).double().cpu().numpy()
    if (over <= 0).all():
        return changes
    from scipy.optimize import nnls

    gram = (g @ g.T).double().cpu().numpy()
    values, vectors = np.linalg.eigh(gram)
    # Parallel constraints make G singular; this little keeps their answer finite.
    root = np.sqrt(np.maximum(values, 0) + 1e-9 * max(values.max(), 1e-12))
    weights, _ = nnls((vectors * root).T, (vectors / root).T @ over)
    return changes - torch.from_numpy(weights).to(g) @ g


def _flat(named: Mapping[str, Tensor], names: Sequence[str]) -> Tensor:
    """(p,) all tensors in the order of the names."""
    return torch.cat([named[name].flatten() for name in names])
