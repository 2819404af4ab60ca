"""Calibration of streams with separate clocks for robot and camera."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.hand_eye import Setting, error, pose, shaken
from evercal.calibration.pose_pairs.time_offset import (
    CameraTrack,
    interpolated_pairs,
    solve_with_offset,
)
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.pose_track import PoseTrack
from evercal.robot.mount import MountName

X = SE3.exp([0.05, -0.03, 0.1, 0.2, 1.0, -0.4])
Z = SE3.exp([0.4, 0.2, 0.0, 1.5, 0.3, 0.2])


def robot_at(times: np.ndarray, speed: float = 1.0) -> SE3:
    """Return poses of a gripper that sways about all axes."""
    rates = speed * np.array([0.9, 1.3, 1.1, 1.7, 1.2, 0.8])
    sway = np.sin(np.outer(times, rates) + np.arange(6)) * [
        0.2,
        0.2,
        0.1,
        0.5,
        0.5,
        0.5,
    ]
    rotation = Rotation.from_rotvec(sway[:, 3:]) * Rotation.from_euler("x", 3.0)
    return pose(rotation, sway[:, :3] + np.array([0.5, 0.0, 0.5]))


def streams(
    mount: MountName, offset: float, noise: float
) -> tuple[PoseTrack, CameraTrack]:
    rng = np.random.default_rng(0)
    stamps = np.arange(0, 25, 0.01)
    times = np.sort(rng.uniform(1.5, 23, 50))
    robot = robot_at(times + offset)
    fixed_from_parent = robot if mount == "eye_in_hand" else robot.inverse()
    board = (fixed_from_parent @ X).inverse() @ Z
    board = shaken(board, Setting(noise_mm=noise, noise_deg=0.1 * noise), rng)
    names = tuple(f"{i}" for i in range(50))
    return PoseTrack(stamps, robot_at(stamps)), CameraTrack(names, times, board)


@pytest.mark.parametrize(
    ("mount", "offset"), [("eye_in_hand", 0.237), ("eye_to_hand", -0.6)]
)
def test_offset_and_transform_are_estimated(mount: MountName, offset: float) -> None:
    calibration = solve_with_offset(*streams(mount, offset, 1.0), mount)
    sigma = calibration.checks.to_dict()["time_offset_sigma_s"]
    assert sigma < 0.002
    assert calibration.checks.to_dict()["time_offset_s"] == pytest.approx(
        offset, abs=4 * sigma
    )
    difference = error(calibration.parent_from_child, X)
    assert np.linalg.norm(difference[:3]) < 0.002
    assert difference @ np.linalg.solve(calibration.covariance, difference) < 25
    exact = solve_with_offset(*streams(mount, offset, 0.0), mount)
    assert exact.checks.to_dict()["time_offset_s"] == pytest.approx(offset, abs=1e-4)
    assert np.linalg.norm(error(exact.parent_from_child, X)[:3]) < 1e-4


def test_a_robot_that_stops_for_each_image_is_refused() -> None:
    # It rests at twenty poses; the images are taken in the middle of each rest.
    stamps = np.arange(0, 40, 0.01)
    track = PoseTrack(stamps, robot_at(np.floor(stamps / 2) * 2.0, 0.5))
    times = np.arange(1.0, 39.0, 2.0)
    robot, _ = track.at(times)
    camera = CameraTrack(tuple(map(str, times)), times, (robot @ X).inverse() @ Z)
    with pytest.raises(InputError, match="time offset is not determined"):
        solve_with_offset(track, camera, "eye_in_hand", largest_s=0.3)


def test_streams_without_common_time_are_refused() -> None:
    track, camera = streams("eye_in_hand", 0.0, 1.0)
    late = replace(camera, stamps_s=camera.stamps_s + 1e6)
    with pytest.raises(InputError, match="hardly overlap in time"):
        solve_with_offset(track, late, "eye_in_hand")
    with pytest.raises(
        InputError, match="no image was taken while robot poses were recorded"
    ):
        interpolated_pairs(track, late)
