"""Expected information against numerical derivatives, Tsai and Lenz's conditions, and draws."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from evercal.calibration.view_information import (
    HandEyeViews,
    ScenePoints,
    ViewNoise,
    looked_at,
    pixel_slopes,
)
from evercal.geometry import SE3, Camera, UncertainPose

MOUNT = SE3.exp(np.array([0.05, -0.04, 0.03, 0.3, -0.2, 0.7]))
SCENE = np.array([0.5, 0.1, 0.0])
NOISE = ViewNoise()
CAMERA = Camera(640, 480, 525.0, 520.0, 320.0, 240.0, (0.05, -0.02, 0.001, 0.0005))


def grippers(count: int, turn: tuple[float, float, float] = (0.5, 0.5, 0.5)) -> SE3:
    rng = np.random.default_rng(1)
    tangents = np.concatenate(
        [rng.uniform(-0.3, 0.3, (count, 3)), rng.uniform(-1, 1, (count, 3)) * turn], 1
    )
    return SE3.exp(tangents)


def changed(pose: SE3, step: np.ndarray) -> SE3:
    """A pose with an error in the convention of `UncertainPose`."""
    turned = pose.rotation_matrix() @ Rotation.from_rotvec(step[3:]).as_matrix()
    quaternion = Rotation.from_matrix(turned).as_quat(scalar_first=True)
    return SE3(quaternion, pose.translation_m + step[:3])


def numerical(function: object, size: int, step: float = 1e-6) -> np.ndarray:
    columns = []
    for i in range(size):
        e = step * np.eye(size)[i]
        columns.append((function(e) - function(-e)) / (2 * step))  # type: ignore[operator]
    return np.stack(columns, -1)


def test_the_jacobian_is_that_of_the_residuals() -> None:
    poses, scene = grippers(4), SE3.from_translation(SCENE)
    state = HandEyeViews.start(MOUNT, SCENE, NOISE)
    for i, gripper in enumerate(poses):
        camera = scene.inverse() @ gripper @ MOUNT

        def residual(step: np.ndarray, gripper: SE3 = gripper, camera: SE3 = camera) -> np.ndarray:
            moved = (gripper @ changed(MOUNT, step[:6])).inverse()
            return (moved @ scene @ SE3.exp(step[6:]) @ camera).log()

        expected = numerical(residual, 12)
        np.testing.assert_allclose(state.jacobian(poses)[i], expected, atol=1e-8)


def test_the_weights_are_those_of_noise_on_both_poses() -> None:
    gripper, scene = grippers(1)[0], SE3.from_translation(SCENE)
    camera = scene.inverse() @ gripper @ MOUNT

    def residual(noise: np.ndarray) -> np.ndarray:
        stated, measured = gripper @ SE3.exp(noise[:6]), camera @ SE3.exp(noise[6:])
        return ((stated @ MOUNT).inverse() @ scene @ measured).log()

    slope = numerical(residual, 12)
    both = np.zeros((12, 12))
    both[:6, :6], both[6:, 6:] = NOISE.gripper, NOISE.camera
    state = HandEyeViews.start(MOUNT, SCENE, NOISE)
    weights = state.weights(SE3.stack([gripper]))[0]
    np.testing.assert_allclose(
        np.linalg.inv(weights), slope @ both @ slope.T, rtol=1e-5, atol=1e-13
    )


@pytest.mark.parametrize(
    ("turn", "open_directions"),
    [((0, 0, 0), 3), ((0, 0, 0.6), 1), ((0.6, 0, 0.6), 0), ((0.5, 0.5, 0.5), 0)],
)
def test_rotations_about_two_axes_are_needed(
    turn: tuple[float, float, float], open_directions: int
) -> None:
    """The position of X stays open by as many directions as Tsai and Lenz state."""
    state = HandEyeViews.start(MOUNT, SCENE, NOISE)
    added = state.added(grippers(8, turn)).sum(0)
    # What no view decides has a standard deviation of about 30 m.
    sees = added + 1e-3 * np.eye(12)
    position = np.linalg.inv(sees)[:3, :3]
    assert int((np.linalg.eigvalsh(position) > 1.0).sum()) == open_directions


def test_the_covariance_is_that_of_estimates_from_drawn_noise() -> None:
    poses, scene = grippers(8), SE3.from_translation(SCENE)
    state = HandEyeViews.start(MOUNT, SCENE, NOISE)
    weights = np.linalg.cholesky(state.weights(poses))
    slope = (np.swapaxes(weights, 1, 2) @ state.jacobian(poses)).reshape(-1, 12)
    cameras, rng = scene.inverse() @ poses @ MOUNT, np.random.default_rng(5)
    robot, image = (np.sqrt(np.diag(part)) for part in (NOISE.gripper, NOISE.camera))
    errors = []
    for _ in range(250):
        stated = poses @ SE3.exp(robot * rng.normal(size=(8, 6)))
        measured = cameras @ SE3.exp(image * rng.normal(size=(8, 6)))

        def cost(x: np.ndarray, stated: SE3 = stated, measured: SE3 = measured) -> np.ndarray:
            predicted = stated @ changed(MOUNT, x[:6])
            residual = (predicted.inverse() @ scene @ SE3.exp(x[6:]) @ measured).log()
            return np.einsum("nji,nj->ni", weights, residual).ravel()

        found = least_squares(cost, np.zeros(12), lambda _: slope, x_scale=1e-3)  # type: ignore[arg-type]
        errors.append(found.x[:6])
    expected = np.linalg.inv(state.added(poses).sum(0))[:6, :6]
    squared = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(expected), errors)
    assert squared.mean() == pytest.approx(6.0, rel=0.12)  # chi-squared of six


def test_pixel_slopes_match_numerical_derivatives() -> None:
    rng = np.random.default_rng(2)
    points = np.concatenate([rng.uniform(-0.2, 0.2, (10, 2)), rng.uniform(0.5, 1, (10, 1))], 1)
    by_pose, by_point, visible = pixel_slopes(CAMERA, np.concatenate([points, [[0, 0, -1.0]]]))
    assert visible.tolist() == list(range(10))
    moved = numerical(lambda x: CAMERA.project(SE3.exp(x).inverse().apply(points)), 6)
    shifted = numerical(lambda x: CAMERA.project(points + x), 3)
    np.testing.assert_allclose(by_pose, moved, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(by_point, shifted, rtol=1e-4, atol=1e-3)


def test_a_view_without_the_scene_adds_nothing() -> None:
    points = ScenePoints(CAMERA, SCENE + np.random.default_rng(0).uniform(-0.1, 0.1, (30, 3)))
    lift = np.array([0, 0, 0.6])
    ahead, behind = SE3.from_translation(SCENE - lift), SE3.from_translation(SCENE + lift)
    state = HandEyeViews.start(SE3.identity(), SCENE, NOISE, points)
    added = state.added(SE3.stack([ahead, behind]))
    assert np.linalg.matrix_rank(added[0]) == 6
    assert not added[1].any()


def test_a_better_known_mount_is_a_prior() -> None:
    exact = UncertainPose(MOUNT, 1e-10 * np.eye(6))
    state = HandEyeViews.start(exact, SCENE, NOISE).with_views(grippers(3))
    assert state.estimate.sigma_mm < 0.011


def test_the_point_looked_at_is_where_the_axes_meet() -> None:
    turned = SE3.exp(
        np.array([[0, 0, 0, 0.4, 0, 0], [0, 0, 0, 0, 0.5, 0], [0, 0, 0, -0.2, 0.1, 1]])
    )
    cameras = SE3.from_translation(SCENE) @ turned @ SE3.from_translation((0, 0, -0.7))
    np.testing.assert_allclose(looked_at(cameras), SCENE, atol=1e-2)
    parallel = SE3.from_translation([(0.0, 0, 0), (0.2, 0, 0)])
    np.testing.assert_allclose(looked_at(parallel), (0.1, 0, 0.5), atol=1e-6)
