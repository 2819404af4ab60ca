"""The law by which poses are accepted."""

from __future__ import annotations

import numpy as np
import pytest

from evercal.geometry import SE3, UncertainPose
from evercal.localization.acceptance import (
    CHANCE,
    FALSE_ACCEPTS,
    SAME_SURFACE,
    support,
)
from evercal.localization.hypothesis import Rough, accepted


def hypothesis(inliers: int, expected: int) -> Rough:
    points = np.zeros((inliers, 3))
    pose = UncertainPose(SE3.identity(), np.eye(6))
    return Rough(0, pose, points[:, :2], points, expected, inliers)


@pytest.mark.parametrize("expected", [42, 900])
def test_support_is_the_tail_of_the_beta_binomial_distribution(expected: int) -> None:
    rng = np.random.default_rng(0)
    drawn = rng.binomial(expected // SAME_SURFACE, rng.beta(*CHANCE, 400_000))
    for inliers in np.quantile(drawn, [0.5, 0.9, 0.99]).astype(int):
        tail = -np.log10((drawn >= inliers).mean())
        assert support(SAME_SURFACE * inliers, expected) == pytest.approx(
            tail, abs=0.02
        )


def test_more_inliers_have_more_support() -> None:
    values = [support(k, 900) for k in range(1, 901, 29)]
    assert (np.diff(values) > 0).all()
    assert values[-1] < np.inf
    # The same share of more landmarks is stronger.
    assert support(30, 100) < support(270, 900)


def test_the_rate_of_false_accepts_decides() -> None:
    least = next(k for k in range(1, 900) if accepted(hypothesis(k, 900)))
    assert 10 ** -support(least, 900) <= FALSE_ACCEPTS < 10 ** -support(least - 1, 900)


def test_pose_without_inliers_is_never_accepted() -> None:
    for rejected in (None, hypothesis(0, 0), hypothesis(0, 900)):
        assert not accepted(rejected)
