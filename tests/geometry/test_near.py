"""Poses near training poses, compared with a loop."""

import math

import numpy as np
import pytest

from evercal.geometry import SE3, pose_distance
from evercal.geometry.near import near_training

DEGREE = math.radians(1.0)


def test_near_training_agrees_with_a_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("evercal.geometry.near._PAIRS_AT_ONCE", 700)  # many blocks
    generator = np.random.default_rng(0)
    tangents = generator.uniform(-1, 1, (300, 6)) * [0.2, 0.1, 0.1, 0.1, 0.1, 0.1]
    train, test = SE3.exp(tangents[:200]), SE3.exp(tangents[200:])
    near = near_training(train, test)
    for pose, flag in zip(test, near, strict=True):
        metres, radians = pose_distance(pose, train)
        assert flag == ((metres < 0.05) & (radians < 5 * DEGREE)).any()
    assert 10 < near.sum() < 90  # the twin saw both answers


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
