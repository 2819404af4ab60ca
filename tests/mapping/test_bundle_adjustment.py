"""Bundle adjustment of tracks that are made by projection."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize

from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.geometry.rays import fit_rays
from evercal.mapping.built_map import of_rays
from evercal.mapping.bundle_adjustment import BundleAdjustment
from evercal.mapping.bundle_equations import COMMON, SHARED, Parameters
from evercal.mapping.bundle_options import BundleOptions
from evercal.mapping.stated_errors import StatedErrors
from evercal.mapping.variance_components import noise_of
from evercal.typing import Array

from .projected_tracks import (
    CAMERA,
    FRAMES,
    adjusted,
    errors,
    jittered,
    path,
    problem,
    velocities,
    without_gauge,
    world,
)

STILL = StatedErrors(np.zeros((FRAMES, 6)))
"""Cameras whose poses are stated."""


def test_exact_poses_do_not_change() -> None:
    made = world(noise_px=0.0)
    result = adjusted(made, made.truth)
    metres, radians = errors(result.poses, made.truth)
    assert metres.max() < 1e-5
    assert radians.max() < 1e-5
    np.testing.assert_allclose(result.inverse_depth, made.inverse_depth, rtol=1e-4)
    assert np.abs(result.common.log()).max() < 1e-6
    assert result.cameras is not None
    assert result.cameras[0].fx == pytest.approx(CAMERA.fx, rel=1e-6)
    assert result.residual_px < 1e-3


def test_pixel_noise_hardly_moves_poses() -> None:
    made = world()
    result = adjusted(made, made.truth)
    metres, radians = errors(result.poses, made.truth)
    assert metres.max() < 1e-3
    assert radians.max() < 5e-4
    assert result.sigma_m < 3e-4
    assert result.sigma_rad < 2e-4
    assert result.shift_frames == 0
    # The median length of a residual of two Gaussian axes, less what the fit takes up.
    assert result.residual_px == pytest.approx(0.2 * 1.177, rel=0.1)


@pytest.mark.parametrize(
    ("sigma_m", "sigma_deg"), [(0.005, 0.3), (0.02, 0.1), (0.002, 1.0)]
)
def test_pose_errors_shrink_and_their_size_is_estimated(
    sigma_m: float, sigma_deg: float
) -> None:
    made = world()
    sigma_rad = np.deg2rad(sigma_deg)
    stated = jittered(made.truth, sigma_m, sigma_rad)
    result = adjusted(made, stated)
    before = errors(without_gauge(stated, made.truth), made.truth)
    after = errors(without_gauge(result.poses, made.truth), made.truth)
    for a, b in zip(after, before, strict=True):
        assert np.median(a) < np.median(b) / 3
    # The common transform does not count as an error of single poses.
    assert result.sigma_m == pytest.approx(sigma_m, rel=0.3)
    assert result.sigma_rad == pytest.approx(sigma_rad, rel=0.3)


def test_covariance_matches_errors_of_many_runs() -> None:
    deviations = []
    spread = []
    for seed in range(6):
        made = world(seed=seed)
        stated = jittered(made.truth, 0.004, 0.004, seed + 100)
        result = adjusted(made, stated)
        deviations.append((made.truth.inverse() @ result.poses).log())
        spread.append(np.einsum("nii->ni", result.covariance))
    for part in (slice(0, 3), slice(3, 6)):
        claimed = np.mean([s[:, part] for s in spread])
        true = np.mean([np.square(e[:, part]) for e in deviations])
        assert 0.4 < claimed / true < 1.3


@pytest.mark.parametrize("systematic", [False, True])
def test_systematic_errors_of_an_arm_widen_the_covariance(systematic: bool) -> None:
    """Errors that are linear in the pose are told from independent ones by the residuals."""
    made = world(noise_px=0.05)
    rng = np.random.default_rng(0)
    options = BundleOptions(
        common_stated=False, common_sigma_m=0.2, common_sigma_deg=10.0
    )
    rotations = made.truth.rotation
    turns = (rotations.mean().inv() * rotations).as_rotvec()
    linear = np.concatenate([turns, made.truth.translation_m], 1)
    linear = (linear - linear.mean(0)) / linear.std(0) / np.sqrt(6)
    sigma = np.repeat([1e-3, np.deg2rad(0.05)], 3)
    errors = rng.normal(0, sigma, (FRAMES, 6))
    errors += 3 * systematic * linear @ rng.normal(0, sigma, (6, 6))
    result = BundleAdjustment(
        made.truth @ SE3.exp(errors), [CAMERA] * FRAMES, STILL, options
    ).solve(made.tracks)
    ratio = np.trace(result.common_systematic) / np.trace(result.common_covariance)
    assert ratio > 1 if systematic else ratio < 1


def test_an_arm_errs_at_the_gripper() -> None:
    """A rotation of the gripper moves a camera on a lever and nearly cancels at the landmarks."""
    made = world(noise_px=0.05)
    rng = np.random.default_rng(0)
    options = BundleOptions(
        common_stated=False, common_sigma_m=0.2, common_sigma_deg=10.0
    )
    gripper_from_camera = SE3.stack([SE3.from_translation((0.3, 0.0, 1.2))] * FRAMES)
    errors = rng.normal(0, np.repeat([2e-4, np.deg2rad(0.2)], 3), (FRAMES, 6))
    grippers = made.truth @ gripper_from_camera.inverse()
    stated = grippers @ SE3.exp(errors) @ gripper_from_camera
    at_camera = BundleAdjustment(stated, [CAMERA] * FRAMES, STILL, options).solve(
        made.tracks
    )
    problem = BundleAdjustment(
        stated,
        [CAMERA] * FRAMES,
        StatedErrors(np.zeros((FRAMES, 6)), gripper_from_camera),
        options,
    )
    at_gripper = problem.solve(made.tracks)
    assert at_gripper.sigma_m < 5e-4
    assert np.rad2deg(at_gripper.sigma_rad) == pytest.approx(0.2, rel=0.3)
    assert at_camera.sigma_m > 2e-3
    widest = [
        np.linalg.eigvalsh(a.common_covariance)[-1] for a in (at_gripper, at_camera)
    ]
    assert widest[0] < widest[1]


def test_common_transform_is_estimated() -> None:
    made = world()
    common = SE3.exp(np.array([0.012, -0.008, 0.015, 0.01, -0.015, 0.02]))
    result = adjusted(made, made.truth @ common.inverse())
    metres, radians = pose_distance(result.common, common)
    assert metres < 1.5e-3
    assert radians < 1e-3
    assert result.sigma_m < 1e-3
    metres, radians = errors(without_gauge(result.poses, made.truth), made.truth)
    assert np.median(metres) < 1e-3
    assert np.median(radians) < 1e-3
    assert np.abs(result.correction[:, :3]).max() < 2e-3


@pytest.mark.parametrize("factor", [1.01, 0.99])
def test_focal_length_is_estimated(factor: float) -> None:
    made = world()
    wrong = replace(CAMERA, fx=factor * CAMERA.fx, fy=factor * CAMERA.fy)
    result = adjusted(made, made.truth, wrong)
    assert result.cameras is not None
    assert result.cameras[0].fx == pytest.approx(CAMERA.fx, rel=1e-3)
    assert result.cameras[0].fy == pytest.approx(CAMERA.fy, rel=1e-3)
    metres, _ = errors(result.poses, made.truth)
    assert np.median(metres) < 2e-3
    # It is not adjusted without `intrinsics`, or if frames have different cameras.
    fixed = adjusted(made, made.truth, wrong, options=BundleOptions(intrinsics=False))
    assert fixed.cameras is None
    several = [wrong, *[CAMERA] * (FRAMES - 1)]
    mixed = BundleAdjustment(made.truth, several, STILL, BundleOptions())
    assert mixed.solve(made.tracks).cameras is None


def test_missing_distortion_is_estimated() -> None:
    distorted = replace(CAMERA, distortion=(-0.08, 0.03, 0.0, 0.0))
    made = world(distorted)
    result = adjusted(made, made.truth, CAMERA)
    assert result.cameras is not None
    corners = np.array([[30.0, 30], [610, 30], [320, 440], [100, 240], [320, 240]])
    rays = result.cameras[0].unproject(corners)
    truth = distorted.unproject(corners)
    assert np.abs(CAMERA.unproject(corners) - truth).max() > 0.015
    assert np.abs(rays - truth).max() < 2e-3
    # A stated distortion does not change.
    same = adjusted(made, made.truth, distorted)
    assert same.cameras is not None
    np.testing.assert_allclose(
        same.cameras[0].distortion, distorted.distortion, atol=1e-3
    )


def test_the_lens_of_a_hand_eye_calibration_is_free() -> None:
    """What a wrong file shifts, tangential terms included, is found; the rays agree."""
    lens = CAMERA.changed([0.005, 4, -3, 0.05, -0.05, 1e-3, -1e-3, 0.02])
    made = world(lens)
    options = BundleOptions().for_hand_eye(moves=True)
    result = adjusted(made, made.truth, CAMERA, options=options)
    assert result.cameras is not None
    fit = fit_rays(lens, result.cameras[0])
    apart = result.common.rotation * fit.own_from_other.inv()
    assert np.rad2deg(apart.magnitude()) < 0.02
    assert np.rad2deg(np.median(fit.left_rad)) < 0.01
    kept = np.rad2deg(np.median(fit_rays(lens, CAMERA).left_rad))
    assert kept > 0.1
    # An error of the frame that one of the lens cancels is no error of the rays.
    camera = result.cameras[0]
    by_noise, by_lens, _ = of_rays(result, camera, camera, 1.0)
    of_frame = np.trace(result.common_covariance[3:, 3:])
    assert np.trace((by_noise + by_lens)[3:, 3:]) < of_frame / 4
    tight = np.linalg.eigvalsh(by_noise).min()
    assert tight > 0


@pytest.mark.parametrize("late", [0.4, -0.3, 0.0])
def test_time_shift_is_estimated(late: float) -> None:
    times = np.arange(float(FRAMES))
    made = world(truth=path(times + late))
    stated = jittered(path(times), 0.001, 0.0005)
    result = adjusted(made, stated, velocity=velocities(stated))
    assert result.shift_frames == pytest.approx(late, abs=0.03)


def test_outlier_pose_gets_little_weight() -> None:
    made = world()
    stated = jittered(made.truth, 0.002, 0.001)
    # Larger errors leave a frame without tracks; `pose_check` removes it.
    off = SE3.exp(np.array([0.06, -0.03, 0.04, 0.01, 0.02, 0.0]))
    corrupted = SE3.stack(
        [stated[i] @ off if i == 13 else stated[i] for i in range(FRAMES)]
    )
    result = adjusted(made, corrupted)
    assert result.weight.argmin() == 13
    assert result.weight[13] < 0.1
    assert np.delete(result.weight, 13).min() > 0.25
    metres, _ = errors(without_gauge(result.poses, made.truth), made.truth)
    assert metres[13] < 0.01
    # The other poses are not affected.
    assert result.sigma_m == pytest.approx(0.002, rel=0.5)
    clean = adjusted(made, stated)
    assert clean.weight.min() > 0.25


def test_few_outlier_tracks_change_little() -> None:
    made = world()
    rng = np.random.default_rng(3)
    outliers = rng.choice(
        len(made.tracks.frame), len(made.tracks.frame) // 20, replace=False
    )
    observed = made.tracks.observed.copy()
    observed[outliers] += rng.normal(0, 15, (len(outliers), 2))
    made.tracks = replace(made.tracks, observed=observed)
    result = adjusted(made, made.truth)
    metres, _ = errors(result.poses, made.truth)
    assert metres.max() < 2e-3


def test_steps_reach_the_minimum_of_a_slow_solver() -> None:
    """`scipy.optimize.least_squares` minimises the same cost, with numerical derivatives."""
    truth = path(np.array([0.0, 3, 6, 9, 12]))
    made = world(truth=truth, every=1, landmarks=8)
    stated = jittered(truth, 0.004, 0.004)
    options = BundleOptions(distortion_sigma=1e-9)
    tracks = made.tracks
    velocity = velocities(stated)
    bundle = problem(stated, velocity=velocity, options=options)
    variances = bundle.start_variances()
    estimate = bundle.start(tracks)
    for _ in range(80):
        estimate = bundle.step(tracks, estimate, variances)
    noise = noise_of(estimate.linearised)
    n = len(truth)
    scale = np.concatenate(
        [
            np.tile(variances.sigma, n),
            np.sqrt(variances.shared),
            0.01 * tracks.inverse_depth,
        ]
    )

    def parameters(x: Array) -> Parameters:
        own, shared, depth = np.split(x * scale, [6 * n, 6 * n + SHARED])
        return Parameters(own.reshape(n, 6), shared, tracks.inverse_depth + depth)

    def residuals(x: Array) -> Array:
        at = parameters(x)
        lin = bundle.frames.linearise(tracks, at)
        squares = (lin.residual**2).sum(1)
        robust = np.sqrt(np.log1p(squares / noise**2) / squares) / options.correlation
        explained = at.shared[:COMMON] + at.shared[COMMON] * velocity
        prior = (at.correction - explained) / variances.sigma
        shared = at.shared / np.sqrt(variances.shared)
        return np.concatenate(
            [(lin.residual * robust[:, None]).ravel(), prior.ravel(), shared]
        )

    slow = scipy.optimize.least_squares(
        residuals, np.zeros(len(scale)), xtol=1e-14, ftol=1e-14
    )
    cost = bundle.cost(estimate, variances, noise)
    assert 2 * slow.cost == pytest.approx(cost, rel=2e-6)
    expected = parameters(slow.x)
    difference = np.concatenate(
        [
            (estimate.parameters.correction - expected.correction).ravel(),
            estimate.parameters.shared - expected.shared,
        ]
    )
    deviation = np.sqrt(np.einsum("ij,ij->j", estimate.root, estimate.root))
    assert np.abs(difference / deviation).max() < 0.05
    observed = np.unique(tracks.landmark)
    depth, slow_depth = (
        p.inverse_depth[observed] for p in (estimate.parameters, expected)
    )
    np.testing.assert_allclose(depth, slow_depth, rtol=1e-3)


def collinear(frames: int) -> SE3:
    """Positions on a line, all with the same rotation."""
    return SE3.stack([SE3.exp([0.1 * i, 0, 0, 0, 0, 0]) for i in range(frames)])


def test_no_step_raises_the_cost_far_from_the_minimum() -> None:
    made = world(truth=collinear(6), every=1, landmarks=20)
    stated = jittered(made.truth, 0.1, 0.1, seed=9)
    tracks = replace(made.tracks, inverse_depth=0.2 * made.inverse_depth)
    bundle = problem(stated)
    variances = bundle.start_variances()
    estimate = bundle.start(tracks)
    for _ in range(10):
        noise = noise_of(estimate.linearised)
        before = bundle.cost(estimate, variances, noise)
        estimate = bundle.step(tracks, estimate, variances)
        after = bundle.cost(estimate, variances, noise)
        assert after <= before * (1 + 1e-8)


def test_nearly_singular_normal_equations_are_solved() -> None:
    """Priors this wide leave the gauge free: Cholesky's factorisation fails without damping."""
    made = world(truth=collinear(12), every=1, landmarks=10)
    options = BundleOptions(start_sigma_m=1e7, start_sigma_deg=1e9)
    result = adjusted(made, made.truth, options=options)
    assert result.residual_px < 0.3
    np.testing.assert_allclose(result.inverse_depth, made.inverse_depth, rtol=0.05)
    assert np.linalg.eigvalsh(result.covariance).min() > 0


def test_unsolvable_normal_equations_are_refused() -> None:
    made = world(noise_px=np.nan)
    with pytest.raises(InputError, match="the images do not determine the poses"):
        adjusted(made, made.truth)
