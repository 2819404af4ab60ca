"""Recordings whose poses contradict the images are refused with their cause, and no others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.features.encoder import load_encoder
from evercal.geometry.se3 import SE3
from evercal.mapping.pose_check import MatchedPair, check_poses, matched_pairs
from evercal.mapping.pose_readings import require_consistent
from evercal.mapping.prepared_frames import PreparedFrames, WorkingSize
from evercal.recordings.frame import Recording

Matched = tuple[PreparedFrames, list[MatchedPair]]
Change = Callable[[SE3], SE3]


@pytest.fixture(scope="module")
def matched(hall: Recording) -> Matched:
    """The training frames of the hall, and their pairs."""
    recording = PreparedFrames(hall.train, load_encoder(), WorkingSize())
    return recording, matched_pairs(recording)


def check(matched: Matched, change: Change) -> None:
    """Require that changed poses are consistent."""
    recording, pairs = matched
    frames = []
    for frame, pose in zip(recording.frames, change(recording.stated), strict=True):
        frames.append(replace(frame, base_from_camera=pose))
    changed = recording.without(np.zeros(0, np.int64))
    changed.frames = tuple(frames)
    changed.adjust(changed.stated, None)
    require_consistent(changed, pairs, check_poses(changed, pairs))


def mirrored(poses: SE3) -> SE3:
    """As a left-handed program states them: y points to the other side."""
    w, x, y, z = poses.rotation_wxyz.T
    return SE3(np.stack([w, -x, y, -z], 1), poses.translation_m * [1, -1, 1])


def later(poses: SE3) -> SE3:
    """Each image has the pose of three images before."""
    return poses[np.maximum(np.arange(len(poses)) - 3, 0)]


def jumped(share: float) -> Change:
    """So many poses are off by 0.3 m and 17 deg."""

    def change(poses: SE3) -> SE3:
        rng = np.random.default_rng(0)
        moved = rng.permutation(len(poses)) < share * len(poses)
        error = rng.choice([-1, 1], (len(poses), 6)) * ([0.17] * 6)
        return poses @ SE3.exp(error * moved[:, None])

    return change


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (SE3.inverse, "if they are camera_from_base, the inverse"),
        (
            mirrored,
            "if they are left-handed with y mirrored, or the images are mirrored",
        ),
        (later, r"if they are those of image i\+3 for image i"),
        (
            lambda p: SE3(np.roll(p.rotation_wxyz, 1, 1), p.translation_m),
            "with quaternions in the order w, x, y, z",
        ),
        (jumped(0.5), "of 30 stated camera poses contradict the images"),
    ],
)
def test_contradicting_poses_are_refused_with_their_cause(
    matched: Matched, change: Change, cause: str
) -> None:
    with pytest.raises(InputError, match=cause):
        check(matched, change)


@pytest.mark.parametrize("change", [lambda p: p, jumped(0.1)])
def test_a_few_wrong_poses_are_left_out_and_not_refused(
    matched: Matched, change: Change
) -> None:
    check(matched, change)
