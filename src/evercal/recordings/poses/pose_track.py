"""Poses at times, and between them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from evercal.geometry import SE3, pose_distance

Array = NDArray[np.float64]

MAX_GAP_S = 0.2
"""Longest time between two poses over which a moving frame is interpolated, seconds."""
STILL_M, STILL_DEG = 0.001, 0.1
"""A frame that is no farther from where it was has stood still over a gap, however long."""


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """A pose as it changes over time; what comes twice at one time counts once, the last of them.

    Raises:
        ValueError: No pose, or times that are not one for each pose.
    """

    stamps_s: Array
    """(n,) seconds, in any order."""
    poses: SE3
    """(n,)."""

    def __post_init__(self) -> None:
        stamps = np.asarray(self.stamps_s, dtype=np.float64)
        if stamps.ndim != 1 or not stamps.size or stamps.shape != self.poses.shape:
            raise ValueError(f"a track takes n >= 1 times and poses, got {stamps.shape}")
        # The last of equal times: unique keeps the first, so it looks from the end.
        _, last = np.unique(stamps[::-1], return_index=True)
        order = len(stamps) - 1 - last
        object.__setattr__(self, "stamps_s", stamps[order])
        object.__setattr__(self, "poses", self.poses[order])

    def at(self, stamps_s: Array, max_gap_s: float = MAX_GAP_S) -> tuple[SE3, NDArray[np.bool_]]:
        """Poses between the known ones: positions on a line, rotations on a great circle.

        Args:
            stamps_s: (m,) seconds.
            max_gap_s: longest gap in the track that a moving frame is interpolated over.

        Returns:
            (m,) poses and (m,) whether each is known. Beyond the ends none is, the nearest one
            stands there; nor is any in a long gap over which the frame moved.
        """
        stamps = np.asarray(stamps_s, dtype=np.float64)
        held = np.clip(stamps, self.stamps_s[0], self.stamps_s[-1])
        known = held == stamps
        if len(self.stamps_s) == 1:
            return self.poses[np.zeros(len(stamps), dtype=int)], known
        after = np.searchsorted(self.stamps_s, held).clip(1, len(self.stamps_s) - 1)
        before = after - 1
        metres, radians = pose_distance(self.poses[before], self.poses[after])
        still = (metres < STILL_M) & (np.rad2deg(radians) < STILL_DEG)
        short = self.stamps_s[after] - self.stamps_s[before] <= max_gap_s
        exact = (held == self.stamps_s[before]) | (held == self.stamps_s[after])
        rotations = Rotation.from_quat(self.poses.rotation_wxyz, scalar_first=True)
        moved = [np.interp(held, self.stamps_s, axis) for axis in self.poses.translation_m.T]
        quaternion = Slerp(self.stamps_s, rotations)(held).as_quat(scalar_first=True)
        return SE3(quaternion, np.stack(moved, axis=-1)), known & (short | still | exact)
