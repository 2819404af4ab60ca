"""A correct recording gives no warning, and planted faults are reported."""

import numpy as np
import pytest

from evercal.geometry import SE3, Camera
from evercal.recordings import Frame, Recording
from evercal.recordings.inspection import inspect_recording
from evercal.simulation.box_room import BoxRoom, look_at

LENS = Camera(32, 24, 26, 26, 15.5, 11.5)
PICTURES = np.random.default_rng(0).integers(0, 255, (7, 24, 32, 3), np.uint8)


def recording_of(
    train: SE3, test: SE3, camera: Camera = LENS, untracked: int = 0
) -> Recording:
    def frames(poses: SE3, split: str) -> tuple[Frame, ...]:
        named = enumerate(poses)
        return tuple(Frame(f"{split}{i}", PICTURES[i % 7], camera, p) for i, p in named)

    return Recording("planted", frames(train, "a"), frames(test, "b"), untracked)


def warned(recording: Recording) -> str:
    return "\n".join(inspect_recording(recording).warnings)


ROOM = BoxRoom(41, furniture=0, texture_px=16)
TRAIN = ROOM.path(200, 1)
TEST = ROOM.path(40, 2)


def test_summary_of_a_straight_path() -> None:
    x = np.linspace(0, 1.9, 20)
    path = SE3.stack([look_at(np.array([v, 0, 1]), np.array([v, 5, 1.5])) for v in x])
    inspection = inspect_recording(recording_of(path, path[::4], untracked=3))
    np.testing.assert_allclose(inspection.extent_m, (1.9, 0, 0), atol=1e-12)
    assert inspection.step_median_m == pytest.approx(0.1)
    assert inspection.step_largest_m == pytest.approx(0.1)
    assert inspection.near_training == 100
    assert inspection.untracked == 3


def test_planted_faults_are_reported() -> None:
    assert warned(recording_of(TRAIN, TEST)) == ""
    rotations = TRAIN.rotation_wxyz
    translations = TRAIN.translation_m
    for train, message in (
        (SE3(rotations, np.zeros((200, 3))), "stand at one point"),
        (SE3(np.tile(rotations[0], (200, 1)), translations), "look the same way"),
        (SE3(rotations, 1000 * translations), "millimetres"),
        (SE3(rotations, 0.001 * translations), "in metres"),
        (TRAIN[np.random.default_rng(0).permutation(200)], "in order and in metres"),
        (TRAIN[:5], "8 or more"),
    ):
        assert message in warned(recording_of(train, TEST))
    assert "test frames have the pose" in warned(recording_of(TRAIN, TRAIN[:40]))
    assert "have no pose" in warned(recording_of(TRAIN, TEST, untracked=300))
    assert "nothing to measure" in warned(recording_of(TRAIN, TEST[:0]))
    for lens, message in (
        ((26, 26, 25, 11), "far from the middle"),
        ((525, 525, 15.5, 11.5), "sees"),
        ((26, 40, 15.5, 11.5), "squeezed from 2.05:1 to 1.33:1; if yours were cut out"),
    ):
        assert message in warned(recording_of(TRAIN, TEST, Camera(32, 24, *lens)))
