"""Poses between known ones: a screw has a closed form; ends and gaps are not guessed at."""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation

from evercal.geometry import SE3, pose_distance
from evercal.recordings.poses.pose_track import PoseTrack


def turning(
    stamps: np.ndarray, axis: np.ndarray, rate: float, speed: np.ndarray
) -> SE3:
    """A frame that turns about a fixed axis and moves on a line, both at constant speed."""
    rotation = Rotation.from_rotvec(
        np.outer(stamps * rate, axis / np.linalg.norm(axis))
    )
    return SE3(rotation.as_quat(scalar_first=True), np.outer(stamps, speed))


@given(
    st.lists(st.floats(-3, 3), min_size=3, max_size=3).filter(
        lambda a: np.linalg.norm(a) > 0.1
    ),
    st.floats(-6, 6),
    st.lists(st.floats(0, 1), min_size=1, max_size=8),
)
def test_steady_motion_is_interpolated_exactly(
    axis: list[float], rate: float, when: list[float]
) -> None:
    stamps = np.linspace(0, 1, 9)
    speed = np.array([0.3, -0.2, 0.1])
    shuffled = np.random.default_rng(0).permutation(len(stamps))
    track = PoseTrack(
        stamps[shuffled], turning(stamps, np.array(axis), rate, speed)[shuffled]
    )
    poses, valid = track.at(np.array(when))
    assert valid.all()
    expected = turning(np.array(when), np.array(axis), rate, speed)
    metres, radians = pose_distance(poses, expected)
    assert metres.max() < 1e-9
    assert radians.max() < 1e-7


def test_times_beyond_the_ends_are_invalid() -> None:
    track = PoseTrack(
        np.array([1.0, 1.1, 1.2]), SE3.exp(np.arange(18).reshape(3, 6) * 0.01)
    )
    _, valid = track.at(np.array([0.999, 1.0, 1.15, 1.2, 1.201]))
    assert valid.tolist() == [False, True, True, True, False]
    one = PoseTrack(np.array([2.0]), SE3.identity((1,)))
    assert one.at(np.array([1.9, 2.0, 2.1]))[1].tolist() == [False, True, False]


def test_gaps_are_invalid_only_with_motion() -> None:
    # Moves, stands still for five seconds, then is elsewhere after another five.
    poses = SE3.exp([[0, 0, 0, 0, 0, 0], [0.1, 0, 0, 0, 0, 0], [0.1, 0, 0, 0, 0, 0],
                     [0.3, 0, 0, 0, 0, 0.5]])  # fmt: skip
    track = PoseTrack(np.array([0.0, 0.1, 5.1, 10.1]), poses)
    poses_at, valid = track.at(np.array([0.05, 2.0, 5.1, 7.0, 10.1]))
    assert valid.tolist() == [True, True, True, False, True]
    np.testing.assert_allclose(poses_at.translation_m[:3, 0], [0.05, 0.1, 0.1])


def test_last_of_two_poses_at_one_time_is_used() -> None:
    track = PoseTrack(np.array([0.0, 1.0, 1.0]), SE3.exp(np.eye(6)[:3]))
    poses, valid = track.at(np.array([1.0]))
    assert valid.all()
    np.testing.assert_allclose(poses.translation_m, [[0, 0, 1]])


def test_empty_track_is_refused() -> None:
    with pytest.raises(ValueError, match="n >= 1"):
        PoseTrack(np.empty(0), SE3.identity((0,)))
