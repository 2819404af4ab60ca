"""Covariances of composed and inverted poses agree with sampling."""

import numpy as np
import pytest

from evercal.geometry import SE3, UncertainPose, axis_deviation, in_parent_axes

FIRST = SE3.exp([0.4, -0.3, 1.2, 0.5, -0.8, 0.3])
SECOND = SE3.exp([-0.2, 0.6, 0.7, -1.1, 0.4, 0.9])


def covariance(seed: int) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(6, 6)) * [0.002] * 6
    root[3:] *= 0.5
    return root @ root.T


def sampled(uncertain: UncertainPose, seed: int, count: int = 40_000) -> SE3:
    """Draw poses: the translation moves in the parent frame, the rotation about child axes."""
    draws = np.random.default_rng(seed).multivariate_normal(
        np.zeros(6), uncertain.covariance, size=count
    )
    rotation = SE3.exp(np.concatenate([np.zeros((count, 3)), draws[:, 3:]], 1))
    turned = SE3(
        uncertain.pose.rotation_wxyz[None].repeat(count, 0), np.zeros((count, 3))
    )
    return SE3(
        (turned @ rotation).rotation_wxyz, uncertain.pose.translation_m + draws[:, :3]
    )


def sample_covariance(poses: SE3, mean: SE3) -> np.ndarray:
    shift = poses.translation_m - mean.translation_m
    rotation = (mean.inverse() @ poses).log()[:, 3:]
    errors = np.concatenate([shift, rotation], 1)
    return errors.T @ errors / len(errors)


def assert_same(estimate: np.ndarray, expected: np.ndarray) -> None:
    assert np.abs(estimate - expected).max() < 0.04 * np.abs(expected).max()


def test_composition_adds_the_errors_of_both() -> None:
    a = UncertainPose(FIRST, covariance(0))
    b = UncertainPose(SECOND, covariance(1))
    both = a @ b
    draws = sampled(a, 2) @ sampled(b, 3)
    assert_same(both.covariance, sample_covariance(draws, FIRST @ SECOND))
    np.testing.assert_allclose(both.pose.matrix(), (FIRST @ SECOND).matrix())


def test_inverse() -> None:
    a = UncertainPose(FIRST, covariance(4))
    assert_same(
        a.inverse().covariance,
        sample_covariance(sampled(a, 5).inverse(), FIRST.inverse()),
    )
    np.testing.assert_allclose(
        a.inverse().inverse().covariance, a.covariance, atol=1e-15
    )


def test_exact_transforms_on_either_side() -> None:
    a = UncertainPose(SECOND, covariance(6))
    left = FIRST @ a
    right = a @ FIRST
    assert_same(left.covariance, sample_covariance(FIRST @ sampled(a, 7), left.pose))
    assert_same(right.covariance, sample_covariance(sampled(a, 8) @ FIRST, right.pose))


def test_adjoint_moves_a_tangent_to_the_other_side() -> None:
    tangent = np.array([0.1, -0.2, 0.3, 0.2, 0.4, -0.3])
    right = FIRST @ SE3.exp(tangent)
    left = SE3.exp(FIRST.adjoint() @ tangent) @ FIRST
    np.testing.assert_allclose(right.matrix(), left.matrix(), atol=1e-12)


def test_squared_mahalanobis_has_six_degrees_of_freedom() -> None:
    a = UncertainPose(FIRST, covariance(11))
    squares = [a.squared_mahalanobis(truth) for truth in sampled(a, 12, 2000)]
    assert np.mean(squares) == pytest.approx(6, rel=0.06)


@pytest.mark.parametrize("point", [(0.3, -0.2, 0.9), (0.0, 0.0, 0.0)])
def test_point_moves_as_sampled_poses_move_it(
    point: tuple[float, float, float],
) -> None:
    a = UncertainPose(FIRST, covariance(13))
    moved = sampled(a, 14).apply(np.array(point)) - FIRST.apply(np.array(point))
    expected = moved.T @ moved / len(moved)
    assert_same(a.point_covariance(point), expected)
    assert a.point_sigma_mm(point) == pytest.approx(
        1000 * np.sqrt((moved**2).mean()), rel=0.02
    )


def test_rotation_error_moves_a_point_ahead_across_and_not_along() -> None:
    quarter = SE3.exp([0, 0, 0, 0, 0, np.pi / 2])
    a = UncertainPose(quarter, np.diag([0, 0, 0, 4e-6, 0, 0]))
    # 2 mrad about x move a point 0.5 m along z by 1 mm along -y of the child, x of the parent.
    expected = np.diag([1e-6, 0, 0])
    np.testing.assert_allclose(
        a.point_covariance([0.0, 0.0, 0.5]), expected, atol=1e-15
    )
    assert a.point_sigma_mm([0.0, 0.0, 0.5]) == pytest.approx(1 / 3**0.5)


def test_axis_deviation() -> None:
    assert axis_deviation(
        np.diag([1e-6, 4e-6, 4e-6, 1e-4, 1e-4, 1e-4])
    ) == pytest.approx((3**0.5, np.rad2deg(0.01)))


def test_deviations_of_a_pose_are_those_of_its_axes() -> None:
    pose = UncertainPose(FIRST, np.diag([1e-6, 4e-6, 4e-6, 1e-4, 4e-4, 4e-4]))
    assert pose.sigma_mm == pytest.approx(3**0.5)
    assert pose.sigma_deg == pytest.approx(np.rad2deg(0.03**0.5 / 10))


def test_a_covariance_in_child_axes_is_turned_to_those_of_the_parent() -> None:
    """Draws of both, with the translation about the axes of the child."""
    in_child = covariance(15)
    turned = in_parent_axes(FIRST.rotation_matrix(), in_child)
    draws = np.random.default_rng(16).multivariate_normal(np.zeros(6), in_child, 40_000)
    draws[:, :3] = draws[:, :3] @ FIRST.rotation_matrix().T
    assert_same(turned, draws.T @ draws / len(draws))


def test_batches_and_other_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"covariance \(6, 6\)"):
        UncertainPose(SE3.identity((2,)), np.eye(6))
    with pytest.raises(ValueError, match=r"\(3, 3\)"):
        UncertainPose(FIRST, np.eye(3))
