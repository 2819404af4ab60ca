"""Refined poses and their covariance, against many drawn runs."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import exp1

from evercal.geometry.se3 import SE3, pose_distance
from evercal.localization.pose_refinement import RefinedPose, linearised, refine_pose

Array = NDArray[np.floating]
INTRINSICS = np.array([520.0, 500.0, 322.0, 238.0])
POSE = SE3.exp(np.array([0.4, -0.3, 1.2, 0.3, -0.5, 0.2]))
NEAR = POSE @ SE3.exp(np.array([0.03, -0.02, 0.04, 0.02, -0.02, 0.01]))


def points(count: int, seed: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    return POSE.apply(rng.uniform([-1, -0.8, 1.5], [1, 0.8, 4.0], (count, 3)))


def seen(where: Array, pose: SE3 = POSE) -> Array:
    local = pose.inverse().apply(where)
    return local[:, :2] / local[:, 2:] * INTRINSICS[:2] + INTRINSICS[2:]


def refined(pixels: Array, where: Array, white: Array, start: SE3 = NEAR) -> RefinedPose:
    return refine_pose(pixels, where, white, INTRINSICS, start)


def test_exact_pixels_give_the_exact_pose() -> None:
    where = points(30)
    found = refined(seen(where), where, np.tile(np.eye(2), (30, 1, 1)))
    metres, radians = pose_distance(found.base_from_camera, POSE)
    assert metres < 1e-8
    assert radians < 1e-8
    assert found.residual_px.max() < 1e-6


def test_a_third_of_wrong_pixels_does_no_harm() -> None:
    where, rng = points(120), np.random.default_rng(1)
    pixels = seen(where) + rng.normal(0, 0.2, (120, 2))
    white = np.tile(np.eye(2) / 0.2, (120, 1, 1))
    right = refined(pixels, where, white)
    pixels[:40] += rng.uniform(4, 12, (40, 2))  # all to one side
    found = refined(pixels, where, white)
    metres, radians = pose_distance(found.base_from_camera, right.base_from_camera)
    assert metres < 0.003
    assert radians < 0.002
    assert (found.residual_px[:40] > 3).all()
    assert np.median(found.residual_px[40:]) < 0.4


def test_the_covariance_is_that_of_many_runs() -> None:
    count, runs, rng = 60, 400, np.random.default_rng(2)
    where = points(count)
    # Errors that differ from point to point and are longer in one direction.
    root = rng.normal(0, 0.15, (count, 2, 2)) + 0.2 * np.eye(2)
    white = np.linalg.inv(root)
    drawn, claimed = [], []
    for _ in range(runs):
        noise = np.einsum("nij,nj->ni", root, rng.normal(size=(count, 2)))
        found = refined(seen(where) + noise, where, white)
        moved = (POSE.inverse() @ found.base_from_camera).log()[3:]
        shift = found.base_from_camera.translation_m - POSE.translation_m
        drawn.append(np.concatenate([shift, moved]))
        claimed.append(found.covariance)
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


def test_the_covariance_follows_the_data_and_not_the_claim() -> None:
    where, rng = points(200), np.random.default_rng(3)
    noise = rng.normal(0, 0.3, (200, 2))
    white = np.tile(np.eye(2) / 0.3, (200, 1, 1))
    right = refined(seen(where) + noise, where, white)
    boasting = refined(seen(where) + noise, where, 10 * white)
    np.testing.assert_allclose(boasting.covariance, right.covariance, rtol=0.05, atol=1e-12)


def test_translation_is_said_in_the_base_frame() -> None:
    # Points far ahead: the position is least certain along the optical axis.
    where, rng = points(100, 4), np.random.default_rng(4)
    white = np.tile(np.eye(2) / 0.3, (100, 1, 1))
    found = refined(seen(where) + rng.normal(0, 0.3, (100, 2)), where, white)
    spread = POSE.rotation_matrix().T @ found.covariance[:3, :3] @ POSE.rotation_matrix()
    other = POSE.rotation_matrix() @ found.covariance[:3, :3] @ POSE.rotation_matrix().T
    local = POSE.inverse().apply(where)
    information = np.zeros((6, 6))
    for x, y, z in local:
        ray = np.array([x / z, y / z])
        j = np.array([[-1 / z, 0, ray[0] / z], [0, -1 / z, ray[1] / z]])
        turn = np.array([[ray[0] * ray[1], -1 - ray[0] ** 2, ray[1]],
                         [1 + ray[1] ** 2, -ray[0] * ray[1], -ray[0]]])  # fmt: skip
        whole = INTRINSICS[:2, None] * np.concatenate([j, turn], 1)
        information += whole.T @ whole
    plain = np.linalg.inv(information)[:3, :3]
    alike = spread / np.trace(spread) - plain / np.trace(plain)
    assert np.abs(alike).max() < 0.1
    assert np.abs(other / np.trace(other) - plain / np.trace(plain)).max() > 0.1


def test_derivatives_are_finite_differences() -> None:
    where = points(10)
    turn, place = NEAR.rotation_matrix(), NEAR.translation_m
    pixels = seen(where)
    _, jacobian = linearised(pixels, where, turn, place, INTRINSICS)

    def residual(six: Array) -> Array:
        moved = NEAR @ SE3.exp(six)
        turned = moved.rotation_matrix()
        return linearised(pixels, where, turned, moved.translation_m, INTRINSICS)[0]

    for column in range(6):
        step = 1e-6 * np.eye(6)[column]
        slope = (residual(step) - residual(-step)) / 2e-6
        np.testing.assert_allclose(jacobian[:, column], slope, rtol=1e-4, atol=1e-3)
