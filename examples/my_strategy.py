"""A custom method for `evercal bench`.

    evercal bench sim-mini --plugin examples/my_strategy.py --strategies spread,er,finetune

It remembers the frames farthest from each other, which cover a scene better than random frames. The
replay loss is reprojection to the known poses plus the distance to the old network's points.
"""

from dataclasses import dataclass

import numpy as np

from evercal.continual.methods.penalties import OldOutput
from evercal.continual.methods.replay import Replay
from evercal.continual.selection.frame_statistics import FrameStatistics
from evercal.continual.strategies import Strategy
from evercal.mapping.selection import select_farthest


@dataclass(frozen=True)
class Spread(Replay):
    """Farthest-point sampling (Gonzalez, 1985) with reprojection and distillation."""

    def select(self, frames: FrameStatistics, capacity: int) -> np.ndarray:
        """Select at most `capacity` frames; return sorted indices."""
        return select_farthest(frames.positions_m, frames.quaternions_wxyz, capacity)


STRATEGIES = {"spread": Strategy("spread", Spread(penalty=OldOutput(px_per_m=25.0)))}
