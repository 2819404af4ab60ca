"""Variants of SARS + SPDD for `evercal bench SUITE --plugin examples/replay_ideas.py`.

`filled_anchored` fills the memory and keeps accurate old points. Its row on held-out frames is in
research/network-trials.md, beside that of the best idea, the strategy `sars_pixels`.
`deviation_spdd` is the paper's method with another unit of positions; it has no row.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from evercal.continual.methods.penalties import Distillation, Penalty
from evercal.continual.methods.replay import Replay
from evercal.continual.networks.buffer import Rows
from evercal.continual.networks.head import HeadOutput
from evercal.continual.networks.loss import fixed_clamp_loss
from evercal.continual.strategies import Strategy


@dataclass(frozen=True)
class Anchored(Penalty):
    """Reprojection loss, and distance to the teacher's points where these were accurate."""

    px_per_m: float = 50.0
    """Weight of the distance, pixels per metre."""
    teacher_limit_px: float = 10.0
    """Reprojection error below which the teacher's point is used."""

    def __call__(
        self, student: HeadOutput, teacher: HeadOutput, rows: Rows, tau_px: float
    ) -> Tensor:
        """Compute the loss in pixels."""
        cost, _ = fixed_clamp_loss(student.points, rows.target)
        _, error = fixed_clamp_loss(teacher.points, rows.target)
        distance = (student.points - teacher.points.detach()).abs().sum(-1)
        anchored = torch.where(error < self.teacher_limit_px, distance, 0.0)
        return cost.mean() + self.px_per_m * anchored.mean()


METHODS = {
    "filled_anchored": Replay("sars_filled", Anchored()),
    "deviation_spdd": Replay("sars_deviation", Distillation(), weight=10.0),
}
STRATEGIES = {name: Strategy(name, method) for name, method in METHODS.items()}
