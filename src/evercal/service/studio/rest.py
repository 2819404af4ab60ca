"""When the arm has come to rest at a new place."""

import numpy as np

from evercal.geometry import SE3, pose_distance
from evercal.live.coverage import CoverageOptions
from evercal.service.studio.book import SampleBook
from evercal.service.studio.devices import Seen

REST_S = 0.8
"""The arm is at rest when its pose has not changed for so long, seconds."""


class RestTrigger:
    """Fires once for each place where the arm comes to rest.

    Args:
        rest_s: how long the pose must not have changed, seconds.
    """

    def __init__(self, rest_s: float = REST_S):
        self._rest_s, self._fired = rest_s, 0.0

    def fires(self, seen: Seen, book: SampleBook) -> bool:
        """Whether a sample should be taken now; places that have a sample do not fire."""
        pose = seen.base_from_gripper
        if pose is None or not seen.complete or seen.still_s() < self._rest_s:
            return False
        if seen.still_since == self._fired:
            return False
        self._fired = seen.still_since
        return not _known(pose, book.poses)


def _known(pose: SE3, others: SE3) -> bool:
    options = CoverageOptions()
    if not len(others):
        return False
    metres, radians = pose_distance(pose, others)
    near = np.less(1000 * metres, options.same_mm) & np.less(np.rad2deg(radians), options.same_deg)
    return bool(np.any(near))
