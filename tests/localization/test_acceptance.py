"""Support of a pose, the fit of its threshold, and the covariance of accepted poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from evercal.geometry import SE3, UncertainPose
from evercal.learning.fit_acceptance import fit_acceptance, scatter
from evercal.localization.acceptance import (
    COVARIANCE_SCALE,
    MAX_SUPPORT,
    MIN_SUPPORT,
    accepted,
    support,
    widened,
)
from evercal.localization.query import Hypothesis
from evercal.mapping.scene_map import LeftOut, MapContents
from evercal.recordings.frame import Frame, Recording

Change = Callable[[Frame], Frame]


def hypothesis(inliers: int, matched: int, expected: int) -> Hypothesis:
    points = np.zeros((inliers, 3))
    pose, planned = UncertainPose(SE3.identity(), np.eye(6)), min(expected, 900)
    return Hypothesis(0, pose, None, points[:, :2], points, expected, matched, planned)


def test_support_formula() -> None:
    # Half of 800 landmarks match and 4 of 5 matches are inliers: 0.4 * 0.8^2 * sqrt(0.4 * 800).
    assert support(hypothesis(320, 400, 800)) == pytest.approx(0.4 * 0.64 * np.sqrt(320))
    assert support(hypothesis(45, 60, 900)) > support(hypothesis(45, 90, 900))
    assert support(hypothesis(45, 90, 600)) > support(hypothesis(45, 90, 900))


def test_searching_more_landmarks_does_not_raise_the_support() -> None:
    once, three_times = hypothesis(45, 90, 900), hypothesis(135, 270, 2700)
    assert support(three_times) == pytest.approx(support(once))


@pytest.mark.parametrize("threshold", [0.0, 1.5])
def test_pose_without_inliers_is_never_accepted(threshold: float, hall_map: MapContents) -> None:
    scene = replace(hall_map.scenes[0], min_support=threshold)
    assert not accepted(hypothesis(0, 0, 0), scene)
    assert not accepted(Hypothesis(0), scene)


def test_little_support_widens_the_covariance(hall_map: MapContents) -> None:
    scene = replace(hall_map.scenes[0], covariance_scale=1.5)
    # All of n landmarks are inliers, so the support is the square root of n.
    for landmarks, factor in ((1, 6.0), (4, 3.0), (16, 1.5), (400, 1.5)):
        wide = widened(hypothesis(landmarks, landmarks, landmarks), scene)
        np.testing.assert_allclose(wide.covariance, factor * np.eye(6))


def moved(frame: Frame) -> Frame:
    """The frame with a stated pose one metre away."""
    assert frame.base_from_camera is not None
    return replace(frame, base_from_camera=SE3.exp([1.0, 0, 0, 0, 0, 0]) @ frame.base_from_camera)


def occluded(frame: Frame) -> Frame:
    """The frame with noise over most of its image."""
    image = frame.read_image().copy()
    rng = np.random.default_rng(0)
    image[:, 48:] = rng.integers(0, 256, image[:, 48:].shape)
    return replace(frame, image=image)


def test_threshold_is_the_largest_where_held_out_frames_have_much_support(
    hall: Recording, hall_map: MapContents
) -> None:
    scene = fit_acceptance(hall_map, hall.test[::10])
    assert scene.min_support == MAX_SUPPORT
    assert scene.covariance_scale == COVARIANCE_SCALE
    assert scene.keyframes is hall_map.scenes[0].keyframes


def test_held_out_frames_with_little_support_lower_the_threshold(
    hall: Recording, hall_map: MapContents
) -> None:
    scene = fit_acceptance(hall_map, [occluded(frame) for frame in hall.test[1:12:2]])
    assert MIN_SUPPORT <= scene.min_support < MAX_SUPPORT


@pytest.mark.parametrize("frames", [1, 0])
def test_frames_far_from_their_stated_pose_do_not_count(
    frames: int, hall: Recording, hall_map: MapContents
) -> None:
    # The occluded frames would lower the threshold.
    held_out = [*hall.test[3 : 3 + frames], *(moved(occluded(f)) for f in hall.test[1:12:2])]
    assert fit_acceptance(hall_map, held_out).min_support == MAX_SUPPORT


def test_only_the_given_scene_is_fitted(hall: Recording, hall_map: MapContents) -> None:
    first = replace(hall_map.scenes[0], min_support=0.3)
    both = hall_map.with_scene(replace(first, name="second"))
    scene = fit_acceptance(both, hall.test[::20], index=0)
    assert scene.name == "hall"
    assert [other.min_support for other in both.scenes] == [hall_map.scenes[0].min_support, 0.3]


def test_shared_errors_of_held_out_poses_widen_the_stated_frame(
    hall: Recording, hall_map: MapContents
) -> None:
    def off(frames: Sequence[Frame], metres: float) -> list[Frame]:
        shift = SE3.exp([metres, 0, 0, 0, 0, 0])
        stated = [(frame, frame.base_from_camera) for frame in frames]
        return [replace(f, base_from_camera=shift @ pose) for f, pose in stated if pose is not None]

    held_out = hall.test[::3]
    few = fit_acceptance(hall_map, off(held_out[:7], 0.02))
    assert few.frame.frame_sigma == (0.0, 0.0)
    assert fit_acceptance(hall_map, held_out).frame.frame_sigma == (0.0, 0.0)
    metres, radians = fit_acceptance(hall_map, off(held_out, 0.02)).frame.frame_sigma
    assert 0.005 < metres < 0.015
    assert radians == 0.0
    # Independent noise of stated poses is no error of an answer.
    noisy = fit_acceptance(hall_map, off(held_out, 0.02), noise=(0.02, 0.0))
    assert noisy.frame.frame_sigma == (0.0, 0.0)
    # A wrong pose is no scatter.
    some = [*off(held_out[:2], 0.9), *held_out[2:]]
    assert fit_acceptance(hall_map, some).frame.frame_sigma == (0.0, 0.0)


def test_scatter_restores_the_distribution() -> None:
    rng = np.random.default_rng(0)
    covariances = np.stack([np.diag(rng.uniform(0.5, 2, 3)) for _ in range(2000)])
    own = np.sqrt(np.einsum("nii->ni", covariances)) * rng.normal(size=(2000, 3))
    errors = own + 3 * rng.normal(size=(2000, 3))
    assert scatter(errors, covariances) == pytest.approx(3.0, rel=0.05)
    assert scatter(0.9 * own, covariances) == 0.0


def test_frames_far_from_keyframes_widen_the_stated_frame(
    hall: Recording, hall_map: MapContents
) -> None:
    shift = SE3.exp([0.02, 0, 0, 0, 0, 0])
    part = [
        replace(frame, base_from_camera=shift @ frame.base_from_camera)
        for frame in hall.test[:8]
        if frame.base_from_camera is not None
    ]
    count = len(hall_map.scenes[0].keyframes)
    left_out = [LeftOut(tuple(part), np.arange(count))]
    scene = fit_acceptance(hall_map, (), left_out=left_out)
    assert 0.005 < scene.frame.frame_sigma[0] < 0.015
    assert len(scene.keyframes) == count
    assert scene.min_support == MAX_SUPPORT
