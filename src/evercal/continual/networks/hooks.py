"""What may be added to the training of a head: the trainer calls these hooks and knows no more."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from evercal.continual.networks.buffer import Rows
from evercal.continual.networks.head import HeadOutput


@dataclass
class ProposedStep:
    """What the optimisers made of one step, before it counts."""

    changes: dict[str, Tensor]
    """By parameter name, like the parameter: what the step adds to it. Hooks change these in
    place."""
    gradients: Mapping[str, Tensor]
    """By parameter name: gradient of all that was minimised."""
    losses: Tensor
    """(t,) the constraints' losses before the step."""
    constraints: Sequence[Mapping[str, Tensor]]
    """Their t gradients, each by parameter name."""
    step: int
    """Steps done before this one."""
    schedule: float
    """Learning rate of this step as a share of the peak, in [0, 1]."""


class TrainingHooks:
    """Adds nothing; a method overrides what it needs."""

    edits_steps = False
    """Whether `edit_step` has anything to do; looking at steps costs a copy of all weights."""

    def replayed(
        self, fresh: Rows, step: int, rate: float, generator: torch.Generator
    ) -> list[Rows]:
        """Rows that join a step beside those of the scene being learned.

        Args:
            fresh: rows of the scene being learned.
            step: steps done so far.
            rate: AdamW's learning rate.
            generator: of all that is drawn.

        Returns:
            Parts of equal size; the number of parts is the same in every step.
        """
        return []

    def cost(self, output: HeadOutput, rows: Rows, tau_px: float) -> Tensor | None:
        """What replayed rows cost.

        Args:
            output: of the head on them.
            rows: the parts of `replayed`, one after the other.
            tau_px: soft clamp of the loss on new rows in this step, pixels.
        """
        return None

    def constraints(self, output: HeadOutput, rows: Rows) -> list[Tensor]:
        """Losses on replayed rows that are not minimised but whose gradients `edit_step` needs."""
        return []

    def regularizer(self) -> Tensor | None:
        """What the weights themselves cost."""
        return None

    def edit_step(self, proposed: ProposedStep) -> None:
        """Changes a step after the optimisers, so that whatever they do is constrained."""

    def state(self) -> dict[str, Tensor]:
        """What `load` needs to go on after an interruption, as named tensors."""
        return {}

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Goes back to where `state()` was taken."""
