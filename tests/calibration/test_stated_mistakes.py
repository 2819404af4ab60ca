"""Readings of a stated pose: what its numbers are by other conventions."""

import numpy as np
import pytest

from evercal.calibration.stated_mistakes import readings
from evercal.geometry import SE3, pose_distance_mm_deg
from evercal.recordings.poses.conventions import numbers_from_poses, pose_convention

POSE = SE3.exp([0.7, -0.4, 0.5, 1.1, -0.6, 2.0])


@pytest.mark.parametrize(
    ("stated", "written", "words"),
    [
        ("rpy", "rpy", ""),
        ("rpy", "rpy:inverse", "inverse"),
        ("rpy", "rpy:opengl", "opengl"),
        ("rpy", "rpy:mm", "other unit of length"),
        ("rpy", "rpy:deg", "other unit of angles"),
        ("rpy:deg", "rpy:rad", "other unit of angles"),
        ("rpy", "moving_xyz", "written as moving_xyz"),
        ("rpy", "ur", "written as ur"),
        ("kuka", "kuka:m", "other unit of length"),
        ("xyzw", "wxyz", "written as wxyz"),
        ("matrix:inverse", "matrix", "inverse"),
        ("matrix", "franka", "written as franka"),
    ],
)
def test_the_right_reading_is_found(stated: str, written: str, words: str) -> None:
    numbers = numbers_from_poses(POSE, pose_convention(written))
    found = readings(numbers.tolist(), pose_convention(stated))
    right = [
        mistake
        for mistake, pose in found.items()
        if np.allclose(pose_distance_mm_deg(pose, POSE), 0, atol=1e-6)
    ]
    assert right == [words]


def test_as_stated_comes_first() -> None:
    found = readings((0.7, -0.4, 0.5, 1.1, -0.6, 2.0), pose_convention("rpy"))
    assert next(iter(found)) == ""
    # As degrees these are no quaternion: the rest is read.
    assert not readings((0.7, -0.4, 0.5, 1.1, -0.6, 2.0, 1.0), pose_convention("xyzw"))
    assert readings((), pose_convention("rpy")) == {}
