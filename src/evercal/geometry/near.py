"""Which poses lie near others."""

import math

import numpy as np

from evercal.geometry.se3 import SE3, pose_distance
from evercal.typing import BoolArray

COARSE = (0.05, math.radians(5.0))
"""5 cm and 5 deg, the threshold of the indoor benchmarks, in metres and radians."""


def near_training(train_poses: SE3, test_poses: SE3) -> BoolArray:
    """Which test frames have a training frame nearer than 5 cm and 5 deg.

    Poses (n,) and (m,) give (m,) bool. The bounds are those of accuracy, so that the share of such
    frames is what the best lookup of a training frame could reach without any geometry.
    """
    near = np.zeros(len(test_poses), np.bool_)
    for i, pose in enumerate(test_poses):
        metres, radians = pose_distance(pose, train_poses)
        near[i] = ((metres < COARSE[0]) & (radians < COARSE[1])).any()
    return near
