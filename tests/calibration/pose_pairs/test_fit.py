"""Noise levels in textbook cases, and the covariance and influence of poses of a fit."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import chi2, f

from benchmarks.hand_eye import Setting, recording
from evercal.calibration.pose_pairs.fit import (
    agreement,
    ellipsoid_factor,
    estimate_levels,
    noise_of,
    refine,
    robust_fit,
)
from evercal.calibration.pose_pairs.pose_equation import Extras, System
from evercal.calibration.pose_pairs.starts import consensus_start


def mean_of(n: int) -> np.ndarray:
    """Return the (n, 6, 6) derivatives of residuals by the mean of n vectors."""
    return np.broadcast_to(np.eye(6), (n, 6, 6))


def system(
    residual: np.ndarray,
    directions: dict[str, np.ndarray],
    known: float = 0.0,
    prior: float = 0.0,
) -> System:
    """Return the system of a mean of n residuals (n, 6)."""
    n = len(residual)
    information = prior * np.eye(6)
    return System(
        residual, mean_of(n), known * mean_of(n), directions, information, np.zeros(6)
    )


def test_one_kind_equals_the_sample_variance() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(0, 0.003, (20, 6))
    levels = estimate_levels(system(values - 0.7, {"all": mean_of(20)}))
    # Each mean takes one degree of freedom.
    assert levels.variance[0] == pytest.approx(values.var(0, ddof=1).mean(), rel=3e-3)
    # The relative deviation of a variance with nu degrees of freedom is sqrt(2 / nu).
    assert np.sqrt(levels.uncertainty[0, 0]) == pytest.approx(
        levels.variance[0] * np.sqrt(2 / (6 * 19)), rel=3e-3
    )


def test_kinds_are_separated_and_absent_kinds_are_small() -> None:
    rng = np.random.default_rng(1)
    n = 50
    directions = {
        "shift": np.broadcast_to(np.eye(6, 3), (n, 6, 3)),
        "rotation": np.broadcast_to(np.eye(6)[:, 3:], (n, 6, 3)),
        "lever": rng.normal(size=(n, 6, 1)),
    }
    values = 2e-3 * (directions["shift"] @ rng.normal(size=(n, 3, 1)))[..., 0]
    values += 5e-3 * (directions["rotation"] @ rng.normal(size=(n, 3, 1)))[..., 0]
    levels = estimate_levels(system(values, directions))
    sigma = np.sqrt(levels.variance)
    assert sigma[:2] == pytest.approx([2e-3, 5e-3], rel=0.15)
    assert sigma[2] < 5e-4


def test_known_noise_is_subtracted() -> None:
    values = np.random.default_rng(2).normal(0, 5e-3, (50, 6))  # total variance 25e-6
    measured = system(values, {"rest": mean_of(50)}, known=9e-6)
    levels = estimate_levels(measured)
    assert levels.variance[0] == pytest.approx(16e-6, rel=0.3)
    total = noise_of(measured, levels.variance)
    assert np.trace(total[0]) / 6 == pytest.approx(
        values.var(0, ddof=1).mean(), rel=1e-2
    )


def test_levels_maximize_the_restricted_likelihood_with_a_prior() -> None:
    rng = np.random.default_rng(3)
    n = 12
    parts = {"a": mean_of(n), "b": rng.normal(size=(n, 6, 2))}
    values = (
        rng.normal(0, 0.5, (n, 6)) + (parts["b"] @ rng.normal(size=(n, 2, 1)))[..., 0]
    )
    measured = system(values, parts, prior=1.0)
    shared = np.tile(np.eye(6), (n, n))  # the prior of the mean, unit covariance

    def loss(logarithms: np.ndarray) -> float:
        """Marginal likelihood, written down as one large Gaussian."""
        covariance = shared.copy()
        for i, block in enumerate(noise_of(measured, np.exp(logarithms))):
            covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] += block
        error = values.ravel()
        return float(
            np.linalg.slogdet(covariance)[1]
            + error @ np.linalg.solve(covariance, error)
        )

    best = minimize(loss, np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-4}).x
    assert np.log(estimate_levels(measured).variance) == pytest.approx(best, abs=0.02)


@pytest.mark.parametrize("freedom", [8.0, 30.0, 138.0])
def test_one_estimated_variance_gives_the_f_distribution(freedom: float) -> None:
    slope = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])[None]
    uncertainty = np.array([[2 * 0.7**2 / freedom]])
    factor = ellipsoid_factor(0.7 * slope[0], slope, uncertainty)
    assert factor == pytest.approx(
        6 * f.ppf(0.95, 6, freedom) / chi2.ppf(0.95, 6), rel=1e-6
    )
    assert ellipsoid_factor(np.eye(6), slope, np.zeros((1, 1))) == pytest.approx(
        1.0, abs=1e-4
    )


def test_covariance_and_influence_match_their_definitions() -> None:
    pairs = recording(Setting(poses=14), 1).pairs
    extras = Extras.nothing(14).with_one("size", np.ones((14, 6)), 1e-3)
    equation = pairs.equation("eye_in_hand", extras)
    fit = robust_fit(equation, agreement(equation, consensus_start(equation).at))
    assert fit.inliers.all()
    at = equation.system(fit.at)
    normal = at.prior + sum(
        j.T @ np.linalg.solve(noise, j)
        for j, noise in zip(at.jacobian, fit.weights, strict=True)
    )
    assert fit.covariance == pytest.approx(np.linalg.inv(normal), rel=1e-6)
    # Kinds of noise and priors explain the covariance; the information adds up to one.
    assert sum(fit.contributions.values()) == pytest.approx(
        fit.covariance[:6, :6], rel=1e-5
    )
    assert 0.9 < fit.information.sum() < 1.0
    without = np.arange(14) != 3
    left_out = refine(equation, fit.at, fit.weights, without)
    moved = left_out.translations[0] - fit.at.translations[0]
    assert fit.moved[3, :3] == pytest.approx(
        moved, abs=0.02 * float(np.linalg.norm(moved))
    )


def test_one_outlier_is_rejected_by_its_distance() -> None:
    pairs = recording(Setting(poses=15), 2).pairs
    shifted = pairs.camera_from_board.translation_m.copy()
    shifted[4] += 0.02  # ten standard deviations
    moved = type(pairs.camera_from_board)(
        pairs.camera_from_board.rotation_wxyz, shifted
    )
    pairs = replace(pairs, camera_from_board=moved)
    equation = pairs.equation("eye_in_hand", Extras.nothing(15))
    fit = robust_fit(equation, agreement(equation, consensus_start(equation).at))
    assert np.flatnonzero(~fit.inliers).tolist() == [4]
    # Distances of accepted poses follow chi-square with nearly six degrees of freedom.
    assert 3 < fit.distance2[fit.inliers].mean() < 9
    assert fit.distance2[4] > 60
