"""Covariances of poses, against numpy and draws."""

import numpy as np
import pytest

from evercal.geometry import SE3, axis_deviation, cross_matrix, with_translation_by


def test_the_matrix_multiplies_like_the_cross_product() -> None:
    v, w = np.random.default_rng(0).normal(size=(2, 4, 5, 3))
    assert (cross_matrix(v) @ w[..., None])[..., 0] == pytest.approx(np.cross(v, w))


def test_deviations_are_root_mean_squares_per_axis() -> None:
    covariance = np.diag([1e-6, 4e-6, 4e-6, 0.0, 0.0, 3e-4])
    assert axis_deviation(covariance) == pytest.approx((3**0.5, np.rad2deg(0.01)))


def test_only_the_translation_is_multiplied() -> None:
    rng = np.random.default_rng(1)
    turn = SE3.exp([0, 0, 0, 0.3, -0.7, 1.1]).rotation_matrix()
    draws = rng.normal(size=(6, 6)) @ rng.normal(size=(6, 2000))
    moved = np.concatenate([turn @ draws[:3], draws[3:]])
    assert with_translation_by(turn, np.cov(draws)) == pytest.approx(np.cov(moved))
