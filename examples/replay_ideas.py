"""Variants of SARS + SPDD for `evercal bench SUITE --plugin examples/replay_ideas.py`.

Each fills the memory and changes the loss of replayed rows. Their rows on held-out frames are in
research/network-trials.md; the best one is the strategy `sars_pixels`.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from evercal.continual.methods.penalties import Distillation, OldOutput, Penalty
from evercal.continual.methods.replay import Replay
from evercal.continual.methods.spdd import SpddOptions
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


POINTS_ALONE = Distillation(SpddOptions(prior_weight=0.0, metric_weight=0.0))
"""SPDD without its structural terms: old points alone."""
METHODS = {
    "filled_anchored": Replay("sars_filled", Anchored()),
    "filled_old_output": Replay("sars_filled", OldOutput()),
    "filled_points": Replay("sars_filled", POINTS_ALONE, weight=10.0),
    "deviation_spdd": Replay("sars_deviation", Distillation(), weight=10.0),
}
STRATEGIES = {
    name: Strategy(name, method, source="this project, beyond arXiv 2604.15814")
    for name, method in METHODS.items()
}
