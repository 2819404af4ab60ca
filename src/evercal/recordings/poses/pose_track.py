"""Poses over time, with interpolation."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Slerp

from evercal.geometry import SE3, pose_distance
from evercal.typing import Array, BoolArray

MAX_GAP_S = 0.2  # longest time between two poses over which a moving frame is interpolated, seconds
STILL_M, STILL_DEG = 0.001, 0.1
"""Motion below which a frame counts as standing still over a gap of any length."""


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """A pose over time; of several poses at one time, the last is kept."""

    stamps_s: Array
    """(n,) seconds, in any order."""
    poses: SE3
    """(n,) poses at these times."""

    def __post_init__(self) -> None:
        stamps = np.asarray(self.stamps_s, dtype=np.float64)
        if stamps.ndim != 1 or not stamps.size or stamps.shape != self.poses.shape:
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
        stamps = np.asarray(stamps_s, dtype=np.float64)
        inside = np.clip(stamps, self.stamps_s[0], self.stamps_s[-1])
        valid = inside == stamps
        if len(self.stamps_s) == 1:
            return self.poses[np.zeros(len(stamps), dtype=int)], valid
        after, close = times_around(self.stamps_s, inside)
        metres, radians = pose_distance(self.poses[after - 1], self.poses[after])
        still = (metres < STILL_M) & (np.rad2deg(radians) < STILL_DEG)
        position = [
            np.interp(inside, self.stamps_s, axis)
            for axis in self.poses.translation_m.T
        ]
        rotation = Slerp(self.stamps_s, self.poses.rotation)(inside)
        poses = SE3.of(rotation, np.stack(position, axis=-1), canonical=False)
        return poses, valid & (close | still)


def times_around(times_s: Array, stamps_s: Array) -> tuple[NDArray[np.intp], BoolArray]:
    """Index of the time after each stamp, and whether no long gap is around it."""
    after = np.searchsorted(times_s, stamps_s).clip(1, len(times_s) - 1)
    short = times_s[after] - times_s[after - 1] <= MAX_GAP_S
    exact = (stamps_s == times_s[after]) | (stamps_s == times_s[after - 1])
    return after, short | exact
