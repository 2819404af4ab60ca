"""Poses over time, with interpolation."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Slerp

from evercal.classes import frozen_arrays
from evercal.geometry import SE3, pose_distance
from evercal.typing import Array, BoolArray

MAX_GAP_S = 0.2
"""Longest time between two poses over which a moving frame is interpolated, seconds."""
STILL_M = 0.001
"""Motion over a gap of any length below which a frame stands still, metres."""
STILL_DEG = 0.1
"""The same for rotations, degrees."""


@frozen_arrays
class PoseTrack:
    """A pose over time; of several poses at one time, the last is kept."""

    stamps_s: Array
    """(n,) seconds, in any order."""
    poses: SE3
    """(n,) poses at these times."""

    def __post_init__(self) -> None:
        stamps = np.asarray(self.stamps_s, float)
        if not stamps.size or stamps.shape != self.poses.shape:
            raise ValueError(
                f"a track takes n >= 1 times and poses, got {stamps.shape}"
            )
        # np.unique keeps the first of equal times, so the order is reversed.
        _, last = np.unique(stamps[::-1], return_index=True)
        order = len(stamps) - 1 - last
        object.__setattr__(self, "stamps_s", stamps[order])
        object.__setattr__(self, "poses", self.poses[order])

    def at(self, stamps_s: Array) -> tuple[SE3, BoolArray]:
        """Interpolate positions linearly and rotations along great circles at (m,) seconds.

        Returns:
            (m,) poses and (m,) whether each is valid. Poses are invalid beyond the ends, and in
            a gap of more than `MAX_GAP_S` seconds over which the frame moved.
        """
        times = self.stamps_s
        stamps = np.asarray(stamps_s, float)
        inside = np.clip(stamps, times[0], times[-1])
        valid = inside == stamps
        if len(times) == 1:
            return self.poses[np.zeros(len(stamps), int)], valid
        after, close = times_around(times, inside)
        first = self.poses[after - 1]
        second = self.poses[after]
        metres, radians = pose_distance(first, second)
        still = (metres < STILL_M) & (np.rad2deg(radians) < STILL_DEG)
        valid &= close | still
        rotation = Slerp(times, self.poses.rotation)(inside)
        axes = self.poses.translation_m.T
        position = np.stack([np.interp(inside, times, axis) for axis in axes], 1)
        poses = SE3.of(rotation, position, canonical=False)
        return poses, valid


def times_around(times_s: Array, stamps_s: Array) -> tuple[NDArray[np.intp], BoolArray]:
    """Index of the time after each stamp, and whether no long gap is around it."""
    after = np.searchsorted(times_s, stamps_s).clip(1, len(times_s) - 1)
    end = times_s[after]
    start = times_s[after - 1]
    exact = (stamps_s == start) | (stamps_s == end)
    return after, exact | (end - start <= MAX_GAP_S)
