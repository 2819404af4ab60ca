"""Poses near training poses."""

import math

from evercal.geometry import SE3
from evercal.geometry.near import near_training

DEGREE = math.radians(1.0)


def test_one_frame_must_be_near_in_metres_and_degrees() -> None:
    here = SE3.identity()
    turned = SE3.exp([0, 0, 0, 0, 0, 6 * DEGREE])
    moved = SE3.exp([0.06, 0, 0, 0, 0, 0])
    both = SE3.exp([0.04, 0, 0, 0, 0, 4 * DEGREE])
    test = SE3.stack([here])
    assert not near_training(SE3.stack([turned, moved]), test)[0]
    assert near_training(SE3.stack([turned, moved, both]), test)[0]
    assert near_training(SE3.stack([]), test).tolist() == [False]
    assert near_training(SE3.stack([both]), SE3.stack([])).shape == (0,)
