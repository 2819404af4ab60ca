"""GEC: steps that may not raise the losses of remembered scenes.

The original projects the gradient, and plain SGD takes the step. AdamW and Shampoo can move against
the memory even if the gradient does not, because of their momentum, scales and decay. So the change
of the weights is projected after the optimisers. To first order, a change u alters the loss of
scene t by <g_t, u>, with g_t the gradient of that loss.
"""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Generator, Tensor

from evercal.classes import frozen
from evercal.continual.methods.method import FinishedScene, StageStart
from evercal.continual.methods.penalties import Reprojection
from evercal.continual.methods.replay import EpisodicMemory, MemoryHooks
from evercal.continual.networks.buffer import Rows, diffused
from evercal.continual.networks.head import HeadOutput
from evercal.continual.networks.hooks import ProposedStep, TrainingHooks
from evercal.continual.networks.loss import fixed_clamp_loss

REFERENCE_ROWS = 8192
"""Rows of the keyframes from which the loss after learning a scene is computed."""


@frozen
class EpisodicConstraint(EpisodicMemory):
    """GEC (Lai et al., NeurIPS 2025), several constraints and the references of its appendix.

    With h_t = loss_t - (1 + slack) reference_t, the original requires <v, g_t> >= alpha h_t of a
    gradient v and steps by -eta v. A step u therefore has <g_t, u> <= -alpha eta h_t. A scene whose
    loss exceeds its reference by more than the slack must improve, other scenes may get worse. Both
    sides are changes of a loss, so no normalisation is needed.

    The first steps are plain replay. The original's look-ahead step before each g_t is omitted: it
    has no natural size when the learning rate changes in every step.
    """

    weight_field = "alpha"
    clamp_px: float = 50.0
    """Fixed soft clamp of remembered losses, pixels. A fixed clamp makes losses of different steps
    comparable; a wide one leaves forgotten rows a gradient."""
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

    def hooks(self, start: StageStart) -> TrainingHooks:
        """Constrain the steps after the warm-up."""
        return _ConstraintHooks(self, start)

    def loss(self, output: HeadOutput, rows: Rows) -> Tensor:
        """Compute the mean loss of remembered rows with the fixed clamp."""
        cost, _ = fixed_clamp_loss(output.points, rows.target, self.clamp_px)
        return cost.mean()

    def edit_step(
        self, changes: Tensor, g: Tensor, proposed: ProposedStep, references: Tensor
    ) -> Tensor:
        """Return the nearest change with <g_t, u> <= -alpha eta h_t for every scene.

        The (t,) references are losses right after learning the scenes.
        """
        if proposed.step < self.warm_steps:
            return changes
        h = proposed.losses - (1 + self.slack) * references
        # The bound follows the learning rate, which ends at zero.
        bounds = -self.alpha * self.eta * proposed.schedule * h
        added = nearest_change(changes, g, bounds) - changes
        limit = self.longest * changes.norm() / added.norm().clamp(min=1e-12)
        return changes + limit.clamp(max=1.0) * added

    def after_scene(self, scene: FinishedScene) -> dict[str, Tensor]:
        """Return `reference`, the loss on remembered rows as they are replayed."""
        buffer = scene.remembered()
        rows = buffer.draw(REFERENCE_ROWS, Generator().manual_seed(scene.number))
        if scene.diffusion:
            noise = Generator(rows.features.device).manual_seed(scene.number)
            rows = diffused(rows, scene.diffusion, noise)
        with torch.no_grad():
            output = scene.output(rows)
            return {"reference": self.loss(output, rows).cpu()}


class _ConstraintHooks(MemoryHooks):
    edits_steps = True
    carried = ("_steps",)

    def __init__(self, method: EpisodicConstraint, start: StageStart):
        super().__init__(start)
        self._method = method
        self._steps = 0
        states = [start.states[memory.scene] for memory in self.memories]
        self._references = torch.stack([state["reference"] for state in states])

    def cost(self, output: HeadOutput, rows: Rows, tau_px: float) -> Tensor | None:
        if self._steps >= self._method.warm_steps:
            return None
        return Reprojection()(output, output, rows, tau_px)

    def constraints(self, output: HeadOutput, rows: Rows) -> list[Tensor]:
        count = len(rows.scene) // len(self.memories)  # rows are ordered by scene
        losses = []
        for start in range(0, count * len(self.memories), count):
            of_scene = slice(start, start + count)
            loss = self._method.loss(output.part(of_scene), rows.part(of_scene))
            losses.append(loss)
        return losses

    def edit_step(self, proposed: ProposedStep) -> None:
        changes = _flat(proposed.changes)
        g = torch.stack(list(map(_flat, proposed.constraints)))
        references = self._references.to(g)
        allowed = self._method.edit_step(changes, g, proposed, references)
        self._steps = proposed.step + 1
        start = 0
        for name, change in proposed.changes.items():
            end = start + change.numel()
            proposed.changes[name] = allowed[start:end].view_as(change)
            start = end


def nearest_change(changes: Tensor, g: Tensor, bounds: Tensor) -> Tensor:
    """Find the change u nearest to a given one with <g_t, u> <= b_t for every t.

    u = changes - sum_t lambda_t g_t with lambda >= 0. The dual, min 1/2 l'Gl - l'e with G = g g'
    and e = g changes - b, is a non-negative least-squares problem in the root of G. Constraints
    are first divided by the length of their gradient, which does not change the solution. The
    change is (p,), gradients (t, p), and bounds (t,).
    """
    lengths = g.norm(dim=1)
    nonzero = lengths > 0  # no change affects a loss without a gradient
    lengths = lengths[nonzero]
    unit = g[nonzero] / lengths[:, None]
    bounds = bounds.to(g)[nonzero] / lengths
    excess = (unit @ changes - bounds).double().cpu().numpy()
    if (excess <= 0).all():
        return changes
    from scipy.optimize import nnls

    gram = (unit @ unit.T).double().cpu().numpy()
    values, vectors = np.linalg.eigh(gram)
    # G is singular for parallel constraints; the offset keeps the solution finite.
    offset = 1e-9 * max(values.max(), 1e-12)
    root = np.sqrt(np.maximum(values, 0) + offset)
    weights, _ = nnls((vectors * root).T, (vectors / root).T @ excess)
    return changes - torch.from_numpy(weights).to(unit) @ unit


def _flat(named: Mapping[str, Tensor]) -> Tensor:
    return torch.cat([value.flatten() for value in named.values()])
