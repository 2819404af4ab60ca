"""Errors of stated poses by all others: by brute force, without what each pose states."""

from __future__ import annotations

import numpy as np
import pytest

from evercal.mapping.variance_components import left_out
from evercal.robot.pose_errors import SharedErrors, SharedNoise

N = 5


def drawn(shared: bool) -> tuple[np.ndarray, np.ndarray, SharedNoise]:
    """Information (6 n, 6 n) of the images, the errors that fit them best, and the prior."""
    rng = np.random.default_rng(1)
    slopes = rng.normal(size=(6 * N, 9 * N))
    own = rng.normal(size=(N, 6, 8))
    kinds = {"bent": SharedErrors(rng.normal(size=(N, 6, 4)), 1.0)} if shared else {}
    noise = SharedNoise(own @ own.transpose(0, 2, 1), np.full(len(kinds), 0.7), kinds)
    return slopes @ slopes.T, rng.normal(size=6 * N), noise


@pytest.mark.parametrize("shared", [False, True])
def test_it_is_the_posterior_without_what_a_pose_states(shared: bool) -> None:
    information, best, noise = drawn(shared)
    prior = np.linalg.inv(noise.inverse())
    posterior = np.linalg.inv(information + noise.inverse())
    mean = posterior @ information @ best
    root = np.linalg.cholesky(posterior).T
    found = left_out(mean.reshape(N, 6), root.reshape(-1, N, 6), noise)
    errors, distance = found[:, :6], found[:, 6]
    for i in range(N):
        own = np.arange(6 * i, 6 * i + 6)
        others = np.setdiff1d(np.arange(6 * N), own)
        among = np.linalg.inv(prior[np.ix_(others, others)])
        without = information.copy()
        without[np.ix_(others, others)] += among
        covariance = np.linalg.inv(without)
        predicted = covariance @ information @ best
        # What the errors of the others say about this one beforehand.
        known = np.zeros((6, 6 * N))
        known[:, own] = np.eye(6)
        known[:, others] = -prior[np.ix_(own, others)] @ among
        expected = known @ predicted
        np.testing.assert_allclose(errors[i], expected, atol=1e-9)
        left = prior[np.ix_(own, own)] + known[:, others] @ prior[np.ix_(others, own)]
        total = left + known @ covariance @ known.T
        squared = expected @ np.linalg.solve(total, expected)
        assert distance[i] == pytest.approx(squared)
