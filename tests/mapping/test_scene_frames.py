"""How an uncertain or moved base frame shows in the poses of cameras."""

import numpy as np
import pytest

from evercal.geometry import SE3, pose_distance
from evercal.mapping.scene_maps import Alignment, frame_moved_by_cameras, moved_by_frame

POSE = SE3.exp([0.4, -0.7, 1.1, 0.3, 0.9, -0.5])


def tangent(before: SE3, after: SE3) -> np.ndarray:
    """Translation in the base frame, rotation about camera axes."""
    turn = (before.inverse() @ after).log()[3:]
    return np.concatenate([after.translation_m - before.translation_m, turn])


@pytest.mark.parametrize("axis", range(6))
def test_a_motion_of_the_base_moves_cameras_as_differences_say(axis: int) -> None:
    step = np.zeros(6)
    step[axis] = 1e-6
    # The base turns about its own origin and then shifts.
    moved = SE3(SE3.exp(step).rotation_wxyz, step[:3]) @ POSE
    expected = tangent(POSE, moved) / 1e-6
    unit = np.zeros((6, 6))
    unit[axis, axis] = 1.0
    assert moved_by_frame(POSE, unit) == pytest.approx(np.outer(expected, expected), abs=1e-5)


@pytest.mark.parametrize("axis", range(6))
def test_a_motion_of_all_cameras_alike_is_the_motion_of_the_base_behind_it(axis: int) -> None:
    step = np.zeros(6)
    step[axis] = 1.0
    found = frame_moved_by_cameras(SE3.stack([POSE]), np.outer(step, step))
    # One camera: the base that moves it just so.
    back = moved_by_frame(POSE, found)
    assert back == pytest.approx(np.outer(step, step) if axis > 2 else _turned(step), abs=1e-9)


def _turned(step: np.ndarray) -> np.ndarray:
    """A shift along a camera axis is one along its direction in the base."""
    shift = POSE.rotation_matrix() @ step[:3]
    full = np.concatenate([shift, np.zeros(3)])
    return np.outer(full, full)


def test_an_aligned_map_keeps_what_cameras_see() -> None:
    place = Alignment(SE3.exp([1, 2, 3, 0.5, -0.5, 1.0]), 2.5)
    points = np.random.default_rng(0).normal(size=(20, 3))
    before = POSE.inverse().apply(points)
    after = place.pose(POSE).inverse().apply(place.points(points))
    assert after == pytest.approx(2.5 * before)
    assert max(pose_distance(Alignment(SE3.identity()).pose(POSE), POSE)) < 1e-12


def test_covariances_are_scaled_and_turned_with_the_map() -> None:
    place = Alignment(SE3.exp([0, 0, 0, 0, 0, np.pi / 2]), 2.0)
    covariance = np.diag([1.0, 4.0, 9.0, 0.1, 0.2, 0.3])
    expected = np.diag([16.0, 4.0, 36.0, 0.1, 0.2, 0.3])
    assert place.covariance(covariance) == pytest.approx(expected, abs=1e-9)
