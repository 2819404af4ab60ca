"""Hooks through which a continual-learning method takes part in the training of a head."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torch import Generator, Tensor

from evercal.continual.networks.buffer import Rows
from evercal.continual.networks.head import HeadOutput
from evercal.typing import Strings


@dataclass
class ProposedStep:
    """A step of the optimisers before it is applied."""

    changes: dict[str, Tensor]
    """By parameter name: the change of the parameter. Hooks edit these in place."""
    losses: Tensor
    """(t,) losses of `TrainingHooks.constraints` before the step."""
    constraints: Sequence[Mapping[str, Tensor]]
    """Gradients of these t losses, each by parameter name."""
    step: int
    """Number of earlier steps."""
    schedule: float
    """Learning rate as a share of the peak, in [0, 1]."""


class TrainingHooks:
    """No-op hooks that a method may override."""

    edits_steps = False
    """Whether `edit_step` is called. It costs a copy of all weights per step."""
    carried: Strings = ()
    """Attributes that later steps need from earlier ones: plain values and tensors."""

    def replayed(
        self, fresh: Rows, step: int, rate: float, generator: Generator
    ) -> list[Rows]:
        """Select remembered rows for a step: as many parts of equal size every time.

        `fresh` are rows of the scene being learned, and `rate` is that of AdamW.
        """
        return []

    def cost(self, output: HeadOutput, rows: Rows, tau_px: float) -> Tensor | None:
        """Compute a loss of the rows of `replayed`, or of the weights.

        `tau_px` is the soft clamp of new rows.
        """
        return None

    def constraints(self, output: HeadOutput, rows: Rows) -> list[Tensor]:
        """Return losses whose gradients `edit_step` needs; they are not minimised."""
        return []

    def edit_step(self, proposed: ProposedStep) -> None:
        """Edit a step after the optimisers, so that constraints hold for the applied step."""
