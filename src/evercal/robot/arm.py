"""`Arm`: a chain of joints from the base to the gripper; poses, and how each joint moves them."""

from dataclasses import field
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from evercal.classes import frozen_arrays
from evercal.geometry import SE3
from evercal.robot.joint_map import JointMap
from evercal.typing import Array, BoolArray, Pair, Strings


class MovingJoint(NamedTuple):
    """One moving joint of a chain."""

    before: Array
    """(4, 4) from the frame before the joint to the frame after the last one."""
    axis: Array
    """(3,) unit vector; backwards where the chain goes from child to parent."""
    rotates: bool
    """Whether it turns about its axis, else slides along it."""
    value: int
    """Index of the joint value that moves it; joints that mimic one share its value."""
    factor: float = 1.0
    """Multiplier of the value; the joint moves by factor * value + constant."""
    constant: float = 0.0
    """Offset of the motion, radians, or metres of sliding joints."""


@frozen_arrays
class Arm:
    """Kinematics of an arm."""

    joints: Strings
    """Names of the k joint values, from the base outwards."""
    chain: tuple[MovingJoint, ...]
    """Joints that move, from the base to the gripper."""
    last: Array
    """(4, 4) from the frame after the last joint to the gripper."""
    ranges: Array = field(default_factory=lambda: np.pi * np.arange(-1, 2))
    """(k, 3) lower limit, usual value and upper limit of each value; or (3,) of all."""
    name: str = "the arm"
    assumed: tuple[Pair, ...] = ((0.0, 0.0),)
    """Heights of the stated base above its own, and lengths of a tool along the axis of its
    gripper, that may be meant by stated poses; metres."""
    read: JointMap | None = None
    """How its values were read, if they were recorded."""

    def rotates(self) -> BoolArray:
        """(k,) whether a value is an angle."""
        rotates = np.zeros(len(self.joints), bool)
        for joint in self.chain:
            rotates[joint.value] |= joint.rotates
        return rotates

    def free(self) -> BoolArray:
        """(k,) whether images determine the offset of a value.

        That of the first joint turns base and scene together, that of the last one gripper and
        camera.
        """
        values = [joint.value for joint in self.chain]
        free = np.ones(len(self.joints), bool)
        for end in (*values[:1], *values[-1:]):
            free[end] = values.count(end) > 1
        return free

    def poses(self, values: Array) -> SE3:
        """(n,) base_from_gripper of joint values (n, k), radians, or metres of sliding joints."""
        return SE3.from_matrix(self._frames(values)[-1])

    def slopes(self, values: Array) -> Array:
        """(n, 6, k) motion of the gripper by each value: translation, rotation; gripper's axes."""
        frames = self._frames(values)
        gripper_from_base = np.linalg.inv(frames[-1])
        slopes = np.zeros((len(values), 6, len(self.joints)))
        for joint, base_from_joint in zip(self.chain, frames, strict=False):
            gripper_from_joint = gripper_from_base @ base_from_joint
            rotation = gripper_from_joint[:, :3, :3]
            position = gripper_from_joint[:, :3, 3]
            axis = joint.factor * (rotation @ joint.axis)
            slope = slopes[:, :, joint.value]
            if joint.rotates:
                slope[:, 3:] += axis
                # The gripper's origin, as seen from the joint, is at minus this position.
                slope[:, :3] -= np.cross(axis, position)
            else:
                slope[:, :3] += axis
        return slopes

    def _frames(self, values: Array) -> list[Array]:
        """(n, 4, 4) frames after each joint, and that of the gripper."""
        identity = np.tile(np.eye(4), (len(values), 1, 1))
        frame = identity
        frames = []
        for joint in self.chain:
            steps = joint.factor * values[:, joint.value] + joint.constant
            motion = steps[:, None] * joint.axis
            moved = identity.copy()
            if joint.rotates:
                moved[:, :3, :3] = Rotation.from_rotvec(motion).as_matrix()
            else:
                moved[:, :3, 3] = motion
            frame = frame @ joint.before @ moved
            frames.append(frame)
        return [*frames, frame @ self.last]
