"""Which poses lie near others."""

import math

import numpy as np
from numpy.typing import NDArray

from evercal.geometry.se3 import SE3, pose_distance

COARSE = (0.05, math.radians(5.0))
"""5 cm and 5 deg, the threshold of the indoor benchmarks, in metres and radians."""
_PAIRS_AT_ONCE = 1 << 19


def near_training(train_poses: SE3, test_poses: SE3) -> NDArray[np.bool_]:
    """Which test frames have a training frame nearer than 5 cm and 5 deg.

    The bounds are those of accuracy and as strict, so that the share of such frames is what the
    best lookup of a training frame could reach without any geometry. Poses (n,) and (m,) give (m,)
    bool.
    """
    near_m, near_rad = COARSE
    near = np.zeros(len(test_poses), dtype=np.bool_)
    rows = max(1, _PAIRS_AT_ONCE // max(1, len(train_poses)))
    for start in range(0, len(test_poses), rows):
        block = test_poses.translation_m[start : start + rows]
        offset = block[:, None] - train_poses.translation_m[None]
        squared = np.einsum("mnk,mnk->mn", offset, offset)
        # Few pairs are close in metres; only those are worth a rotation. The slack keeps rounding
        # out of the decision, which pose_distance alone makes.
        test, train = np.nonzero(squared < near_m**2 * (1 + 1e-9))
        metres, radians = pose_distance(test_poses[start + test], train_poses[train])
        near[start + test[(metres < near_m) & (radians < near_rad)]] = True
    return near
