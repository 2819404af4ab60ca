"""Greedy designs against an exhaustive search, and how they treat duplicates."""

import itertools

import numpy as np
import pytest

from evercal.calibration.next_views import NextViewOptions, next_views
from evercal.calibration.view_information import HandEyeViews
from evercal.errors import InputError
from evercal.geometry import SE3

SCENE = np.array([0.5, 0.0, 0.0])


def poses(count: int, seed: int = 0) -> SE3:
    tangents = np.random.default_rng(seed).uniform(-0.6, 0.6, (count, 6))
    return SE3.exp(tangents * [0.4, 0.4, 0.4, 1, 1, 1])


@pytest.mark.parametrize("criterion", ["A", "D"])
def test_one_view_is_the_best_one_and_two_are_nearly_the_best_two(criterion: str) -> None:
    options = NextViewOptions(criterion=criterion, at_m=0.0)  # type: ignore[arg-type]
    used, reachable = poses(2, 1), poses(12)
    state = HandEyeViews.start(SE3.identity(), SCENE).with_views(used)

    def cost(index: tuple[int, ...]) -> float:
        covariance = state.with_views(reachable[list(index)]).estimate.covariance
        if criterion == "D":
            return float(np.linalg.slogdet(covariance)[1])
        return float(np.trace(covariance[:3, :3]))

    best = min(range(12), key=lambda i: cost((i,)))
    chosen = next_views(state, reachable, 2, used, options)
    assert chosen.index[0] == best
    pairs = sorted(map(cost, itertools.combinations(range(12), 2)))
    assert cost(tuple(chosen.index.tolist())) <= pairs[len(pairs) // 10]


def test_expected_deviations_are_those_after_the_views() -> None:
    state = HandEyeViews.start(SE3.identity(), SCENE).with_views(poses(3, 1))
    found = next_views(state, poses(20), 4)
    assert len(found.sigma_mm) == len(found.sigma_deg) == 5
    assert list(found.sigma_mm) == sorted(found.sigma_mm, reverse=True)
    after = state.with_views(found.poses).estimate
    assert found.sigma_mm[-1] == pytest.approx(after.sigma_mm)
    assert found.sigma_deg[0] == pytest.approx(state.estimate.sigma_deg)


def test_recorded_poses_and_their_twins_are_not_proposed() -> None:
    used = poses(4, 1)
    nudge = SE3.exp(np.array([0.003, 0, 0, 0, 0.01, 0]))
    reachable = SE3.stack([*used, *(used @ nudge), *poses(2)])
    state = HandEyeViews.start(SE3.identity(), SCENE).with_views(used)
    assert sorted(next_views(state, reachable, 10, used).index) == [8, 9]
    with pytest.raises(InputError, match="no reachable poses"):
        next_views(state, SE3.identity((0,)), 1)


def test_turning_is_proposed_before_shifting() -> None:
    """After views without rotation, a rotated view is worth more than any shifted one."""
    still = SE3.from_translation([(0.0, 0, 0), (0.1, 0, 0), (0, 0.1, 0)])
    shifted = SE3.from_translation(np.random.default_rng(0).uniform(-0.3, 0.3, (10, 3)))
    turned = SE3.exp(np.array([0.0, 0, 0, 0.5, 0, 0]))
    state = HandEyeViews.start(SE3.identity(), SCENE).with_views(still)
    assert next_views(state, SE3.stack([*shifted, turned]), 1).index.tolist() == [10]
