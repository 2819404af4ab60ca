"""GEM, A-GEM and GEC: steps that may not raise the losses of remembered scenes.

The originals project the gradient, and plain SGD takes the step. AdamW and Shampoo can move against
the memory even if the gradient does not, because of their momentum, scales and decay. So the change
of the weights is projected after the optimisers. To first order, a change u alters the loss of
scene t by <g_t, u>, with g_t the gradient of that loss.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from evercal.continual.methods.method import FinishedScene, StageStart
from evercal.continual.methods.penalties import Reprojection
from evercal.continual.methods.replay import EpisodicMemory, MemoryHooks
from evercal.continual.networks.buffer import Rows, diffused
from evercal.continual.networks.head import HeadOutput
from evercal.continual.networks.hooks import ProposedStep, TrainingHooks
from evercal.continual.networks.loss import fixed_clamp_loss

REFERENCE_ROWS = 8192


@dataclass(frozen=True)
class ConstrainedStep(EpisodicMemory):
    """Base of methods that constrain the losses of remembered scenes."""

    clamp_px: float = 50.0
    """Fixed soft clamp of remembered losses, pixels. A fixed clamp makes losses of different steps
    comparable; a wide one leaves forgotten rows a gradient."""

    def begin(self, start: StageStart) -> TrainingHooks:
        """Constrain the steps, from the second scene on."""
        return ConstraintHooks(self, start) if start.memories else TrainingHooks()

    def constrained(self, losses: list[Tensor]) -> list[Tensor]:
        """Compute the constrained losses from the losses of the remembered scenes."""
        return losses

    def edit(self, changes: Tensor, g: Tensor) -> Tensor:
        """Find the nearest change (p,) that raises no loss, given the gradients (t, p)."""
        return nearest_change(changes, g, g.new_zeros(len(g)))

    def loss(self, output: HeadOutput, rows: Rows) -> Tensor:
        """Compute the mean loss of remembered rows with the fixed clamp."""
        cost, _ = fixed_clamp_loss(output.points, rows.target, self.clamp_px)
        return cost.mean()


class ConstraintHooks(MemoryHooks):
    """Collects the gradient of every remembered scene and applies the method's rule."""

    edits_steps = True

    def __init__(self, method: ConstrainedStep, start: StageStart):
        super().__init__(start)
        self._rule = method

    def constraints(self, output: HeadOutput, rows: Rows) -> list[Tensor]:
        """Compute the constrained losses."""
        each = len(rows.scene) // len(self.memories)  # rows are ordered by scene
        parts = [slice(i * each, (i + 1) * each) for i in range(len(self.memories))]
        losses = [self._rule.loss(output.part(part), rows.part(part)) for part in parts]
        return self._rule.constrained(losses)

    def edit_step(self, proposed: ProposedStep) -> None:
        """Project the step."""
        sizes = [change.numel() for change in proposed.changes.values()]
        g = torch.stack([_flat(constraint) for constraint in proposed.constraints])
        allowed = self.allowed(_flat(proposed.changes), g, proposed)
        for name, part in zip(proposed.changes, allowed.split(sizes), strict=True):
            proposed.changes[name] = part.view_as(proposed.changes[name])

    def allowed(self, changes: Tensor, g: Tensor, proposed: ProposedStep) -> Tensor:
        """Apply the method's rule to the change (p,)."""
        return self._rule.edit(changes, g)


@dataclass(frozen=True)
class AveragedGem(ConstrainedStep):
    """A-GEM: a step may not raise the mean of the remembered losses."""

    citation: ClassVar[str] = "Chaudhry et al., Efficient lifelong learning with A-GEM, ICLR 2019"

    def constrained(self, losses: list[Tensor]) -> list[Tensor]:
        """Return the mean loss."""
        return [torch.stack(losses).mean()]


@dataclass(frozen=True)
class Gem(ConstrainedStep):
    """GEM: a step may not raise the loss of any remembered scene.

    The original keeps the dual variables above a margin, in units of SGD's gradient. Here every
    step is first moved down each remembered loss by a share of its own length. A constraint holds
    to first order only, and without a margin second-order effects accumulate.
    """

    citation: ClassVar[str] = "Lopez-Paz and Ranzato, Gradient episodic memory, NeurIPS 2017"
    margin: float = 1.0
    """Length added against every gradient g_t, as a share of the step's length."""

    def edit(self, changes: Tensor, g: Tensor) -> Tensor:
        """Return the nearest change with <g_t, u> <= 0 for every scene, after the margin."""
        margin = self.margin * changes.norm() * F.normalize(g, dim=1).sum(0)
        return super().edit(changes - margin, g)


@dataclass(frozen=True)
class EpisodicConstraint(ConstrainedStep):
    """GEC with several constraints and the references of its appendix.

    With h_t = loss_t - (1 + slack) reference_t, the original requires <v, g_t> >= alpha h_t of a
    gradient v and steps by -eta v. A step u therefore has <g_t, u> <= -alpha eta h_t. A scene whose
    loss exceeds its reference by more than the slack must improve, other scenes may get worse. Both
    sides are changes of a loss, so no normalisation is needed.

    The first steps are plain replay. The original's look-ahead step before each g_t is omitted: it
    has no natural size when the learning rate changes in every step.
    """

    citation: ClassVar[str] = "Lai et al., GEC, NeurIPS 2025, several constraints"
    alpha: float = 512.0
    """Share of h_t that a step of unit length recovers (no unit)."""
    eta: float = 0.03
    """The original's learning rate; here it only scales alpha."""
    slack: float = 0.05
    """Share by which a remembered loss may rise."""
    longest: float = 1.0
    """Largest added length, as a share of the step's length. A forgotten scene has a large loss and
    a short gradient; without this limit the required step would destroy the network."""
    warm_steps: int = 5
    """Steps of plain replay at the start of a stage."""
    moving: bool = False
    """Compare with the losses of the previous step, as the original's Algorithm 1 does. Then no
    single step may raise a loss by more than the slack, but many small rises are allowed."""

    def begin(self, start: StageStart) -> TrainingHooks:
        """Constrain the steps after the warm-up, from the second scene on."""
        return _EpisodicHooks(self, start) if start.memories else TrainingHooks()

    def edit_step(
        self, changes: Tensor, g: Tensor, proposed: ProposedStep, references: Tensor
    ) -> Tensor:
        """Return the nearest change with <g_t, u> <= -alpha eta h_t for every scene.

        The (t,) references are losses right after learning the scenes; NaN if unknown.
        """
        if proposed.step < self.warm_steps:
            return changes
        h = proposed.losses - (1 + self.slack) * references
        # The bound follows the learning rate, which ends at zero.
        most = -self.alpha * self.eta * proposed.schedule * h
        finite = torch.isfinite(h)
        added = nearest_change(changes, g[finite], most[finite]) - changes
        limit = self.longest * changes.norm() / added.norm().clamp(min=1e-12)
        return changes + limit.clamp(max=1.0) * added

    def after_scene(self, scene: FinishedScene) -> dict[str, Tensor]:
        """Return `reference`, the loss on remembered rows as they are replayed."""
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
        self._method, self._steps = method, 0
        references = [start.states[memory.scene]["reference"] for memory in self.memories]
        self._references = torch.stack(references)
        if method.moving:
            self._references = torch.full_like(self._references, torch.nan)

    def cost(self, output: HeadOutput, rows: Rows, tau_px: float) -> Tensor | None:
        """Compute plain replay in the first steps, averaged over the scenes."""
        if self._steps >= self._method.warm_steps:
            return None
        return Reprojection()(output, None, rows, tau_px)

    def allowed(self, changes: Tensor, g: Tensor, proposed: ProposedStep) -> Tensor:
        change = self._method.edit_step(changes, g, proposed, self._references.to(g))
        self._steps = proposed.step + 1
        if self._method.moving:
            self._references = proposed.losses
        return change

    def state(self) -> dict[str, Tensor]:
        return {"steps": torch.tensor(self._steps, device="cpu"), "references": self._references}

    def load(self, state: Mapping[str, Tensor]) -> None:
        self._steps, self._references = int(state["steps"]), state["references"]


def nearest_change(changes: Tensor, g: Tensor, most: Tensor) -> Tensor:
    """Find the change u nearest to a given one with <g_t, u> <= most_t for every t.

    u = changes - sum_t lambda_t g_t with lambda >= 0. The dual, min 1/2 l'Gl - l'b with G = g g'
    and b = g changes - most, is a non-negative least-squares problem in the root of G. Constraints
    are first divided by the length of their gradient, which does not change the solution.

    Args:
        changes: (p,) change of all weights.
        g: (t, p) gradients.
        most: (t,) largest increase of each loss.
    """
    size = g.norm(dim=1)
    some = size > 0  # no change affects a loss without a gradient
    g, most = g[some] / size[some, None], most.to(g)[some] / size[some]
    over = (g @ changes - most).double().cpu().numpy()
    if (over <= 0).all():
        return changes
    from scipy.optimize import nnls

    gram = (g @ g.T).double().cpu().numpy()
    values, vectors = np.linalg.eigh(gram)
    # G is singular for parallel constraints; the offset keeps the solution finite.
    root = np.sqrt(np.maximum(values, 0) + 1e-9 * max(values.max(), 1e-12))
    weights, _ = nnls((vectors * root).T, (vectors / root).T @ over)
    return changes - torch.from_numpy(weights).to(g) @ g


def _flat(named: Mapping[str, Tensor]) -> Tensor:
    return torch.cat([value.flatten() for value in named.values()])
