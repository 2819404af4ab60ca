"""`Arm`: a chain of joints from the base to the gripper; poses, and how each joint moves them."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from evercal.geometry import SE3
from evercal.typing import Array, BoolArray


class MovingJoint(NamedTuple):
    """One moving joint of a chain."""

    before: Array
    """(4, 4) from the frame before the joint to the frame after the last one."""
    axis: Array
    """(3,) unit vector; backwards where the chain goes from child to parent."""
    rotates: bool
    value: int
    """Number of the joint value that moves it; several joints share one where others mimic it."""
    factor: float = 1.0
    """It moves by factor * value + constant, radians or metres."""
    constant: float = 0.0


@dataclass(frozen=True, eq=False)
class Arm:
    """Kinematics of an arm."""

    joints: tuple[str, ...]
    """Names of the k joint values, from the base outwards."""
    chain: tuple[MovingJoint, ...]
    last: Array
    """(4, 4) from the frame after the last joint to the gripper."""

    def rotates(self) -> BoolArray:
        """(k,) whether a value is an angle."""
        angles = {motion.value for motion in self.chain if motion.rotates}
        return np.array([i in angles for i in range(len(self.joints))])

    def free(self) -> BoolArray:
        """(k,) whether the offset of a value can be told from images.

        That of the first joint turns base and scene together, that of the last one gripper and
        camera.
        """
        moved = [motion.value for motion in self.chain]
        ends = {value for value in (*moved[:1], *moved[-1:]) if moved.count(value) == 1}
        return np.array([i not in ends for i in range(len(self.joints))])

    def poses(self, values: Array) -> SE3:
        """(n,) base_from_gripper of joint values (n, k), radians, or metres of sliding joints."""
        return SE3.from_matrix(self._frames(values)[-1])

    def slopes(self, values: Array) -> Array:
        """(n, 6, k) motion of the gripper by each value: translation, rotation; gripper's axes."""
        frames = self._frames(values)
        from_gripper = np.linalg.inv(frames[-1])
        slopes = np.zeros((len(values), 6, len(self.joints)))
        for motion, frame in zip(self.chain, frames, strict=False):
            moved = from_gripper @ frame
            axis = motion.factor * (moved[:, :3, :3] @ motion.axis)
            if motion.rotates:
                slopes[:, 3:, motion.value] += axis
                # The origin of the gripper turns about the joint, which lies at -moved.
                slopes[:, :3, motion.value] -= np.cross(axis, moved[:, :3, 3])
            else:
                slopes[:, :3, motion.value] += axis
        return slopes

    def _frames(self, values: Array) -> list[Array]:
        """(n, 4, 4) frames after each joint, and that of the gripper."""
        frame = np.tile(np.eye(4), (len(values), 1, 1))
        frames = []
        for motion in self.chain:
            moved = np.tile(np.eye(4), (len(values), 1, 1))
            steps = (motion.factor * values[:, motion.value] + motion.constant)[:, None]
            if motion.rotates:
                moved[:, :3, :3] = Rotation.from_rotvec(steps * motion.axis).as_matrix()
            else:
                moved[:, :3, 3] = steps * motion.axis
            frame = frame @ motion.before @ moved
            frames.append(frame)
        return [*frames, frame @ self.last]
