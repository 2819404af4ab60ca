"""Refined poses and their covariance, against many drawn runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import exp1

from evercal.geometry import SE3, Camera, pose_distance
from evercal.localization.pose_refinement import (
    Observed,
    RefinedPose,
    changed_camera,
    linearise,
    refine_pose,
)

Array = NDArray[np.floating]
CAMERA = Camera(640, 480, 520.0, 500.0, 322.0, 238.0)
POSE = SE3.exp(np.array([0.4, -0.3, 1.2, 0.3, -0.5, 0.2]))
NEAR = POSE @ SE3.exp(np.array([0.03, -0.02, 0.04, 0.02, -0.02, 0.01]))


def points(count: int, seed: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    return POSE.apply(rng.uniform([-1, -0.8, 1.5], [1, 0.8, 4.0], (count, 3)))


def project(points_m: Array) -> Array:
    return CAMERA.project(POSE.inverse().apply(points_m))


def refined(pixels: Array, points_m: Array, white: Array) -> RefinedPose:
    return refine_pose(Observed(pixels, points_m, white), CAMERA, NEAR)


def test_exact_pixels_give_the_exact_pose() -> None:
    points_m = points(30)
    result = refined(project(points_m), points_m, np.tile(np.eye(2), (30, 1, 1)))
    metres, radians = pose_distance(result.pose.pose, POSE)
    assert metres < 1e-8
    assert radians < 1e-8
    assert result.residual_px.max() < 1e-6


def test_a_third_of_outliers_does_not_bias_the_pose() -> None:
    points_m, rng = points(120), np.random.default_rng(1)
    pixels = project(points_m) + rng.normal(0, 0.2, (120, 2))
    white = np.tile(np.eye(2) / 0.2, (120, 1, 1))
    right = refined(pixels, points_m, white)
    pixels[:40] += rng.uniform(4, 12, (40, 2))  # all to one side
    result = refined(pixels, points_m, white)
    metres, radians = pose_distance(result.pose.pose, right.pose.pose)
    assert metres < 0.003
    assert radians < 0.002
    assert (result.residual_px[:40] > 3).all()
    assert np.median(result.residual_px[40:]) < 0.4


def test_covariance_matches_repeated_trials() -> None:
    count, runs, rng = 60, 400, np.random.default_rng(2)
    points_m = points(count)
    # Errors that differ from point to point and are longer in one direction.
    root = rng.normal(0, 0.15, (count, 2, 2)) + 0.2 * np.eye(2)
    white = np.linalg.inv(root)
    drawn, claimed = [], []
    for _ in range(runs):
        noise = np.einsum("nij,nj->ni", root, rng.normal(size=(count, 2)))
        result = refined(project(points_m) + noise, points_m, white)
        moved = (POSE.inverse() @ result.pose.pose).log()[3:]
        shift = result.pose.pose.translation_m - POSE.translation_m
        drawn.append(np.concatenate([shift, moved]))
        claimed.append(result.pose.covariance)
    true = np.cov(np.array(drawn).T)
    ratio = np.linalg.eigvals(np.linalg.solve(true, np.mean(claimed, 0))).real
    # For Gaussian errors of two axes Cauchy's weight w = 1 / (1 + s) has the mean a; the estimate
    # has (a - b) / 2 / b^2 times the variance of least squares, b = E w^2, and 1 / a is claimed.
    a = 0.5 * np.exp(0.5) * exp1(0.5)
    b = (1 - a) / 2
    expected = (1 / a) / ((a - b) / 2 / b**2)
    assert expected == pytest.approx(1.64, abs=0.01)  # on the safe side
    assert np.exp(np.log(ratio).mean()) == pytest.approx(expected, rel=0.15)
    assert ratio.min() > 0.7 * expected
    assert ratio.max() < 1.4 * expected


def test_covariance_follows_the_residuals() -> None:
    points_m, rng = points(200), np.random.default_rng(3)
    noise = rng.normal(0, 0.3, (200, 2))
    white = np.tile(np.eye(2) / 0.3, (200, 1, 1))
    right = refined(project(points_m) + noise, points_m, white)
    overconfident = refined(project(points_m) + noise, points_m, 10 * white)
    np.testing.assert_allclose(
        overconfident.pose.covariance, right.pose.covariance, rtol=0.05, atol=1e-12
    )


def matrix_and_position(pose: SE3) -> tuple[Array, Array]:
    return pose.rotation_matrix(), pose.translation_m


@pytest.mark.parametrize("lens", [(), (-0.2, 0.05, 0.001, -0.002, 0.01)])
def test_derivatives_equal_finite_differences(lens: tuple[float, ...]) -> None:
    camera, points_m = replace(CAMERA, distortion=lens), points(10)
    pixels = project(points_m)

    def residual(tangent: Array, change: Array) -> Array:
        moved = matrix_and_position(NEAR @ SE3.exp(tangent))
        return linearise(pixels, points_m, *moved, changed_camera(camera, change))[0]

    _, slope = linearise(pixels, points_m, *matrix_and_position(NEAR), camera, True)
    by_pose = linearise(pixels, points_m, *matrix_and_position(NEAR), camera)[1]
    np.testing.assert_allclose(by_pose, slope[:, :6], rtol=1e-12, atol=1e-9)
    for column in range(11):
        step = 1e-6 * np.eye(11)[column]
        ahead, behind = (residual(s[:6], s[6:]) for s in (step, -step))
        numeric = (ahead - behind) / 2e-6
        np.testing.assert_allclose(slope[:, column], numeric, rtol=1e-4, atol=1e-3)


def test_matches_without_a_common_pose_do_not_diverge() -> None:
    """Ten steps with free intrinsics lead nowhere, and not out of the world."""
    variances = np.array([2e-8, 5e-3, 5e-3, 6e-7, 6e-7])
    white = np.tile(np.eye(2) / 0.1, (28, 1, 1))
    for seed in range(40):
        rng = np.random.default_rng(seed)
        pixels, points_m = rng.uniform(0, [640, 480], (28, 2)), points(28, seed)
        result = refine_pose(Observed(pixels, points_m, white), CAMERA, POSE, 10, variances)
        assert pose_distance(result.pose.pose, POSE)[0] < 100
        assert np.isfinite(result.pose.covariance).all()
        assert 100 < result.camera.fx < 2000
