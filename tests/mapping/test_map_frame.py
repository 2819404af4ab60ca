"""Poses go from the frame of a map to the base frame and back."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evercal.geometry import SE3, Camera, UncertainPose, pose_distance
from evercal.mapping.map_frame import (
    FrameCorrection,
    MapFrame,
    Similarity,
    fit_correction,
    frame_covariance,
    shared_sigma,
)

CAMERA = Camera(320, 240, 300, 300, 159.5, 119.5)
SIMILARITY = Similarity(SE3.exp([1.0, -2.0, 0.5, 0.3, -0.9, 0.4]), 0.37)
COMMON = SE3.exp([0.01, 0.02, -0.01, 0.02, 0, 0.01])
POSE = SE3.exp([0.2, 0.1, -0.4, 1.0, 0.2, -0.3])


def walk(n: int, rng: np.random.Generator) -> SE3:
    steps = np.linspace(0, 6, n)
    position = np.stack([np.cos(steps), np.sin(steps), 0.1 * steps], -1)
    rotation = np.stack([0.2 * np.sin(steps), 0.1 * steps, 0.3 * np.cos(steps)], -1)
    return SE3.exp(
        np.concatenate([position + 0.01 * rng.normal(size=(n, 3)), rotation], 1)
    )


def smooth(poses: SE3) -> np.ndarray:
    """(n, 6) corrections that vary slowly over the positions."""
    x, y, _ = poses.translation_m.T
    zero = np.zeros_like(x)
    return np.stack([0.01 * x, 0.01 * y, zero, 0.005 * y, zero, 0.005 * x], -1)


def random_correction(seed: int) -> FrameCorrection:
    rng = np.random.default_rng(seed)
    poses = SE3.exp(rng.normal(0, [0.3] * 3 + [0.2] * 3, (12, 6)))
    return FrameCorrection(poses, rng.normal(0, 0.004, (12, 6)), (0.2, 0.26))


@settings(max_examples=30)
@given(seed=st.integers(0, 10_000), corrected=st.booleans(), scaled=st.booleans())
def test_landmarks_project_to_the_same_pixels_in_both_frames(
    seed: int, corrected: bool, scaled: bool
) -> None:
    frame = MapFrame(
        common=COMMON,
        correction=random_correction(seed) if corrected else None,
        similarity=SIMILARITY if scaled else None,
    )
    rng = np.random.default_rng(seed + 1)
    pose = SE3.exp(rng.normal(0, 0.3, 6))
    points = pose.apply(rng.uniform([-1, -1, 1], [1, 1, 4], (8, 3)))
    base = frame.to_base(UncertainPose.exact(pose)).pose
    pixels = CAMERA.project(pose.inverse().apply(points))
    camera = frame.camera_among_points(base)
    again = CAMERA.project(camera.inverse().apply(frame.points_to_base(points)))
    assert again == pytest.approx(pixels, abs=0.01)
    assert pose_distance(frame.from_base(base), pose)[0] < 1e-4


def test_similarity_has_an_inverse_and_scales_views() -> None:
    assert (
        max(pose_distance(SIMILARITY.inverse_pose(SIMILARITY.pose(POSE)), POSE)) < 1e-12
    )
    assert max(pose_distance(Similarity(SE3.identity()).pose(POSE), POSE)) < 1e-12
    points = np.random.default_rng(0).normal(size=(20, 3))
    before = POSE.inverse().apply(points)
    after = SIMILARITY.pose(POSE).inverse().apply(SIMILARITY.points(points))
    assert after == pytest.approx(0.37 * before)


def test_covariance_is_scaled_and_rotated() -> None:
    frame = MapFrame(
        pose_sigma=(0.2, 0.3),
        similarity=Similarity(SE3.exp([0, 0, 0, 0, 0, np.pi / 2]), 2.0),
    )
    covariance = np.diag([1.0, 4.0, 9.0, 0.1, 0.2, 0.3])
    result = frame.to_base(UncertainPose(POSE, covariance)).covariance
    expected = np.diag([4 * 4.04, 4 * 1.04, 4 * 9.04, 0.19, 0.29, 0.39])
    assert result == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("axis", range(6))
def test_error_of_the_base_frame_is_propagated(axis: int) -> None:
    """The slow twin moves the base frame by a finite difference."""
    step = np.zeros(6)
    unit = np.zeros((6, 6))
    step[axis] = 1e-6
    unit[axis, axis] = 1.0
    moved = SE3(SE3.exp(step).rotation_wxyz, step[:3]) @ POSE
    rotation = (POSE.inverse() @ moved).log()[3:]
    tangent = (
        np.concatenate([moved.translation_m - POSE.translation_m, rotation]) / 1e-6
    )
    result = MapFrame(base_covariance=unit).to_base(UncertainPose.exact(POSE))
    assert result.covariance == pytest.approx(np.outer(tangent, tangent), abs=1e-5)


def test_smooth_corrections_are_undone() -> None:
    rng = np.random.default_rng(0)
    stated = walk(200, rng)
    adjusted = stated @ COMMON @ SE3.exp(smooth(stated))
    correction = fit_correction(adjusted @ COMMON.inverse(), smooth(stated))
    assert correction is not None
    frame = MapFrame(common=COMMON, correction=correction)
    new = walk(57, rng)
    true = new @ COMMON @ SE3.exp(smooth(new))
    for pose, measured in zip(new, true, strict=True):
        plain = measured @ COMMON.inverse()
        corrected = frame.to_base(UncertainPose.exact(measured)).pose
        assert pose_distance(corrected, pose)[0] < 0.4 * pose_distance(plain, pose)[0]


def test_noise_and_zero_corrections_are_not_fitted() -> None:
    rng = np.random.default_rng(1)
    stated = walk(200, rng)
    noise = rng.normal(size=(200, 6)) * [0.002, 0.002, 0.002, 0.003, 0.003, 0.003]
    assert fit_correction(stated @ SE3.exp(noise), noise) is None
    assert fit_correction(stated, np.zeros((200, 6))) is None


def test_errors_that_neighbours_share_widen_the_stated_frame() -> None:
    rng = np.random.default_rng(0)
    poses = walk(200, rng)
    independent = rng.normal(0, [0.004] * 3 + [0.003] * 3, (200, 6))
    assert shared_sigma(poses, independent, None) == (0.0, 0.0)
    drift = np.cumsum(independent, 0)
    drift *= 0.004 / drift.std(0)
    metres, radians = shared_sigma(poses, drift, None)
    assert metres == pytest.approx(float(np.sqrt((drift[:, :3] ** 2).mean())))
    assert radians > 0
    assert shared_sigma(poses[:3], drift[:3], None) == (0.0, 0.0)


def test_error_of_the_stated_frame_is_added() -> None:
    exact = UncertainPose.exact(POSE)
    wide = MapFrame(pose_sigma=(0.003, 0.0), frame_sigma=(0.004, 0.02)).to_base(exact)
    np.testing.assert_allclose(np.diag(wide.covariance), [0.005**2] * 3 + [0.02**2] * 3)


def test_common_motion_of_the_cameras_moves_the_base_frame() -> None:
    rng = np.random.default_rng(10)
    root = rng.normal(0, 0.01, (6, 6))
    frame = frame_covariance(SE3.stack([POSE]), root @ root.T)
    draws = rng.normal(size=(40_000, 6)) @ root.T
    # exp(x) in the base frame moves the pose as a drawn motion moves it in the camera frame.
    errors = (POSE @ SE3.exp(draws) @ POSE.inverse()).log()
    sampled = errors.T @ errors / len(errors)
    np.testing.assert_allclose(frame, sampled, atol=0.02 * np.trace(sampled))
