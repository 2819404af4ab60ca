"""Poses from matches against the truth, and their covariance against repeated trials."""

import time

import numpy as np
import pytest

from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3, pose_distance
from evercal.localization.pnp import PnpOptions, solve_pnp, uncertain

CAMERA = Camera(320, 240, 262.5, 250.0, 159.5, 119.5)


def case(
    seed: int, count: int, depth: tuple[float, float] = (1.0, 4.0)
) -> tuple[SE3, np.ndarray, np.ndarray]:
    """A random pose, pixels (n, 2) and their points (n, 3) in the world."""
    rng = np.random.default_rng(seed)
    world_from_camera = SE3.exp(
        np.array([*rng.normal(0, 3, 3), *rng.normal(0, 1.5, 3)])
    )
    pixels = rng.uniform([0, 0], [319, 239], (count, 2))
    in_camera = CAMERA.unproject(pixels) * rng.uniform(*depth, (count, 1))
    return world_from_camera, pixels, world_from_camera.apply(in_camera)


@pytest.mark.parametrize("seed", range(4))
def test_exact_points_give_the_exact_pose(seed: int) -> None:
    truth, pixels, points = case(seed, 200)
    result = solve_pnp(pixels, points, CAMERA, PnpOptions())
    assert result is not None
    metres, radians = pose_distance(result.pose, truth)
    assert metres < 1e-6
    assert radians < 1e-6
    assert result.inliers.all()


@pytest.mark.parametrize("seed", range(4))
def test_half_of_the_points_are_outliers(seed: int) -> None:
    truth, pixels, points = case(seed, 400)
    rng = np.random.default_rng(seed)
    wrong = rng.permutation(400) < 200
    points[wrong] += rng.normal(0, 2, (200, 3))
    noisy = pixels + rng.normal(0, 0.5, pixels.shape)
    result = solve_pnp(noisy, points, CAMERA, PnpOptions())
    assert result is not None
    metres, radians = pose_distance(result.pose, truth)
    assert metres < 0.02
    assert radians < np.deg2rad(0.5)
    # Inliers are the matches that reproject within the threshold.
    camera_from_world = result.pose.inverse()
    with np.errstate(invalid="ignore"):
        error = np.linalg.norm(
            CAMERA.project(camera_from_world.apply(points)) - noisy, axis=1
        )
    assert (result.inliers == (np.nan_to_num(error, nan=np.inf) < 5.0)).mean() > 0.99
    assert result.inliers[~wrong].all()


@pytest.mark.parametrize("seed", range(4))
def test_few_right_matches_among_the_first_are_sampled(seed: int) -> None:
    truth, pixels, points = case(seed, 1200)
    rng = np.random.default_rng(seed)
    right = rng.choice(60, 30, replace=False)
    wrong = np.setdiff1d(np.arange(1200), right)
    points[wrong] = rng.normal(0, 2, (len(wrong), 3))
    far = []
    for ranked in (True, False):
        result = solve_pnp(
            pixels, points, CAMERA, PnpOptions(progressive_sampling=ranked)
        )
        far.append(np.inf if result is None else pose_distance(result.pose, truth)[0])
    assert far[0] < 0.1 < far[1]


def test_many_outliers_leave_the_pose_accurate() -> None:
    errors_m = []
    for seed in range(12):
        truth, pixels, points = case(seed, 300)
        rng = np.random.default_rng(seed)
        wrong = rng.random(300) < 0.7
        pixels[wrong] = rng.uniform([0, 0], [319, 239], (wrong.sum(), 2))
        noisy = pixels + rng.normal(0, 1.0, pixels.shape)
        result = solve_pnp(noisy, points, CAMERA, PnpOptions())
        assert result is not None
        errors_m.append(pose_distance(result.pose, truth)[0])
    # Without refinement the median is 8 mm.
    assert np.median(errors_m) < 0.005


@pytest.mark.parametrize("focal", [1.0, 1e4, 1e6, 1e9])
def test_any_focal_length_gives_a_pose_or_none(focal: float) -> None:
    camera = Camera(320, 240, focal, focal, 159.5, 119.5)
    rng = np.random.default_rng(0)
    for _ in range(40):
        pixels = rng.uniform([0, 0], [319, 239], (80, 2))
        points = rng.normal(0, 2, (80, 3))
        for cloud in (points, points[:1].repeat(80, 0), points + 1e7):
            result = solve_pnp(pixels, cloud, camera, PnpOptions())
            assert result is None or result.inlier_count >= 6


@pytest.mark.parametrize("count", [0, 3, 5])
def test_too_few_points_give_none(count: int) -> None:
    _, pixels, points = case(0, count)
    assert solve_pnp(pixels, points, CAMERA, PnpOptions()) is None


def test_too_few_inliers_give_none() -> None:
    _, pixels, points = case(1, 300)
    # Five matches are right, the others random.
    rng = np.random.default_rng(0)
    points[5:] = rng.normal(0, 0.01, (295, 3))  # within one pixel
    pixels[5:] = rng.uniform([-4000, -4000], [4000, 4000], (295, 2))
    assert solve_pnp(pixels, points, CAMERA, PnpOptions()) is None
    _, pixels, points = case(1, 6)
    assert solve_pnp(pixels, points, CAMERA, PnpOptions()) is not None


def test_random_matches_give_no_pose_in_time() -> None:
    rng = np.random.default_rng(0)
    times = []
    shares = []
    for _ in range(5):
        pixels = rng.uniform([0, 0], [319, 239], (1200, 2))
        points = rng.normal(0, 2, (1200, 3))
        began = time.thread_time()
        result = solve_pnp(pixels, points, CAMERA, PnpOptions())
        times.append(time.thread_time() - began)
        shares.append(0.0 if result is None else result.inliers.mean())
    assert min(times) < 0.1
    assert max(shares) < 0.05


def test_same_matches_give_the_same_bytes() -> None:
    _, pixels, points = case(4, 300)
    points[::2] += np.random.default_rng(0).normal(0, 1, (150, 3))
    a, b = (solve_pnp(pixels, points, CAMERA, PnpOptions()) for _ in range(2))
    assert a is not None
    assert b is not None
    assert a.pose.matrix().tobytes() == b.pose.matrix().tobytes()
    assert (a.inliers == b.inliers).all()


def moved(pose: SE3, shift: np.ndarray, rotation: np.ndarray) -> SE3:
    """The documented perturbation: t + shift in the world, R Exp(rotation) in the camera."""
    rotated = pose @ SE3.exp(np.array([0, 0, 0, *rotation]))
    return SE3(rotated.rotation_wxyz, pose.translation_m + shift)


def test_covariance_equals_least_squares_with_a_numeric_jacobian() -> None:
    truth, pixels, points = case(7, 50)
    noisy = pixels + np.random.default_rng(0).normal(0, 1, pixels.shape)

    def residual(tangent: np.ndarray) -> np.ndarray:
        pose = moved(truth, tangent[:3], tangent[3:])
        return (CAMERA.project(pose.inverse().apply(points)) - noisy).ravel()

    step = 1e-6
    jacobian = np.stack(
        [(residual(step * e) - residual(-step * e)) / (2 * step) for e in np.eye(6)], -1
    )
    expected = (residual(np.zeros(6)) ** 2).mean() * np.linalg.inv(
        jacobian.T @ jacobian
    )
    covariance = uncertain(noisy, points, CAMERA, truth).covariance
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(covariance / scale, expected / scale, atol=1e-4)


def test_covariance_matches_the_spread_of_many_solutions() -> None:
    # Looking along world x at a tall, nearly flat strip: every axis has its own spread, so mixing
    # up axes or frames would change some standard deviation by more than 20 %.
    rng = np.random.default_rng(2)
    truth = SE3.from_matrix(
        np.array([[0.0, 0, 1, 1], [-1, 0, 0, 2], [0, -1, 0, 3], [0, 0, 0, 1]])
    )
    pixels = rng.uniform([140, 20], [180, 220], (80, 2))
    points = truth.apply(CAMERA.unproject(pixels) * rng.uniform(3.8, 4.2, (80, 1)))
    errors = []
    claimed = []
    for _ in range(400):
        noisy = pixels + rng.normal(0, 0.3, pixels.shape)
        result = solve_pnp(noisy, points, CAMERA, PnpOptions())
        assert result is not None
        pose = result.pose
        rotation = (truth.inverse() @ pose).log()[3:]
        errors.append([*(pose.translation_m - truth.translation_m), *rotation])
        seen = noisy[result.inliers], points[result.inliers]
        claimed.append(uncertain(*seen, CAMERA, pose).covariance)
    spread = np.std(errors, axis=0)
    claim = np.sqrt(np.mean(claimed, axis=0).diagonal())
    ratios = claim / spread
    assert (np.abs(ratios - 1) < 0.2).all(), ratios
    for part in (spread[:3], spread[3:]):  # otherwise mixed-up axes pass
        ordered = np.sort(part)
        assert (ordered[1:] / ordered[:-1] > 1.3).all()
    # The squared Mahalanobis error of six Gaussian dimensions has mean 6.
    distances = [
        e @ np.linalg.inv(c) @ e for e, c in zip(np.array(errors), claimed, strict=True)
    ]
    assert np.mean(distances) == pytest.approx(6.0, rel=0.25)
