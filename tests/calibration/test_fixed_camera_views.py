"""Derivatives of a wrist image by everything unknown, and what it does for a fixed camera."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evercal.calibration.fixed_camera_views import FixedCameraViews, HostedPoints, _prior
from evercal.calibration.next_views import next_views
from evercal.calibration.view_information import ViewNoise
from evercal.geometry import SE3, Camera
from evercal.simulation.box_room import look_at

CAMERA = Camera(320, 240, 260.0, 262.0, 159.5, 119.5)
MOUNT = SE3.exp(np.array([0.05, 0.02, 0.03, 0.1, -0.2, 0.6]))
MIDDLE = np.array([0.5, 0.0, 0.0])
FIXED = look_at(np.array([0.0, 0.5, 0.7]), MIDDLE)


def wrist_views(count: int, seed: int) -> SE3:
    """base_from_camera of views above the table."""
    rng = np.random.default_rng(seed)
    places = rng.uniform((0.1, -0.2, 0.5), (0.5, 0.5, 0.8), (count, 3))
    return SE3.stack([look_at(p, MIDDLE, float(rng.uniform(-1, 1))) for p in places])


def known() -> FixedCameraViews:
    """Three keyframes with 20 landmarks each on a table, seen by the fixed camera."""
    rng, hosts = np.random.default_rng(3), wrist_views(3, 1)
    points = MIDDLE + rng.uniform(-1, 1, (60, 3)) * (0.15, 0.15, 0.04)
    host = np.repeat([0, 1, 2], 20)
    local = hosts[host].inverse().apply(points)
    depth = local[:, 2]
    marks = HostedPoints(hosts, host, local / depth[:, None], 1 / depth, np.full(60, 0.004))
    empty = FixedCameraViews(np.zeros((0, 0)), marks, MOUNT, CAMERA, ViewNoise())
    mount = np.diag(np.repeat([5e-4, 5e-4], 3) ** 2)
    prior = _prior(marks, mount, (2e-4, 2e-4))
    seen = empty.seen_by_fixed(CAMERA, FIXED, 0.1)
    return FixedCameraViews(prior + seen, marks, MOUNT, CAMERA, ViewNoise())


def turned(pose: SE3, step: np.ndarray) -> SE3:
    matrix = pose.rotation_matrix() @ Rotation.from_rotvec(step[3:]).as_matrix()
    quaternion = Rotation.from_matrix(matrix).as_quat(scalar_first=True)
    return SE3(quaternion, pose.translation_m + step[:3])


def test_a_wrist_images_derivatives_match_numerical_ones() -> None:
    state, view = known(), wrist_views(1, 7)[0]
    gripper, marks = view @ MOUNT.inverse(), state.points
    jacobian, by_pose = state.wrist_jacobian(gripper)
    visible = np.flatnonzero(jacobian[:, 0, 12 + 18 :].any(0))
    assert len(visible) == len(jacobian) > 20

    def pixels(x: np.ndarray, own: np.ndarray) -> np.ndarray:
        mount = turned(MOUNT, x[6:12])
        # A keyframe is a wrist image: its gripper pose is known, X and its own error are not.
        grippers = marks.hosts @ MOUNT.inverse()
        hosts = grippers @ MOUNT @ SE3.exp(x[12:30].reshape(3, 6)) @ (MOUNT.inverse() @ mount)
        depths = 1 / (marks.inverse_depth + x[30:])
        points = hosts[marks.host].apply(marks.rays * depths[:, None])
        camera = gripper @ mount @ SE3.exp(own)
        return CAMERA.project(camera.inverse().apply(points))[visible]

    size, step = jacobian.shape[2], 1e-6
    for i in range(size):
        e = step * np.eye(size)[i]
        expected = (pixels(e, np.zeros(6)) - pixels(-e, np.zeros(6))) / (2 * step)
        np.testing.assert_allclose(jacobian[:, :, i], expected, atol=2e-3, rtol=1e-4)
    for i in range(6):
        own = step * np.eye(6)[i]
        expected = (pixels(np.zeros(size), own) - pixels(np.zeros(size), -own)) / (2 * step)
        np.testing.assert_allclose(by_pose[:, :, i], expected, atol=2e-3, rtol=1e-4)


def test_the_images_own_pose_is_eliminated() -> None:
    """Against the joint system with six more unknowns for the pose of the image."""
    state, view = known(), wrist_views(1, 7)
    gripper = view @ MOUNT.inverse()
    jacobian, by_pose = state.wrist_jacobian(gripper[0])
    rows = np.concatenate([jacobian, by_pose], 2).reshape(-1, jacobian.shape[2] + 6)
    joint = rows.T @ rows / state.noise.pixel_px**2
    to_camera = MOUNT.inverse().adjoint()
    joint[-6:, -6:] += np.linalg.inv(to_camera @ state.noise.gripper @ to_camera.T)
    joint[:-6, :-6] += state.information
    covariance = np.linalg.inv(joint)[:6, :6]
    added = state.information + state.added(gripper)[0]
    np.testing.assert_allclose(np.linalg.inv(added)[:6, :6], covariance, rtol=1e-4)


def test_views_that_show_the_landmarks_help_and_others_do_not() -> None:
    state = known()
    away = look_at(np.array([0.0, 0.5, 0.7]), np.array([-3.0, 0.5, 0.7]))
    reachable = SE3.stack([away, *wrist_views(10, 9)]) @ MOUNT.inverse()
    assert not state.added(reachable)[0].any()
    found = next_views(state, reachable, 11)
    assert len(found.index) == 10
    assert 0 not in found.index
    assert list(found.sigma_mm) == sorted(found.sigma_mm, reverse=True)
    assert found.sigma_mm[3] < 0.9 * found.sigma_mm[0]
    now = np.linalg.inv(state.information)[:6, :6]
    assert found.sigma_mm[0] == pytest.approx(1000 * np.sqrt(np.trace(now[:3, :3]) / 3))
