"""Poses go from the frame of a map to the base frame and back."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

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


def test_a_correction_fades_with_distance_and_angle() -> None:
    """One frame: its correction counts with a Gaussian weight beside a zero that counts 0.3."""
    correction = np.array([[0.01, 0.02, -0.01, 0.002, 0.0, 0.001]])
    one = FrameCorrection(SE3.stack([POSE]), correction, (0.2, 0.25))
    near = one.at(POSE)
    np.testing.assert_allclose(near, correction[0] / 1.3)
    for shift, turn, sigmas in (
        (0.2, 0, 1),
        (0, 0.25, 1),
        (0.6, 0, 3),
        (0.2, -0.5, 5**0.5),
    ):
        moved = (
            SE3.from_translation([0, shift, 0]) @ POSE @ SE3.exp([0, 0, 0, 0, turn, 0])
        )
        # A rotation about the camera leaves its position.
        weight = np.exp(-0.5 * sigmas**2)
        expected = correction[0] * weight / (weight + 0.3)
        np.testing.assert_allclose(one.at(moved), expected, rtol=1e-6, atol=1e-12)
    # Quaternions of either sign are one rotation.
    same = SE3(-POSE.rotation_wxyz, POSE.translation_m)
    np.testing.assert_allclose(one.at(same), near)


def left_out(
    poses: SE3, correction: np.ndarray, metres: float, degrees: float
) -> np.ndarray:
    """What the others predict of each frame, one after the other."""
    rows = []
    radius = (metres, float(np.deg2rad(degrees)))
    for i, pose in enumerate(poses):
        others = np.delete(np.arange(len(poses)), i)
        rest = FrameCorrection(poses[others], correction[others], radius)
        rows.append(rest.at(pose))
    return np.array(rows)


@pytest.mark.parametrize("spacing", [0.03, 0.12, 0.3])
def test_the_length_that_predicts_left_out_frames_best_is_chosen(
    spacing: float,
) -> None:
    rng = np.random.default_rng(3)
    along = spacing * np.arange(40)
    zero = np.zeros(40)
    poses = SE3.exp(np.stack([along, zero, zero, 0.3 * along, zero, zero], -1))
    wave = np.sin(along / (4 * spacing))
    correction = np.outer(wave, [0.01, 0, 0.005, 0.004, 0.002, 0])
    correction += rng.normal(0, [0.002] * 3 + [0.001] * 3, (40, 6))
    size = np.abs(correction)
    scale = np.repeat([size[:, :3].mean(), size[:, 3:].mean()], 3)
    explained = {}
    for metres, degrees in ((0.1, 10.0), (0.2, 15.0), (0.4, 25.0)):
        left = correction - left_out(poses, correction, metres, degrees)
        ratio = ((left / scale) ** 2).sum() / ((correction / scale) ** 2).sum()
        explained[metres] = 1 - ratio
    best = max(explained, key=lambda metres: explained[metres])
    assert explained[best] > 0.3
    fitted = fit_correction(poses, correction)
    assert fitted is not None
    assert fitted.radius[0] == best


@pytest.mark.parametrize(("metres", "radians"), [(0.5e-4, 1e-3), (1e-3, 0.5e-5)])
def test_corrections_too_small_to_measure_are_not_predicted(
    metres: float, radians: float
) -> None:
    poses = walk(200, np.random.default_rng(0))
    size = np.repeat([metres, radians], 3)
    wave = np.sign(smooth(poses)) + (smooth(poses) == 0)
    assert fit_correction(poses, size * wave) is None
    assert fit_correction(poses, 2.1 * size * wave) is not None


def test_share_of_corrections_that_must_be_explained() -> None:
    """Noise hides a slow correction: it is predicted while 30 % of the variance are explained."""
    rng = np.random.default_rng(4)
    poses = walk(80, rng)
    noise = rng.normal(0, [0.006] * 3 + [0.003] * 3, (80, 6))
    found = set()
    for factor in np.linspace(0, 2, 9):
        correction = factor * smooth(poses) + noise
        scale = np.repeat(
            [np.abs(correction[:, :3]).mean(), np.abs(correction[:, 3:]).mean()], 3
        )
        explained = []
        for metres, degrees in ((0.1, 10.0), (0.2, 15.0), (0.4, 25.0)):
            left = correction - left_out(poses, correction, metres, degrees)
            ratio = ((left / scale) ** 2).sum() / ((correction / scale) ** 2).sum()
            explained.append(1 - ratio)
        fitted = fit_correction(poses, correction) is not None
        assert fitted == (max(explained) > 0.3)
        found.add(fitted)
    assert found == {True, False}


def test_shared_errors_are_those_that_neighbours_leave_correlated() -> None:
    rng = np.random.default_rng(6)
    poses = walk(100, rng)
    slow = smooth(poses)
    fitted = fit_correction(poses, slow)
    assert fitted is not None
    # What a fitted correction predicts is undone, and no error of the stated frame.
    noise = rng.normal(0, [0.004] * 3 + [0.003] * 3, (100, 6))
    alone = shared_sigma(poses, slow + noise, None)
    assert min(alone) > 0
    assert shared_sigma(poses, slow + noise, fitted) == (0.0, 0.0)
    # Shorter than the correlation length of the prediction, but longer than a frame.
    quick = np.repeat(rng.normal(0, [0.02] * 3 + [0.01] * 3, (25, 6)), 4, 0)
    metres, radians = shared_sigma(poses, slow + quick, fitted)
    both = slow + quick
    assert metres == pytest.approx(np.sqrt((both[:, :3] ** 2).mean()))
    assert radians == pytest.approx(np.sqrt((both[:, 3:] ** 2).mean()))


@pytest.mark.parametrize("drifts", [slice(0, 3), slice(3, 6)])
def test_positions_and_rotations_are_judged_apart(drifts: slice) -> None:
    rng = np.random.default_rng(8)
    poses = walk(200, rng)
    errors = rng.normal(0, 0.004, (200, 6))
    errors[:, drifts] = 2 * smooth(poses)[:, [0, 1, 5]]
    metres, radians = shared_sigma(poses, errors, None)
    assert (metres > 0, radians > 0) == (drifts.start == 0, drifts.start == 3)


def test_shared_errors_are_three_standard_errors_from_none() -> None:
    """Independent errors of many draws: about one in a thousand is called shared."""
    rng = np.random.default_rng(7)
    poses = walk(30, rng)
    draws = rng.normal(0, 0.004, (1000, 30, 6))
    found = [shared_sigma(poses, draw, None) for draw in draws]
    shared = np.array(found) > 0
    assert shared.mean() < 0.01
    # A correlation of a half between neighbours is above it in 90 images.
    many = rng.normal(0, 0.004, (300, 91, 6))
    correlated = (many[:, 1:] + many[:, :-1]) / np.sqrt(2)
    found = [shared_sigma(walk(90, rng), draw, None) for draw in correlated[:50]]
    assert (np.array(found) > 0).mean() > 0.95


def test_numbers_of_a_frame_without_and_with_a_similarity_and_a_correction() -> None:
    plain = MapFrame(frame_sigma=(0.003, 0.02))
    assert plain.scale == 1
    assert plain.shared_m == 0.003
    np.testing.assert_array_equal(plain.slope, np.eye(6))
    correction = random_correction(0)
    frame = MapFrame(
        correction=correction, frame_sigma=(0.003, 0.02), similarity=SIMILARITY
    )
    assert frame.scale == 0.37
    metres = np.sqrt((correction.correction[:, :3] ** 2).mean())
    assert frame.shared_m == pytest.approx(metres)
    # An answer beside a moved pose among the landmarks.
    for axis in range(6):
        step = 1e-6 * np.eye(6)[axis]
        turned = POSE @ SE3.exp(np.r_[np.zeros(3), step[3:]])
        moved = SE3(turned.rotation_wxyz, POSE.translation_m + step[:3])
        before, after = (
            MapFrame(similarity=SIMILARITY).to_base(UncertainPose.exact(pose)).pose
            for pose in (POSE, moved)
        )
        shift = after.translation_m - before.translation_m
        turn = (before.inverse() @ after).log()[3:]
        np.testing.assert_allclose(
            frame.slope[:, axis], np.concatenate([shift, turn]) / 1e-6, atol=1e-6
        )
