"""The gradients of a step, for rules that say how those of remembered scenes join the new one."""

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor


@dataclass
class Gradients:
    """What a rule may look at in a step."""

    new: Tensor
    """(p,) of the loss on new rows."""
    memory: Tensor
    """(t, p) of the loss on the rows of each remembered scene."""
    losses: Tensor
    """(t,) those losses."""
    references: Tensor
    """(t,) the same losses when the scene was just learned; NaN where it was not kept."""
    before: Tensor
    """(t,) the same losses in the step before; NaN in the first step."""
    step: int
    """Of the stage."""


Combine = Callable[[Gradients], Tensor]
"""Gradients of a step -> (p,) the one to go along."""
