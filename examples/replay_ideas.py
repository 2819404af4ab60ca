"""Losses of replayed rows beyond the paper's, for `evercal bench SUITE --plugin`.

Each strategy fills the memory with frames of SARS and has another loss. The rows are in
research/network-trials.md.
"""

from dataclasses import dataclass

from torch import Tensor

from evercal.continual.methods.penalties import (
    AnchoredReprojection,
    Penalty,
    Reprojection,
)
from evercal.continual.methods.replay import Replay
from evercal.continual.networks.buffer import Rows
from evercal.continual.networks.head import HeadOutput
from evercal.continual.networks.loss import surface_loss
from evercal.continual.strategies import Strategy


@dataclass(frozen=True)
class OldPixels(Penalty):
    """Reprojection, and the distance to the teacher's points in pixels at their depth.

    A metre counts as much as it is seen, unlike in SPDD and iCaRL.
    """

    share: float = 0.5
    """Part of the distance in the sum."""

    def __call__(
        self, student: HeadOutput, teacher: HeadOutput, rows: Rows, tau_px: float
    ) -> Tensor:
        """Compute the loss in pixels."""
        known = teacher.points.detach()
        distance = surface_loss(student.points, known, rows.target, tau_px).mean()
        reprojection = Reprojection()(student, teacher, rows, tau_px)
        return self.share * distance + (1 - self.share) * reprojection


def _named(name: str, method: Replay) -> Strategy:
    return Strategy(name, method, source="this project, beyond arXiv 2604.15814")


STRATEGIES = {
    strategy.name: strategy
    for strategy in (
        _named("filled_anchored", Replay("sars_filled", AnchoredReprojection())),
        _named("filled_pixels", Replay("sars_filled", OldPixels(), weight=3.0)),
        _named("filled_old_pixels", Replay("sars_filled", OldPixels(1.0), weight=3.0)),
    )
}
"""Names and strategies. `sars_spdd_filled` is their control."""
