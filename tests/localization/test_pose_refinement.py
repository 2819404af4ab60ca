"""Refined poses and their covariance, against many drawn runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import exp1

from evercal.geometry import SE3, Camera, UncertainPose, pose_distance
from evercal.localization.alignment import _shift_by_intrinsics_px
from evercal.localization.intrinsics import (
    OWN,
    SAME_MODEL,
    STATED,
    UNKNOWN,
    IntrinsicsPrior,
)
from evercal.localization.pose_refinement import (
    SHARED,
    Minimum,
    Observed,
    cells_of,
    linearise,
    minimise,
    robust_variance,
)
from evercal.localization.self_calibration import self_calibrated
from evercal.typing import Array

CAMERA = Camera(640, 480, 520.0, 500.0, 322.0, 238.0)
POSE = SE3.exp(np.array([0.4, -0.3, 1.2, 0.3, -0.5, 0.2]))
NEAR = POSE @ SE3.exp(np.array([0.03, -0.02, 0.04, 0.02, -0.02, 0.01]))


def points(count: int, seed: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    return POSE.apply(rng.uniform([-1, -0.8, 1.5], [1, 0.8, 4.0], (count, 3)))


def project(points_m: Array, camera: Camera = CAMERA) -> Array:
    return camera.project(POSE.inverse().apply(points_m))


def refined(
    pixels: Array, points_m: Array, white: Array
) -> tuple[UncertainPose, Minimum]:
    """With fixed intrinsics; whitening (n, 2, 2)."""
    observed = Observed(pixels, points_m, white.transpose(1, 2, 0))
    found = minimise(observed, CAMERA, matrix_and_position(NEAR))
    return found.pose(found.variance * found.moved(np.zeros(0))[1]), found


def test_exact_pixels_give_the_exact_pose() -> None:
    points_m = points(30)
    # It ends at a tenth of a standard deviation; these are small.
    result, found = refined(
        project(points_m), points_m, np.tile(1e4 * np.eye(2), (30, 1, 1))
    )
    metres, radians = pose_distance(result.pose, POSE)
    assert metres < 1e-8
    assert radians < 1e-8
    assert found.residual_px.max() < 1e-4


def test_every_step_leads_nearer() -> None:
    points_m = points(30)
    seen = Observed(project(points_m), points_m, precise(30, 1e-4))
    at = matrix_and_position(NEAR)
    found = [minimise(seen, CAMERA, at, steps) for steps in (1, 2, 3)]
    away = [np.linalg.norm(a.position - POSE.translation_m) for a in found]
    assert away[0] < 0.2 * np.linalg.norm(NEAR.translation_m - POSE.translation_m)
    assert away[2] < 0.2 * away[1] < 0.04 * away[0]


def test_a_third_of_outliers_does_not_bias_the_pose() -> None:
    points_m = points(120)
    rng = np.random.default_rng(1)
    pixels = project(points_m) + rng.normal(0, 0.2, (120, 2))
    white = np.tile(np.eye(2) / 0.2, (120, 1, 1))
    right, _ = refined(pixels, points_m, white)
    pixels[:40] += rng.uniform(4, 12, (40, 2))  # all to one side
    result, found = refined(pixels, points_m, white)
    metres, radians = pose_distance(result.pose, right.pose)
    assert metres < 0.003
    assert radians < 0.002
    assert (found.residual_px[:40] > 3).all()
    assert np.median(found.residual_px[40:]) < 0.4


def test_covariance_matches_repeated_trials() -> None:
    count = 60
    runs = 400
    rng = np.random.default_rng(2)
    points_m = points(count)
    # Errors that differ from point to point and are longer in one direction.
    root = rng.normal(0, 0.15, (count, 2, 2)) + 0.2 * np.eye(2)
    white = np.linalg.inv(root)
    drawn = []
    claimed = []
    for _ in range(runs):
        noise = np.einsum("nij,nj->ni", root, rng.normal(size=(count, 2)))
        result, _ = refined(project(points_m) + noise, points_m, white)
        moved = (POSE.inverse() @ result.pose).log()[3:]
        shift = result.pose.translation_m - POSE.translation_m
        drawn.append(np.concatenate([shift, moved]))
        claimed.append(result.covariance)
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
    points_m = points(200)
    rng = np.random.default_rng(3)
    noise = rng.normal(0, 0.3, (200, 2))
    white = np.tile(np.eye(2) / 0.3, (200, 1, 1))
    right, _ = refined(project(points_m) + noise, points_m, white)
    overconfident, _ = refined(project(points_m) + noise, points_m, 10 * white)
    np.testing.assert_allclose(
        overconfident.covariance, right.covariance, rtol=0.05, atol=1e-12
    )


def matrix_and_position(pose: SE3) -> tuple[Array, Array]:
    return pose.rotation_matrix(), pose.translation_m


@pytest.mark.parametrize("lens", [(), (-0.2, 0.05, 0.001, -0.002, 0.01)])
def test_derivatives_equal_finite_differences(lens: tuple[float, ...]) -> None:
    camera = replace(CAMERA, distortion=lens)
    points_m = points(10)
    pixels = project(points_m)

    def residual(tangent: Array, change: Array) -> Array:
        moved = matrix_and_position(NEAR @ SE3.exp(tangent))
        return linearise(pixels, points_m, *moved, camera.changed(change))[0]

    _, slope = linearise(pixels, points_m, *matrix_and_position(NEAR), camera, True)
    by_pose = linearise(pixels, points_m, *matrix_and_position(NEAR), camera)[1]
    np.testing.assert_allclose(by_pose, slope[:6], rtol=1e-12, atol=1e-9)
    for column in range(11):
        step = 1e-6 * np.eye(11)[column]
        ahead, behind = (residual(s[:6], s[6:]) for s in (step, -step))
        numeric = (ahead - behind) / 2e-6
        np.testing.assert_allclose(slope[column], numeric, rtol=1e-4, atol=1e-3)


def test_points_behind_the_camera_count_as_a_millimetre_ahead() -> None:
    pixels = np.zeros((3, 2))
    depths = np.array([[0.1, -0.2, -2.0], [0.1, -0.2, 0.0], [0.1, -0.2, 1e-3]])
    error, slope = linearise(pixels, depths, np.eye(3), np.zeros(3), CAMERA, True)
    ahead = CAMERA.project(depths[2])
    np.testing.assert_allclose(error.T, [ahead, ahead, ahead])
    np.testing.assert_allclose(slope[..., :2], slope[..., [2, 2]])


def test_matches_without_a_common_pose_do_not_diverge() -> None:
    """Ten steps with free intrinsics lead nowhere, and not out of the world."""
    variances = np.array([2e-8, 5e-3, 5e-3, 6e-7, 6e-7])
    for seed in range(40):
        rng = np.random.default_rng(seed)
        pixels = rng.uniform(0, [640, 480], (28, 2))
        points_m = points(28, seed)
        seen = Observed(pixels, points_m, precise(28, 0.1))
        result = minimise(seen, CAMERA, matrix_and_position(POSE), 10, variances)
        assert np.linalg.norm(result.position - POSE.translation_m) < 100
        assert np.isfinite(result.moved(result.variance / variances)[1]).all()
        assert 100 < result.camera.fx < 2000


def precise(count: int, sigma_px: float) -> Array:
    """(2, 2, n) whitening of errors of one standard deviation."""
    return np.repeat(np.eye(2)[..., None] / sigma_px, count, 2)


CHANGE = np.array([0.004, 1.5, -1.0, 0.004, -0.003])
"""Between two cameras of a model."""


def seen_with(change: Array, seed: int, sigma_px: float, noise_px: float) -> Observed:
    """300 points seen with other intrinsics than those of `CAMERA`."""
    points_m = points(300, seed)
    noise = np.random.default_rng(seed).normal(size=(300, 2))
    pixels = project(points_m, CAMERA.changed(change)) + noise_px * noise
    return Observed(pixels, points_m, precise(300, sigma_px))


@pytest.mark.parametrize("other", [STATED, SAME_MODEL, UNKNOWN])
@pytest.mark.parametrize(
    ("sigma_px", "noise_px", "share", "off"),
    [
        (3.0, 0.01, 0.05, 0.03),  # the errors are small, so that all weights are 1
        (0.3, 0.3, 0.2, 1.5),
    ],
)
def test_a_minimum_moves_to_that_of_another_prior(
    sigma_px: float, noise_px: float, share: float, off: float, other: IntrinsicsPrior
) -> None:
    tight = OWN.variances(CAMERA)
    wide = other.variances(CAMERA)
    for seed in range(4):
        seen = seen_with(share * CHANGE, seed, sigma_px, noise_px)
        own, expected = (
            minimise(seen, CAMERA, matrix_and_position(NEAR), 30, v)
            for v in (tight, wide)
        )
        step, covariance = own.moved(own.variance / wide)
        again, inverse = expected.moved(expected.variance / wide)
        turn = Rotation.from_matrix(own.rotation.T @ expected.rotation).as_rotvec()
        shift = own.rotation.T @ (expected.position - own.position)
        real = np.concatenate([shift, turn, expected.change - own.change])
        root = np.linalg.inv(np.linalg.cholesky(expected.variance * inverse))
        assert (
            np.linalg.norm(root @ (step - real)) < off < 2 * np.linalg.norm(root @ step)
        )
        assert np.linalg.norm(root @ again) < 0.1  # it is at its own minimum
        ratio = np.linalg.eigvals(np.linalg.solve(inverse, covariance)).real
        assert np.abs(np.log(ratio)).mean() < 0.2 * off


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_a_far_camera_is_reached_by_repetition(factor: float) -> None:
    """The errors are linear in the intrinsics; `align_pose` begins again where the last ended."""
    far = np.array([np.log(factor), 12.0, -9.0, -0.06, 0.03])
    seen = seen_with(far, 0, 0.3, 0.3)
    change = np.zeros(5)
    prior = UNKNOWN
    result = self_calibrated(seen, CAMERA, matrix_and_position(NEAR), change, prior)
    moved = []
    for _ in range(8):
        moved.append(_shift_by_intrinsics_px(CAMERA, result.change - change))
        if moved[-1] < 0.2:
            break
        at = matrix_and_position(result.pose.pose)
        change = result.change
        result = self_calibrated(seen, CAMERA, at, change, prior)
    assert moved[-1] < 0.2 < moved[-2]
    truth = CAMERA.changed(far)
    assert result.camera.fx == pytest.approx(truth.fx, rel=2e-3)
    np.testing.assert_allclose(
        result.camera.distortion[:2], truth.distortion[:2], atol=0.01
    )
    assert result.pose.squared_mahalanobis(POSE) < 22.5
    assert pose_distance(result.pose.pose, POSE)[0] < 0.01


def test_the_variance_is_that_of_gaussian_errors_whatever_a_third_of_them_is() -> None:
    rng = np.random.default_rng(0)
    squares = (rng.normal(0, 3.0, (40_000, 2)) ** 2).sum(1)
    assert robust_variance(squares) == pytest.approx(9, rel=0.03)
    squares[:12_000] = 1e6
    assert robust_variance(squares) < 9 * 2.5
    assert robust_variance(np.zeros(9)) == 0.05
    assert robust_variance(np.array([1.0, 2.0, 1e9])) == pytest.approx(2 / 1.386)


def test_cells_are_squares_of_a_quarter_of_the_shorter_side() -> None:
    tall = replace(CAMERA, width=480, height=640)
    for camera, cells in ((CAMERA, (6, 4)), (tall, (4, 6))):
        grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)))
        pixels = grid.reshape(2, -1).T[::7].astype(float)
        found = cells_of(pixels, camera)
        assert found.shape == (len(pixels), cells[0] * cells[1])
        assert (found.sum(1) == 1).all()
        for column in found.T.astype(bool):
            assert np.ptp(pixels[column] // 120, axis=0).tolist() == [0, 0]


def test_errors_that_a_cell_shares_do_not_average_out() -> None:
    """The slow twin draws them: of each cell one error, beside those of single landmarks."""
    rng = np.random.default_rng(5)
    points_m = points(400, 5)
    exact = project(points_m)
    cells = cells_of(exact, CAMERA)
    # The whitening says 1, so the variance is 4 and the shared part 16 SHARED.
    sigma = 2.0
    drawn = []
    claimed = []
    alone = []
    for _ in range(150):
        noise = sigma * rng.normal(size=exact.shape)
        common = sigma**2 * np.sqrt(SHARED) * rng.normal(size=(cells.shape[1], 2))
        seen = Observed(exact + noise + cells @ common, points_m, precise(400, 1.0))
        found = minimise(seen, CAMERA, matrix_and_position(POSE))
        drawn.append(found.position - POSE.translation_m)
        for of, matrix in ((claimed, cells), (alone, np.eye(len(cells)))):
            covariance = found.covariance(np.zeros(0), matrix)
            of.append(found.pose(covariance).covariance[:3, :3])
    true = np.cov(np.array(drawn).T)
    ratio = np.linalg.eigvals(np.linalg.solve(true, np.mean(claimed, 0))).real
    # Landmarks share errors with Cauchy's weight, of mean a, and move the pose by its square, of
    # mean b, see above: the claim is (a / b)^2 = 2.9 times as large.
    assert 2.2 < np.exp(np.log(ratio).mean()) < 4.2
    assert np.trace(np.mean(claimed, 0)) > 2 * np.trace(np.mean(alone, 0))


def test_other_intrinsics_that_are_held_move_the_pose() -> None:
    """Beside the minimum with the other intrinsics."""
    seen = seen_with(np.zeros(5), 3, 3.0, 0.0)
    free = np.full(5, 1e-2)
    start = matrix_and_position(POSE)
    slope = minimise(seen, CAMERA, start, 10, free).by_intrinsics()
    for column, step in enumerate([1e-3, 1.0, 1.0, 1e-3, 1e-3]):
        change = step * np.eye(5)[column]
        found = minimise(seen, CAMERA.changed(change), start, 20)
        shift = POSE.rotation_matrix().T @ (found.position - POSE.translation_m)
        turn = Rotation.from_matrix(POSE.rotation_matrix().T @ found.rotation)
        moved = np.concatenate([shift, turn.as_rotvec()])
        expected = step * slope[:, column]
        assert np.linalg.norm(moved - expected) < 0.05 * np.linalg.norm(expected)


def test_independent_errors_average_out() -> None:
    """An M-estimator's covariance is that of repeated trials where cells share next to nothing."""
    rng = np.random.default_rng(6)
    points_m = points(120, 6)
    drawn = []
    claimed = []
    for _ in range(500):
        noise = 0.5 * rng.normal(size=(120, 2))
        seen = Observed(project(points_m) + noise, points_m, precise(120, 1.0))
        found = minimise(seen, CAMERA, matrix_and_position(POSE))
        result = found.pose(found.covariance(np.zeros(0), np.eye(120)))
        turned = (POSE.inverse() @ result.pose).log()[3:]
        shift = result.pose.translation_m - POSE.translation_m
        drawn.append(np.concatenate([shift, turned]))
        claimed.append(result.covariance)
    true = np.cov(np.array(drawn).T)
    ratio = np.linalg.eigvals(np.linalg.solve(true, np.mean(claimed, 0))).real
    assert np.exp(np.log(ratio).mean()) == pytest.approx(1, abs=0.1)


def test_an_error_that_all_landmarks_share_grows_with_their_number() -> None:
    """A hundredth of a pixel in every landmark counts as one error of all of them."""
    for count, sigma_px in ((30, 0.3), (120, 0.1)):
        points_m = points(count)
        seen = Observed(project(points_m), points_m, precise(count, sigma_px))
        found = minimise(seen, CAMERA, matrix_and_position(POSE))
        assert found.bent == pytest.approx(count * (0.01 / sigma_px) ** 2)
        prior = found.against(np.array([4.0]))
        assert prior == pytest.approx((found.variance + found.bent) / 4)
