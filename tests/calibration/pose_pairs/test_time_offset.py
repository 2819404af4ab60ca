"""Streams of robot and camera with clocks of their own."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.hand_eye import Setting, error, pose, shaken
from evercal.calibration.calibration import Mount
from evercal.calibration.pose_pairs.time_offset import (
    CameraTrack,
    interpolated_pairs,
    solve_with_offset,
)
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.pose_track import PoseTrack

X = SE3.exp([0.05, -0.03, 0.1, 0.2, 1.0, -0.4])
Z = SE3.exp([0.4, 0.2, 0.0, 1.5, 0.3, 0.2])


def robot_at(times: np.ndarray, speed: float = 1.0) -> SE3:
    """A gripper that sways about all axes."""
    rates = speed * np.array([0.9, 1.3, 1.1, 1.7, 1.2, 0.8])
    sway = np.sin(np.outer(times, rates) + np.arange(6)) * [0.2, 0.2, 0.1, 0.5, 0.5, 0.5]
    turn = Rotation.from_rotvec(sway[:, 3:]) * Rotation.from_euler("x", 3.0)
    return pose(turn, sway[:, :3] + np.array([0.5, 0.0, 0.5]))


def streams(
    mount: Mount, offset: float, noise: float, seed: int = 0
) -> tuple[PoseTrack, CameraTrack]:
    rng = np.random.default_rng(seed)
    stamps = np.arange(0, 25, 0.01)
    track = PoseTrack(stamps, robot_at(stamps))
    times = np.sort(rng.uniform(1.5, 23, 50))
    truth = robot_at(times + offset)
    fixed_from_parent = truth if mount == "eye_in_hand" else truth.inverse()
    seen = (fixed_from_parent @ X).inverse() @ Z
    seen = shaken(seen, Setting(noise_mm=noise, noise_deg=0.1 * noise), rng)
    return track, CameraTrack(tuple(f"{i}" for i in range(50)), times, seen)


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
@pytest.mark.parametrize("offset", [0.0, 0.237, -0.6])
def test_the_offset_is_found_with_the_transform(mount: Mount, offset: float) -> None:
    found = solve_with_offset(*streams(mount, offset, 1.0), mount)
    sigma = found.checks["time_offset_sigma_s"]
    assert sigma < 0.002
    assert found.checks["time_offset_s"] == pytest.approx(offset, abs=4 * sigma)
    off = error(found.parent_from_child, X)
    assert np.linalg.norm(off[:3]) < 0.002
    assert off @ np.linalg.solve(found.covariance, off) < 25


def test_exact_streams_give_the_exact_offset() -> None:
    found = solve_with_offset(*streams("eye_in_hand", 0.1234, 0.0), "eye_in_hand")
    assert found.checks["time_offset_s"] == pytest.approx(0.1234, abs=1e-4)
    assert np.linalg.norm(error(found.parent_from_child, X)[:3]) < 1e-4


def test_without_it_the_answer_is_worse() -> None:
    track, camera = streams("eye_in_hand", 0.05, 1.0)
    from evercal.calibration.pose_pairs.solve import solve

    pairs, seen = interpolated_pairs(track, camera)
    assert seen.names == pairs.names
    plain = np.linalg.norm(error(solve(pairs, "eye_in_hand").parent_from_child, X)[:3])
    found = solve_with_offset(track, camera, "eye_in_hand")
    assert np.linalg.norm(error(found.parent_from_child, X)[:3]) < 0.5 * plain


def test_a_robot_that_stands_still_at_each_image_does_not_tell() -> None:
    # A second at each of twenty places; images in the middle of it.
    stamps = np.arange(0, 40, 0.01)
    holds = robot_at(np.floor(stamps / 2) * 2.0, 0.5)
    track = PoseTrack(stamps, holds)
    times = np.arange(1.0, 39.0, 2.0)
    truth, _ = track.at(times)
    camera = CameraTrack(tuple(map(str, times)), times, (truth @ X).inverse() @ Z)
    with pytest.raises(InputError, match="clocks' offset cannot be seen"):
        solve_with_offset(track, camera, "eye_in_hand", largest_s=0.3)


def test_streams_of_other_days_are_refused() -> None:
    track, camera = streams("eye_in_hand", 0.0, 1.0)
    late = replace(camera, stamps_s=camera.stamps_s + 1e6)
    with pytest.raises(InputError, match="hardly overlap in time"):
        solve_with_offset(track, late, "eye_in_hand")
    with pytest.raises(InputError, match="no image was taken while robot poses were recorded"):
        interpolated_pairs(track, late)
