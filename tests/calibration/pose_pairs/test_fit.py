"""Noise levels in textbook cases, and the covariance and influence of poses of a fit."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from benchmarks.hand_eye import Setting, recording
from evercal.calibration.pose_pairs.fit import (
    agreement,
    refine,
    robust_fit,
)
from evercal.calibration.pose_pairs.noise_levels import (
    Noise,
    estimate_levels,
    mean_levels,
    normal_matrix,
)
from evercal.calibration.pose_pairs.pose_equation import Extras, System
from evercal.calibration.pose_pairs.starts import consensus_start
from evercal.robot.pose_errors import ArmErrors, SharedErrors, shared_errors


def mean_of(n: int) -> np.ndarray:
    """Return the (n, 6, 6) derivatives of residuals by the mean of n vectors."""
    return np.broadcast_to(np.eye(6), (n, 6, 6))


def system(
    residual: np.ndarray,
    directions: dict[str, np.ndarray],
    known: float = 0.0,
    prior: float = 0.0,
    shared: dict[str, SharedErrors] | None = None,
) -> System:
    """Return the system of a mean of n residuals (n, 6)."""
    n = len(residual)
    information = prior * np.eye(6)
    return System(
        residual,
        mean_of(n),
        known * mean_of(n),
        directions,
        shared or {},
        information,
        np.zeros(6),
    )


def test_one_kind_equals_the_sample_variance() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(0, 0.003, (20, 6))
    levels = estimate_levels(system(values, {"all": mean_of(20)}))
    # Each mean takes one degree of freedom.
    assert levels[0] == pytest.approx(values.var(0, ddof=1).mean(), rel=2e-2)


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
    sigma = np.sqrt(levels)
    assert sigma[:2] == pytest.approx([2e-3, 5e-3], rel=0.15)
    assert sigma[2] < 8e-4


def test_known_noise_is_subtracted() -> None:
    values = np.random.default_rng(2).normal(0, 5e-3, (50, 6))  # total variance 25e-6
    measured = system(values, {"rest": mean_of(50)}, known=9e-6)
    levels = estimate_levels(measured)
    assert levels[0] == pytest.approx(16e-6, rel=0.3)
    total = Noise(measured, levels).independent
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

    rough = np.full(2, np.square(values[:, :3] - values[:, :3].mean(0)).mean())

    def loss(logarithms: np.ndarray) -> float:
        """Marginal likelihood, written down as one large Gaussian."""
        covariance = shared.copy()
        for i, block in enumerate(Noise(measured, np.exp(logarithms)).independent):
            covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] += block
        error = values.ravel()
        # One pseudo-residual of each kind is as large as the residuals.
        pseudo = logarithms + rough / np.exp(logarithms)
        return float(
            np.linalg.slogdet(covariance)[1]
            + error @ np.linalg.solve(covariance, error)
            + pseudo.sum()
        )

    best = minimize(loss, np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-4}).x
    assert np.log(estimate_levels(measured)) == pytest.approx(best, abs=0.03)


def test_errors_that_poses_share_are_told_from_independent_ones() -> None:
    rng = np.random.default_rng(4)
    n = 40
    effects = SharedErrors(rng.normal(size=(n, 6, 3)), 1.0)
    alone = rng.normal(0, 1e-3, (n, 6))
    both = alone + effects.slopes @ [4e-3, -5e-3, 3e-3]
    for values, most, least in ((alone, 5e-4, 0.0), (both, 1e-2, 2e-3)):
        measured = system(values, {"own": mean_of(n)}, shared={"all": effects})
        sigma = np.sqrt(estimate_levels(measured))
        assert sigma[0] == pytest.approx(1e-3, rel=0.3)
        assert least <= sigma[1] < most


def test_a_dense_covariance_is_inverted() -> None:
    rng = np.random.default_rng(5)
    effects = SharedErrors(rng.normal(size=(7, 6, 4)), 1.0)
    measured = system(
        rng.normal(size=(7, 6)), {"own": mean_of(7)}, shared={"all": effects}
    )
    noise = Noise(measured, np.array([0.5, 2.0]))
    flat = effects.slopes.reshape(42, 4)
    dense = 0.5 * np.eye(42) + 2.0 * flat @ flat.T
    right = rng.normal(size=(7, 6, 2))
    expected = np.linalg.solve(dense, right.reshape(42, 2))
    assert noise.weighted(right).reshape(42, 2) == pytest.approx(expected, rel=1e-6)
    assert noise.logarithm() == pytest.approx(np.linalg.slogdet(dense)[1], rel=1e-9)
    assert noise.blocks()[2] == pytest.approx(
        np.linalg.inv(dense)[12:18, 12:18], rel=1e-6
    )


def test_a_variance_that_few_residuals_do_not_exclude_is_not_zero() -> None:
    rng = np.random.default_rng(6)
    sizes = []
    for n in (4, 100):
        effects = SharedErrors(rng.normal(size=(n, 6, 1)), 1.0)
        measured = system(
            rng.normal(0, 1e-3, (n, 6)), {"own": mean_of(n)}, shared={"all": effects}
        )
        sizes.append(mean_levels(measured, np.array([1e-6, 1e-16]))[1])
    assert sizes[0] > 10 * sizes[1] > 0
    # Nothing is known without a residual but the prior.
    nothing = SharedErrors(np.zeros((4, 6, 1)), 0.01)
    measured = system(
        rng.normal(0, 1e-3, (4, 6)), {"own": mean_of(4)}, shared={"all": nothing}
    )
    assert mean_levels(measured, np.array([1e-6, 1e-16]))[1] == pytest.approx(1e-4)


def test_covariance_and_influence_match_their_definitions() -> None:
    pairs = recording(Setting(poses=14), 1).pairs
    extras = Extras.nothing(14).with_one("size", np.ones((14, 6)), 1e-3)
    kinds = shared_errors(pairs.base_from_gripper, ArmErrors())
    equation = replace(pairs.equation("eye_in_hand", extras), shared=kinds)
    fit = robust_fit(equation, agreement(equation, consensus_start(equation).at))
    assert fit.inliers.all()
    at = equation.system(fit.at)
    normal = normal_matrix(at, Noise(at, fit.levels).weighted(at.jacobian))
    assert fit.covariance == pytest.approx(np.linalg.inv(normal), rel=1e-6)
    # Kinds of noise and priors explain the covariance; the information adds up to one.
    assert sum(fit.contributions.values()) == pytest.approx(
        fit.covariance[:6, :6], rel=1e-5
    )
    assert fit.information.sum() == pytest.approx(1.0)
    without = np.arange(14) != 3
    left_out = refine(equation, fit.at, fit.levels, without)
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
