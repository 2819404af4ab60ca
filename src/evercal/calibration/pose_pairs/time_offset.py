"""Joint estimation of the calibration and the time offset between robot and camera clocks.

A camera fixed to the gripper rotates by the same angle as the gripper. For a grid of offsets, the
angles between successive images are compared with the robot's angles. The best offset is then
refined together with the transforms.
"""

from dataclasses import replace

import numpy as np

from evercal.calibration.calibration import Calibration
from evercal.calibration.pose_pairs.pairs import BoardCorners, PosePairs
from evercal.calibration.pose_pairs.readings import steps_rad
from evercal.calibration.pose_pairs.solve import solve_pose_pairs
from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.pose_track import PoseTrack
from evercal.robot.mount import MountName
from evercal.typing import Array, BoolArray, Strings

_STEP_S = 0.01
"""Step of the grid of offsets."""
_MAX_SIGMA_S = 0.05
"""Maximum standard deviation of the offset."""
_HALF_S = 0.005
"""Half of the interval over which the robot's velocity is computed."""
_MAX_ROUNDS = 6
"""Maximum number of fits, each with the robot poses at the offset of the last one."""
_CONVERGED_S = 1e-4
"""Change of the offset that ends them."""
_MAX_CHANGE_S = 0.02
"""Maximum change of the offset in the last of them."""


@frozen_arrays
class CameraTrack:
    """Board poses of images with time stamps."""

    names: Strings
    stamps_s: Array
    """(n,) seconds of the camera clock."""
    camera_from_board: SE3
    """(n,)."""
    corners: BoardCorners | None = None
    """Corners of the images, in the same order."""

    def __getitem__(self, index: BoolArray) -> "CameraTrack":
        rows = np.flatnonzero(index)
        corners = self.corners
        if corners:
            corners = replace(corners, views=tuple(corners.views[row] for row in rows))
        names = tuple(self.names[row] for row in rows)
        return CameraTrack(
            names, self.stamps_s[rows], self.camera_from_board[rows], corners
        )


def solve_with_offset(
    robot: PoseTrack,
    camera: CameraTrack,
    mount: MountName,
    scale_known: bool = True,
    largest_s: float = 1.0,
) -> Calibration:
    """Run `solve` for two streams whose clocks differ by a constant offset.

    Args:
        robot: base_from_gripper over time, dense enough for interpolation.
        camera: Board poses over time; some images must show the robot in motion.
        mount: See `solve`.
        scale_known: See `solve`.
        largest_s: Maximum offset.

    Returns:
        Calibration whose checks hold `time_offset_s`, to add to the stamp of an image, and its
        standard deviation `time_offset_sigma_s`.
    """
    offset = _coarse_offset(robot, camera, largest_s)
    rounds = 0
    while True:
        pairs, overlapping = _pairs_at(robot, camera, offset)
        solution = solve_pose_pairs(pairs, mount, scale_known, overlapping.corners)
        change = float(solution.fit.at.extras[-1])
        sigma = float(solution.fit.sigma[-1])
        offset += float(np.clip(change, -largest_s, largest_s))
        rounds += 1
        if abs(change) < _CONVERGED_S or rounds == _MAX_ROUNDS:
            break
    if not sigma < _MAX_SIGMA_S or abs(change) > _MAX_CHANGE_S:
        raise InputError(
            f"the time offset is not determined (standard deviation {1000 * sigma:.0f} ms): too few"
            f" images show the robot in motion; move it while recording, or pair images and poses"
            f" of a still robot and omit `time_offset`"
        )
    return solution.calibration(offset)


def interpolated_pairs(
    robot: PoseTrack, camera: CameraTrack
) -> tuple[PosePairs, CameraTrack]:
    """Interpolate robot poses at image times; return the images within the track, too."""
    pairs, overlapping = _pairs_at(robot, camera, 0.0)
    return replace(pairs, velocity=None), overlapping


def _pairs_at(
    robot: PoseTrack, camera: CameraTrack, offset: float
) -> tuple[PosePairs, CameraTrack]:
    """Return the pairs within the robot's track, with velocities."""
    times = np.asarray(camera.stamps_s + offset, float)
    poses, inside = robot.at(times)
    begin = robot.stamps_s[0]
    end = robot.stamps_s[-1]
    if not inside.any():
        raise InputError(
            f"no image was taken while robot poses were recorded: images at {times.min():.3f} to"
            f" {times.max():.3f} s, robot poses at {begin:.3f} to"
            f" {end:.3f} s; check that both use the same clock"
        )
    overlapping = camera[inside]
    times = times[inside]
    before, _ = robot.at(times - _HALF_S)
    after, _ = robot.at(times + _HALF_S)
    # At the ends of the track the interval is shorter.
    duration = np.minimum(times + _HALF_S, end) - np.maximum(times - _HALF_S, begin)
    linear = after.translation_m - before.translation_m
    angular = (after @ before.inverse()).log()[:, 3:]
    moved = np.concatenate([linear, angular], 1)
    pairs = PosePairs(
        names=overlapping.names,
        base_from_gripper=poses[inside],
        camera_from_board=overlapping.camera_from_board,
        velocity=moved / np.maximum(duration, 1e-9)[:, None],
    )
    return pairs, overlapping


def _coarse_offset(
    robot: PoseTrack,
    camera: CameraTrack,
    largest_s: float,
) -> float:
    """Return the offset on a grid at which robot and camera rotate by the same angles."""
    order = np.argsort(camera.stamps_s)
    stamps = np.asarray(camera.stamps_s[order], float)
    angles = steps_rad(camera.camera_from_board[order])
    best = (np.inf, 0.0)
    for offset in np.arange(
        -largest_s,
        largest_s + _STEP_S / 2,
        _STEP_S,
    ):
        poses, inside = robot.at(stamps + offset)
        overlapping = inside[:-1] & inside[1:]
        if overlapping.sum() < max(3, 0.5 * len(overlapping)):
            continue
        # An outlier spoils two angles, so the worst quarter is ignored.
        error = np.sort(np.abs(steps_rad(poses) - angles)[overlapping])
        cost = float(error[: max(3, (3 * len(error)) // 4)].mean())
        best = min(best, (cost, float(offset)))
    if not np.isfinite(best[0]):
        raise InputError(
            f"images and robot poses hardly overlap in time: images at {stamps[0]:.3f} to"
            f" {stamps[-1]:.3f} s, robot poses at {robot.stamps_s[0]:.3f} to"
            f" {robot.stamps_s[-1]:.3f} s; check that both use the same clock"
        )
    return best[1]
