"""A mapped thing that the gripper holds another way than when it was learned.

Images and gripper poses of several poses determine both where the camera is and how the thing is
held: the map is a board of known shape, so this is `solve` for pose pairs.
"""

from collections.abc import Sequence

import numpy as np

from evercal.calibration.located import ImagePose, poses_of
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.solution import PairSolution
from evercal.calibration.pose_pairs.solve import solve_pose_pairs
from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.geometry import SE3, length_mm_deg

LEAST_GRIPS = 5
"""Images that determine the camera and the grip; fewer show only that one of them moved."""
_SIGMAS = 5.0
"""A grip that differs by more standard deviations is another."""
_LEAST_MM = 1.0
"""Smaller changes of a grip, millimetres, do not count."""
_LEAST_DEG = 0.1
"""Smaller rotations of a grip, degrees, do not count."""


@frozen_arrays
class HeldAgain:
    """Camera and grip, from images of a thing that is held another way."""

    solution: PairSolution
    mm: float
    """Distance between the grips."""
    deg: float

    @property
    def sentence(self) -> str:
        """What is different."""
        return (
            f"The gripper holds the thing another way: {self.mm:.1f} mm and {self.deg:.2f} deg from"
            " where it was learned. The camera was estimated together with this change."
        )


def held_again(
    located: Sequence[ImagePose], base_from_gripper: SE3
) -> HeldAgain | None:
    """Solve for camera and grip from n images; None if the grip is that of the map.

    The poses `located` are in the frame of the map, and `base_from_gripper` is (n,).
    """
    rows = [i for i, item in enumerate(located) if item.is_located]
    if len(rows) < LEAST_GRIPS:
        return None
    items = [located[i] for i in rows]
    pairs = PosePairs(
        tuple(item.name for item in items),
        base_from_gripper[rows],
        poses_of(items).inverse(),
    )
    try:
        solution = solve_pose_pairs(pairs, "eye_to_hand", of_board=False)
    except InputError:
        return None
    change = solution.fixed_from_board
    covariance = solution.fit.covariance[6:12, 6:12]
    tangent = np.r_[change.translation_m, change.log()[3:]]
    mm, deg = length_mm_deg(tangent)
    sigmas = np.sqrt(tangent @ np.linalg.solve(covariance, tangent))
    another = sigmas > _SIGMAS and (mm > _LEAST_MM or deg > _LEAST_DEG)
    return HeldAgain(solution, mm, deg) if another else None
