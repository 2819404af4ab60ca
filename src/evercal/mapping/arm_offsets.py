"""Offsets of an arm's joints in a recording: stated poses with them, and how they move frames."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from evercal.recordings.frame import Frame
from evercal.robot.arm import Arm, JointSlopes
from evercal.robot.mount import Mount
from evercal.typing import Array, BoolArray


@dataclass(frozen=True, eq=False)
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
    """(k,) whether the images tell the offset."""

    @classmethod
    def start(cls, arm: Arm, mount: Mount, values: Array) -> Self:
        """Offsets of unknown uncertainty."""
        unknown = np.full(len(values), np.inf)
        return cls(arm, mount, values, np.diag(unknown), unknown, np.isfinite(unknown))

    def moved(self, frames: Sequence[Frame]) -> list[Frame]:
        """Frames whose stated poses contain the offsets; camera and gripper keep their transform.

        Frames without joint values stay as they are.
        """
        changed = []
        for frame in frames:
            gripper = frame.base_from_gripper
            camera = frame.base_from_camera
            if frame.joints_rad is not None and gripper is not None:
                after = self.arm.poses(
                    (np.array(frame.joints_rad) + self.values)[None]
                )[0]
                fixed = not self.mount.moves
                change = (
                    after.inverse() @ gripper if fixed else after @ gripper.inverse()
                )
                frame = replace(frame, base_from_gripper=after)
                frame = replace(frame, base_from_camera=camera and change @ camera)
            changed.append(frame)
        return changed

    def slopes(self, frames: Sequence[Frame]) -> JointSlopes:
        """How joints move the stated poses of frames, which contain the offsets."""
        joints = np.array([frame.joints_rad for frame in frames])
        slopes = self.arm.slopes(joints + self.values) * self.arm.free()
        # In the frame of the gripper, a fixed camera moves the other way.
        sign = 1 if self.mount.moves else -1
        return JointSlopes(sign * slopes, self.arm.rotates(), self.values)


def has_joints(frames: Sequence[Frame]) -> bool:
    """Whether all frames state joint values."""
    return all(frame.joints_rad is not None for frame in frames)
