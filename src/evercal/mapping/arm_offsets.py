"""Frames of a recording whose stated poses follow from the joint values of an arm."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from evercal.geometry import SE3
from evercal.recordings.frame import Frame, stated_grippers
from evercal.robot.arm_offsets import ArmOffsets, JointSlopes
from evercal.robot.mount import Mount


def has_joints(frames: Sequence[Frame]) -> bool:
    """Whether all frames state joint values."""
    return all(frame.joints_rad is not None for frame in frames)


def joint_slopes(frames: Sequence[Frame], offsets: ArmOffsets) -> JointSlopes:
    """How joints move the stated poses of frames, which contain the offsets."""
    return offsets.slopes(np.array([frame.joints_rad for frame in frames]))


def with_offsets(frames: Sequence[Frame], offsets: ArmOffsets) -> list[Frame]:
    """Frames whose stated poses contain the offsets; camera and gripper keep their transform.

    Frames without joint values stay as they are.
    """
    changed = []
    for frame in frames:
        before = frame.base_from_gripper
        if frame.joints_rad is None or not before:
            changed.append(frame)
            continue
        after = offsets.poses(np.array([frame.joints_rad]))[0]
        change = after.inverse() @ before
        if offsets.mount.moves:
            change = after @ before.inverse()
        camera = frame.base_from_camera
        if camera:
            camera = change @ camera
        changed.append(replace(frame, base_from_gripper=after, base_from_camera=camera))
    return changed


def camera_in_gripper(
    frames: Sequence[Frame], stated: SE3, mount: Mount | None
) -> SE3 | None:
    """(n,) stated poses of the cameras in the gripper; None where camera poses were stated."""
    if not mount:
        return None
    if not mount.moves:
        return stated
    return stated_grippers(frames).inverse() @ stated
