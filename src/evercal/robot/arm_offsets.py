"""`ArmOffsets`: estimated offsets of an arm's joints, and how they move the gripper."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np

from evercal.classes import frozen_arrays
from evercal.geometry import SE3
from evercal.robot.mount import Mount
from evercal.typing import Array, BoolArray

if TYPE_CHECKING:
    from evercal.robot.arm import Arm


class JointSlopes(NamedTuple):
    """How the k joints of an arm move stated poses, in n frames."""

    slopes: Array
    """(n, 6, k) see `Arm.slopes`."""
    rotates: BoolArray
    """(k,) whether a value is an angle."""
    at: Array
    """(k,) offsets that the stated poses contain."""


@frozen_arrays
class ArmOffsets:
    """Estimated offsets of the k joints of an arm."""

    arm: Arm
    mount: Mount
    """Of the camera; the map of a fixed one is in the frame of the gripper."""
    values: Array
    """(k,) to be added to joint values, radians, or metres of sliding joints."""
    covariance: Array
    """(k, k)."""
    prior: Array
    """(k,) standard deviation of offsets of this arm before the images."""
    determined: BoolArray
    """(k,) whether the images determine the offset."""

    @classmethod
    def start(cls, arm: Arm, mount: Mount, values: Array) -> Self:
        """Offsets of unknown uncertainty."""
        unknown = np.full(len(values), np.inf)
        return cls(arm, mount, values, np.diag(unknown), unknown, np.isfinite(unknown))

    def poses(self, joints: Array) -> SE3:
        """(n,) base_from_gripper of joint values (n, k), which the offsets correct."""
        return self.arm.poses(joints + self.values)

    def slopes(self, joints: Array) -> JointSlopes:
        """How joints move the poses of joint values (n, k), which the offsets correct."""
        slopes = self.arm.slopes(joints + self.values) * self.arm.free()
        if not self.mount.moves:
            # In the frame of the gripper, a fixed camera moves the other way.
            slopes = -slopes
        return JointSlopes(slopes, self.arm.rotates(), self.values)
