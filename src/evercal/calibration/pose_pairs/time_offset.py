"""Robot and camera with clocks of their own: the offset between them, found with the transforms.

A camera that is fixed to the gripper turns by the angle that the gripper turns by. Whatever the
transforms are, the angles between successive images and those of the robot between the same times,
shifted, agree best at the true offset. From there it is refined together with everything else.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.calibration import Calibration, Mount
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.solve import BoardCorners, SolveOptions, solve
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.pose_track import PoseTrack

Array = NDArray[np.floating]

_STEP_S = 0.01
_SURE_S = 0.05
"""Seconds that the offset must be sure to."""
_HALF_S = 0.005
"""Seconds before and after an image from which the robot's velocity is taken."""


@dataclass(frozen=True, eq=False)
class CameraTrack:
    """Poses of a board in images with times."""

    names: tuple[str, ...]
    """Of the images."""
    stamps_s: Array
    """(n,) seconds by the camera's clock."""
    camera_from_board: SE3
    """(n,)."""
    corners: BoardCorners | None = None
    """Behind the poses, in their order."""

    def __getitem__(self, index: NDArray[np.bool_]) -> "CameraTrack":
        """Some of the images."""
        rows = np.flatnonzero(index)
        corners = self.corners
        if corners is not None:
            corners = replace(corners, views=tuple(corners.views[row] for row in rows))
        names = tuple(self.names[row] for row in rows)
        return CameraTrack(names, self.stamps_s[rows], self.camera_from_board[rows], corners)


def solve_with_offset(
    robot: PoseTrack,
    camera: CameraTrack,
    mount: Mount,
    scale_known: bool = True,
    largest_s: float = 1.0,
) -> Calibration:
    """`solve` for streams whose clocks differ by a constant.

    Args:
        robot: base_from_gripper over time, dense enough to be interpolated.
        camera: poses of the board over time; some images while the robot moves.
        mount: as for `solve`.
        scale_known: as for `solve`.
        largest_s: the clocks differ by at most this much.

    Returns:
        As `solve`; `time_offset_s` in its checks is what to add to a time of the camera to get the
        robot's time, `time_offset_sigma_s` its standard deviation.

    Raises:
        InputError: as `solve`; or the streams do not overlap, or nothing moved that could show the
            offset.
    """
    offset = _by_angles(robot, camera, largest_s)
    found, corrected = None, 0.0
    for _ in range(6):
        pairs, seen = _pairs_at(robot, camera, offset)
        found = solve(pairs, mount, scale_known, seen.corners, SolveOptions())
        corrected = float(found.checks["time_offset_s"])
        if abs(corrected) < 1e-4:
            break
        offset += float(np.clip(corrected, -largest_s, largest_s))
    assert found is not None
    sigma = float(found.checks["time_offset_sigma_s"])
    if not sigma < _SURE_S or abs(corrected) > 0.02:
        raise InputError(
            f"the clocks' offset cannot be seen (standard deviation {1000 * sigma:.0f} ms): too few"
            f" images were taken while the robot moved; move it while recording, or pair images and"
            f" poses while it stands still and leave --time-offset out"
        )
    return replace(found, checks={**found.checks, "time_offset_s": offset + corrected})


def interpolated_pairs(robot: PoseTrack, camera: CameraTrack) -> tuple[PosePairs, CameraTrack]:
    """Pairs at the times of the images, clocks taken as one.

    Returns:
        The pairs, and the images whose robot pose is known.

    Raises:
        InputError: No image was taken while poses were recorded.
    """
    pairs, seen = _pairs_at(robot, camera, 0.0)
    return replace(pairs, velocity=None), seen


def _pairs_at(
    robot: PoseTrack, camera: CameraTrack, offset: float
) -> tuple[PosePairs, CameraTrack]:
    """Pairs of the images that lie inside the robot's stream, with the robot's velocity."""
    times = camera.stamps_s + offset
    poses, known = robot.at(np.asarray(times, dtype=np.float64))
    if not known.any():
        raise InputError(
            f"no image was taken while robot poses were recorded: images at {times.min():.3f} to"
            f" {times.max():.3f} s, robot poses at {robot.stamps_s[0]:.3f} to"
            f" {robot.stamps_s[-1]:.3f} s; are the clocks the same?"
        )
    seen, poses, times = camera[known], poses[known], np.asarray(times[known], dtype=np.float64)
    before, after = (robot.at(times + side * _HALF_S)[0] for side in (-1, 1))
    # At the ends of the stream a neighbour is the end itself.
    span = np.clip(times + _HALF_S, None, robot.stamps_s[-1]) - np.clip(
        times - _HALF_S, robot.stamps_s[0], None
    )
    turn = SE3(before.rotation_wxyz, np.zeros_like(before.translation_m)).inverse()
    spin = (SE3(after.rotation_wxyz, np.zeros_like(after.translation_m)) @ turn).log()[:, 3:]
    shift = after.translation_m - before.translation_m
    velocity = np.concatenate([shift, spin], 1) / np.maximum(span, 1e-9)[:, None]
    pairs = PosePairs(seen.names, poses, seen.camera_from_board, velocity=velocity)
    return pairs, seen


def _by_angles(robot: PoseTrack, camera: CameraTrack, largest_s: float) -> float:
    """The offset at which robot and camera turn alike from image to image, on a grid."""
    order = np.argsort(camera.stamps_s)
    stamps = np.asarray(camera.stamps_s[order], dtype=np.float64)
    seen = camera.camera_from_board[order]
    angles = _angles(seen)
    best = (np.inf, 0.0)
    for offset in np.arange(-largest_s, largest_s + _STEP_S / 2, _STEP_S):
        poses, known = robot.at(stamps + offset)
        both = known[:-1] & known[1:]
        if both.sum() < max(3, 0.5 * len(both)):
            continue
        # The better half: outliers spoil two angles each.
        error = np.sort(np.abs(_angles(poses) - angles)[both])
        cost = float(error[: max(3, (3 * len(error)) // 4)].mean())
        best = min(best, (cost, float(offset)))
    if not np.isfinite(best[0]):
        raise InputError(
            f"images and robot poses hardly overlap in time: images at {stamps[0]:.3f} to"
            f" {stamps[-1]:.3f} s, robot poses at {robot.stamps_s[0]:.3f} to"
            f" {robot.stamps_s[-1]:.3f} s; are the clocks the same?"
        )
    return best[1]


def _angles(poses: SE3) -> Array:
    """(n - 1,) radians between successive poses."""
    q = poses.rotation_wxyz
    return 2 * np.arccos(np.minimum(np.abs((q[:-1] * q[1:]).sum(1)), 1.0))
