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
        ("rpy", "rpy", ()),
        ("rpy", "rpy:inverse", ("inverse",)),
        ("rpy", "rpy:opengl", ("opengl",)),
        ("rpy", "rpy:mm", ("other unit of length",)),
        ("rpy", "rpy:deg", ("other unit of angles",)),
        ("rpy:deg", "rpy:rad", ("other unit of angles",)),
        ("rpy", "moving_xyz", ("written as moving_xyz",)),
        ("rpy", "ur", ("written as ur",)),
        ("kuka", "kuka:m", ("other unit of length",)),
        ("xyzw", "wxyz", ("written as wxyz",)),
        ("matrix:inverse", "matrix", ("inverse",)),
        ("matrix", "franka", ("written as franka",)),
        ("rpy", "ur:mm:inverse", ("inverse", "written as ur", "other unit of length")),
    ],
)
def test_the_right_reading_is_found(
    stated: str, written: str, words: tuple[str, ...]
) -> None:
    numbers = numbers_from_poses(POSE, pose_convention(written))
    found = readings(numbers.tolist(), pose_convention(stated))
    right = [
        mistakes
        for mistakes, pose in found
        if np.allclose(pose_distance_mm_deg(pose, POSE), 0, atol=1e-6)
    ]
    assert right[0] == words
    # None comes to this pose with as few mistakes.
    assert [len(other) > len(words) for other in right[1:]] == [True] * len(right[1:])


def test_fewest_mistakes_come_first() -> None:
    found = readings((0.7, -0.4, 0.5, 1.1, -0.6, 2.0), pose_convention("rpy"))
    counts = [len(words) for words, _ in found]
    assert counts == sorted(counts)
    assert counts[0] == 0
    # As degrees these are no quaternion: the rest is read.
    assert not readings((0.7, -0.4, 0.5, 1.1, -0.6, 2.0, 1.0), pose_convention("xyzw"))
    assert readings((), pose_convention("rpy")) == []
