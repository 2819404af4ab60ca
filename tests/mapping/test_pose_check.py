"""Stated poses that contradict the images are detected, and no others."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from evercal.features.encoder import load_encoder
from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.mapping.pose_check import (
    STRIDE,
    MatchedPair,
    _matched,
    _segment_distance,
    check_poses,
    depth_scale,
    matched_pairs,
)
from evercal.mapping.prepared_frames import PreparedFrames, WorkingSize
from evercal.recordings.frame import Recording


@pytest.fixture(scope="module")
def recording(hall: Recording) -> PreparedFrames:
    """Every second training frame of the hall."""
    return PreparedFrames(hall.train[::2], load_encoder(), WorkingSize())


def moved(recording: PreparedFrames, changes: dict[int, SE3]) -> PreparedFrames:
    """The same images with other stated poses."""
    changed = recording.without(np.zeros(0, np.int64))
    poses = [recording.poses[i] for i in range(len(recording))]
    for i, change in changes.items():
        poses[i] = poses[i] @ change
    changed.adjust(SE3.stack(poses), None)
    return changed


def detected(recording: PreparedFrames) -> list[int]:
    pairs = matched_pairs(recording)
    check = check_poses(recording, pairs)
    assert len(check.untracked) == 0
    return check.wrong.tolist()


def test_right_poses_are_consistent(recording: PreparedFrames) -> None:
    assert detected(recording) == []


# At the end of the walk, a step along it keeps all matches on their segments.
@pytest.mark.parametrize(
    ("frame", "direction"),
    [(0, (0, 1, 0)), (6, (0, 1, 0)), (14, (0, 1, 0)), (6, (1, 0, 0))],
)
def test_one_frame_30_cm_away_is_detected(
    frame: int, direction: tuple[float, ...], recording: PreparedFrames
) -> None:
    shift = SE3.exp(np.array([*(0.3 * np.array(direction)), 0, 0, 0]))
    assert detected(moved(recording, {frame: shift})) == [frame]


def test_shifted_and_rotated_frames_are_detected(recording: PreparedFrames) -> None:
    up = SE3.exp(np.array([0, 0.3, 0, 0, 0, 0]))
    rotated = SE3.exp(np.array([0, 0, 0, 0, 0.2, 0]))
    assert detected(moved(recording, {3: up, 10: rotated})) == [3, 10]


@pytest.mark.parametrize("scale", [0.1, 8.0])
def test_depth_scale_is_that_of_the_recording(
    scale: float, recording: PreparedFrames
) -> None:
    pairs = matched_pairs(recording)
    scaled = moved(recording, {})
    assert depth_scale(recording, pairs) == 1  # as a room is
    poses = recording.poses
    scaled.adjust(SE3(poses.rotation_wxyz, scale * poses.translation_m), None)
    scaled.depth_scale = depth_scale(scaled, pairs)
    assert 0.3 * scale < scaled.depth_scale < 3 * scale
    assert check_poses(scaled, pairs).excluded.tolist() == []


def test_small_pose_errors_are_accepted(recording: PreparedFrames) -> None:
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(len(recording), 6)) * ([0.005] * 3 + [0.004] * 3)
    assert (
        detected(moved(recording, {i: SE3.exp(n) for i, n in enumerate(noise)})) == []
    )


def test_excluding_frames_does_not_change_the_others(
    recording: PreparedFrames,
) -> None:
    rest = recording.without(np.array([0, 5]))
    keep = [i for i in range(len(recording)) if i not in (0, 5)]
    assert [f.name for f in rest.frames] == [recording.frames[i].name for i in keep]
    for new, old in enumerate(keep):
        np.testing.assert_array_equal(rest.grey[new], recording.grey[old])
        np.testing.assert_allclose(
            rest.poses[new].matrix(), recording.poses[old].matrix()
        )
        np.testing.assert_array_equal(rest.features(new), recording.features(old))
    rotation, translation = rest.relative(1, 0)
    one = rest.poses[1]
    two = rest.poses[0]
    np.testing.assert_allclose(
        rotation, (one.inverse() @ two).rotation_matrix(), atol=1e-12
    )
    np.testing.assert_allclose(
        translation, (one.inverse() @ two).translation_m, atol=1e-12
    )
    assert rest.cameras == [recording.cameras[i] for i in keep]


def test_distances_from_segments() -> None:
    start = np.array([[0.0, 0], [0, 0], [0, 0], [1, 1]])
    end = np.array([[4.0, 0]] * 3 + [[1, 1]])
    points = np.array([[2.0, 3], [-3, 4], [7, -4], [4, 5]])
    np.testing.assert_allclose(
        _segment_distance(points, start, end), [3, 5, 5, 5], atol=1e-6
    )


def test_cells_with_a_similar_cell_elsewhere_are_not_distinct() -> None:
    camera = Camera(96, 8, 50, 50, 47.5, 3.5)
    similar = np.full((12, 12), 0.2)
    similar[0, 1] = 0.9
    similar[STRIDE, [3, 4]] = 0.9, 0.89  # the neighbour shows the same place
    similar[2 * STRIDE, [6, 11]] = 0.9, 0.89
    similar[3 * STRIDE, 9] = 0.5
    features = [similar, np.eye(12)]
    recording = SimpleNamespace(
        features=features.__getitem__,
        encoder=SimpleNamespace(stride=8),
        cell_camera=lambda _: camera,
    )
    pair = _matched(recording, 0, 1)  # type: ignore[arg-type]
    assert pair.pixels.tolist() == [[11.5, 3.5], [27.5, 3.5]]
    np.testing.assert_allclose(camera.project(pair.ray), [[3.5, 3.5], [27.5, 3.5]])


def test_sift_clears_frames_that_the_encoder_suspects(
    recording: PreparedFrames, monkeypatch: pytest.MonkeyPatch
) -> None:
    def suspicious(frames: PreparedFrames) -> list[MatchedPair]:
        pairs = matched_pairs(frames)
        shift = np.array([60.0, 0.0])  # the encoder mistakes one square for another
        return [
            replace(p, pixels=p.pixels + shift) if 6 in (p.first, p.second) else p
            for p in pairs
        ]

    assert check_poses(recording, suspicious(recording)).excluded.tolist() == []
    far = moved(recording, {6: SE3.exp(np.array([0, 0.3, 0, 0, 0, 0]))})
    assert check_poses(far, suspicious(far)).wrong.tolist() == [6]
    monkeypatch.setattr("evercal.mapping.pose_check.epipolar_rays", lambda *_: None)
    check = check_poses(recording, suspicious(recording))
    assert (check.wrong.tolist(), check.untracked.tolist()) == ([], [6])
    confirmed = {recording.frames[6].name}
    assert not check_poses(recording, suspicious(recording), confirmed).excluded.size
