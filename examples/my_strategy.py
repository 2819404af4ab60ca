"""A strategy of one's own for `evercal bench`.

    evercal bench sim-mini --plugin examples/my_strategy.py --strategies spread,er,finetune

It remembers the frames that are farthest from one another, which covers a scene better than random
ones, and replays them with their true poses and, half as strong, the old network's points.
"""

import numpy as np
from torch import Tensor

from evercal.continual.frame_statistics import FrameStatistics
from evercal.continual.methods.penalties import reprojection
from evercal.continual.strategies import Strategy
from evercal.mapping.selection import select_farthest
from evercal.networks.buffer import Rows
from evercal.networks.head import HeadOutput

PIXELS_PER_METRE = 25.0


def select(frames: FrameStatistics, capacity: int) -> np.ndarray:
    """Which frames stay: indices in recorded order, at most `capacity`."""
    return select_farthest(frames.positions_m, frames.quaternions_wxyz, capacity)


def penalty(student: HeadOutput, teacher: HeadOutput, rows: Rows, progress: float) -> Tensor:
    """What replayed rows cost, `progress` going from 0 to 1 over the stage."""
    drift = (student.points - teacher.points.detach()).abs().sum(-1).mean()
    return reprojection(student, teacher, rows, progress) + PIXELS_PER_METRE * drift


STRATEGIES = {
    "spread": Strategy(
        source="farthest-point sampling (Gonzalez, 1985) with truth and distillation",
        select=select,
        penalty=penalty,
    )
}
