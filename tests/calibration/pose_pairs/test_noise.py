"""Variance components in textbook cases."""

import numpy as np
import pytest
from scipy.stats import chi2, f

from evercal.calibration.pose_pairs.noise import (
    Gain,
    NoiseLevels,
    ellipsoid_factor,
    estimate_levels,
    working_noise,
)
from evercal.calibration.pose_pairs.pose_equation import System


def mean_of(n: int) -> np.ndarray:
    """Return the (n, 6, 6) derivatives of residuals by the mean of n vectors."""
    return np.broadcast_to(np.eye(6), (n, 6, 6))


def system(
    residual: np.ndarray, directions: dict[str, np.ndarray], known: np.ndarray | None = None
) -> System:
    """Return the system of a mean of n residuals (n, 6)."""
    n = len(residual)
    known = np.zeros((n, 6, 6)) if known is None else known
    return System(residual, mean_of(n), known, directions, n, ())


def test_one_kind_equals_the_sample_variance() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(0, 0.003, (20, 6))
    residual = values - values.mean(0)
    directions = {"all": mean_of(20)}
    levels = estimate_levels(system(residual, directions), ("all",))
    # Each mean takes one degree of freedom.
    assert levels.variance[0] == pytest.approx(values.var(0, ddof=1).mean(), rel=1e-3)
    # The relative deviation of a variance with nu degrees of freedom is sqrt(2 / nu).
    nu = 6 * 19
    assert np.sqrt(levels.uncertainty[0, 0]) == pytest.approx(
        levels.variance[0] * np.sqrt(2 / nu), rel=1e-2
    )


def test_kinds_are_separated_and_absent_kinds_are_zero() -> None:
    rng = np.random.default_rng(1)
    n = 50
    lever = rng.normal(size=(n, 6, 1))
    shift = np.broadcast_to(np.eye(6, 3), (n, 6, 3))
    rotation = np.broadcast_to(np.eye(6)[:, 3:], (n, 6, 3))
    values = 2e-3 * (shift @ rng.normal(size=(n, 3, 1)))[..., 0]
    values += 5e-3 * (rotation @ rng.normal(size=(n, 3, 1)))[..., 0]
    directions = {"shift": shift, "rotation": rotation, "lever": lever}
    residual = values - values.mean(0)
    levels = estimate_levels(system(residual, directions), tuple(directions))
    sigma = np.sqrt(levels.variance)
    assert sigma[0] == pytest.approx(2e-3, rel=0.15)
    assert sigma[1] == pytest.approx(5e-3, rel=0.15)
    assert sigma[2] < 5e-4


def test_known_noise_is_subtracted() -> None:
    rng = np.random.default_rng(2)
    n = 50
    known = np.broadcast_to(9e-6 * np.eye(6), (n, 6, 6))
    values = rng.normal(0, 5e-3, (n, 6))  # total variance 25e-6
    measured = system(values - values.mean(0), {"rest": mean_of(n)}, known)
    levels = estimate_levels(measured, ("rest",))
    assert levels.variance[0] == pytest.approx(16e-6, rel=0.3)
    total = levels.covariances(measured)
    assert np.trace(total[0]) / 6 == pytest.approx(values.var(0, ddof=1).mean(), rel=1e-2)


@pytest.mark.parametrize("freedom", [8.0, 30.0, 138.0])
def test_one_estimated_variance_gives_the_f_distribution(freedom: float) -> None:
    slope = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])[None]
    variance = 0.7
    uncertainty = np.array([[2 * variance**2 / freedom]])
    factor = ellipsoid_factor(variance * slope[0], slope, uncertainty)
    assert factor == pytest.approx(6 * f.ppf(0.95, 6, freedom) / chi2.ppf(0.95, 6), rel=1e-6)


def test_certain_levels_have_factor_one() -> None:
    assert ellipsoid_factor(np.eye(6), np.eye(6)[None], np.zeros((1, 1))) == pytest.approx(
        1.0, 1e-4
    )


def test_gain_is_weighted_least_squares() -> None:
    rng = np.random.default_rng(3)
    n, p = 7, 5
    jacobian = rng.normal(size=(n, 6, p))
    root = rng.normal(size=(n, 6, 6))
    noise = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(6)
    best = Gain.of(jacobian, noise, noise)
    stacked = np.concatenate(jacobian)
    weight = np.zeros((6 * n, 6 * n))
    for i in range(n):
        weight[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = np.linalg.inv(noise[i])
    assert best.covariance == pytest.approx(np.linalg.inv(stacked.T @ weight @ stacked), rel=1e-9)
    # Other weights give a larger covariance, which matches sampled noise.
    plain = Gain.of(jacobian, np.broadcast_to(np.eye(6), noise.shape), noise)
    draws = np.stack([r @ rng.normal(size=(6, 40000)) for r in np.linalg.cholesky(noise)])
    steps = np.einsum("npi,nid->pd", plain.gain, draws)
    assert np.cov(steps) == pytest.approx(
        plain.covariance, abs=0.05 * np.abs(plain.covariance).max()
    )
    assert np.trace(plain.covariance) > np.trace(best.covariance)


def test_working_noise_is_more_even() -> None:
    noise = np.stack([np.diag([1.0, 2, 3, 4, 5, 6]), np.diag([3.0, 2, 1, 6, 5, 4])])
    even = working_noise(noise, np.array([True, True]))
    assert np.trace(even.mean(0)) == pytest.approx(np.trace(noise.mean(0)))
    assert np.ptp(np.diag(even[0])[:3]) < np.ptp(np.diag(noise[0])[:3])


def test_zero_levels_give_a_positive_covariance() -> None:
    levels = NoiseLevels(("a",), np.zeros(1), np.zeros((1, 1)))
    covariance = levels.covariances(system(np.zeros((3, 6)), {"a": mean_of(3)}))
    assert (np.linalg.eigvalsh(covariance) > 0).all()
