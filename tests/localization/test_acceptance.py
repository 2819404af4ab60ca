"""The law by which poses are accepted."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import betabinom

from evercal.geometry import SE3, UncertainPose
from evercal.localization.acceptance import (
    CHANCE,
    FALSE_ACCEPTS,
    SAME_SURFACE,
    support,
)
from evercal.localization.answer import differ, widening
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
    assert FALSE_ACCEPTS == 1e-4
    assert 10 ** -support(least, 900) <= 1e-4 < 10 ** -support(least - 1, 900)


def test_pose_without_inliers_is_never_accepted() -> None:
    for rejected in (None, hypothesis(0, 0), hypothesis(0, 900)):
        assert not accepted(rejected)


def test_support_is_exact_where_few_landmarks_are_searched() -> None:
    """Beside the sum over the distribution of SciPy."""
    for inliers, expected in ((3, 6), (6, 6), (9, 30), (30, 30)):
        # Of three landmarks on a surface one counts; by chance one in nineteen matches.
        counts = np.arange(inliers // 3, expected // 3 + 1)
        tail = betabinom.pmf(counts, expected // 3, 17.2, 306.0).sum()
        assert support(inliers, expected) == pytest.approx(-np.log10(tail), rel=1e-9)
    # More inliers than landmarks that were searched are possible, and no error.
    assert support(4, 3) >= support(3, 3)
    # All is more likely than not: no support, and not less than none.
    assert support(1, 900) == pytest.approx(0, abs=1e-6)
    assert support(1, 900) >= 0


def test_few_inliers_widen_the_covariance() -> None:
    few = hypothesis(60, 200)
    assert 4 < few.support < 36
    assert widening(few) == pytest.approx(36 / few.support)
    assert widening(hypothesis(190, 200)) == 1


@pytest.mark.parametrize(
    ("sigma", "moved", "different"),
    [
        (1e-4, [0.011, 0, 0, 0, 0, 0], True),
        (1e-4, [0.009, 0, 0, 0, 0, 0], False),  # both are the same to a robot
        (1e-4, [0, 0, 0, 0, 0, np.deg2rad(1.1)], True),
        (1e-4, [0, 0, 0, 0, 0, np.deg2rad(0.9)], False),
        (0.01, [0.049, 0, 0, 0, 0, 0], False),  # within the uncertainty of the pose
        (0.01, [0.051, 0, 0, 0, 0, 0], True),
        (0.01, [0, 0, 0, 0, 0.051, 0], True),
    ],
)
def test_poses_differ_by_a_centimetre_or_a_degree_beyond_their_uncertainty(
    sigma: float, moved: list[float], different: bool
) -> None:
    points = np.zeros((190, 3))
    pose = UncertainPose(SE3.identity(), sigma**2 * np.eye(6))
    sure = Rough(0, pose, points[:, :2], points, 200, 190)
    assert differ(sure, SE3.exp(np.array(moved))) == different


def test_a_wide_pose_differs_from_fewer_others() -> None:
    points = np.zeros((60, 3))
    pose = UncertainPose(SE3.identity(), 1e-4 * np.eye(6))
    weak = Rough(0, pose, points[:, :2], points, 200, 60)
    bound = 0.05 * np.sqrt(widening(weak))
    assert bound > 0.06
    for factor, different in ((0.99, False), (1.01, True)):
        other = SE3.from_translation([factor * bound, 0, 0])
        assert differ(weak, other) == different
