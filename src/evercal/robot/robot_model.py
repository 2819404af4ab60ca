"""`RobotModel`: an arm from its URDF."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from evercal.bounds import require_at_most
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.robot.arm import Arm, MovingJoint
from evercal.robot.frame_names import FrameNames
from evercal.robot.urdf import Joint, parsed_urdf
from evercal.storage.text_files import named_errors, naming, refuse_repeated
from evercal.typing import Array, PathLike

_MOVING = ("revolute", "continuous", "prismatic")
_LARGEST_RAD = 4 * np.pi
"""Two rotations: no joint of an arm exceeds them, and 12.6 in degrees is a small angle."""


class ArmPoses(NamedTuple):
    """Poses of an arm at n times."""

    poses: SE3
    """(n,) base_from_gripper."""
    arm: Arm
    joints: Array
    """(n, k) values of the joints of the arm, radians, or metres of sliding joints."""
    notes: list[str]
    """Links that were chosen, and joints beyond their limits."""
    frames: FrameNames


class RobotModel:
    """Links and joints of a URDF; its meshes are not read.

    `whole` is whether the values of all joints are read. The robot needs no gripper then: its pose
    is that of its base. `unchecked` values may be too large for radians.
    """

    def __init__(
        self, path: PathLike, whole: bool = False, unchecked: bool = False
    ) -> None:
        self.path = Path(path)
        self.whole = whole
        self.unchecked = unchecked
        if not self.path.is_file():
            raise InputError(f"{path}: no such URDF file")
        if self.path.suffix == ".xacro":
            raise InputError(
                f"{path}: is a macro file; make a URDF of it with 'xacro' first"
            )
        with named_errors(self.path, "URDF"), naming("no usable URDF"):
            require_at_most(self.path.stat().st_size, "text_bytes", "bytes")
            self.links, self._joints = parsed_urdf(self.path.read_bytes())
            self._joint_named = {joint.name: joint for joint in self._joints}
            self._index_links()

    def _index_links(self) -> None:
        unique = "give each link and each joint its own name"
        refuse_repeated(self.links, unique)
        refuse_repeated((joint.name for joint in self._joints), unique)
        refuse_repeated(
            (joint.child for joint in self._joints), "a link is below one joint at most"
        )
        self._joint_above = {joint.child: joint for joint in self._joints}
        roots = [link for link in self.links if link not in self._joint_above]
        roots += self.links
        self.base_link = roots[0]

    def has_joint(self, name: str) -> bool:
        """Whether the URDF has a joint of this name."""
        return name in self._joint_named

    def rotates(self, name: str) -> bool:
        """Whether a joint exists and its values are angles."""
        named = self._joint_named
        return name in named and named[name].type in ("revolute", "continuous")

    def chosen_links(self, base: str | None, gripper: str | None) -> tuple[str, str]:
        """Base and gripper link; if omitted, the root and the only end of the arm."""
        if self.whole:
            gripper = base or self.base_link
        parents = {joint.parent for joint in self._joints}
        ends = [link for link in self.links if link not in parents]
        if gripper is None and len(ends) != 1:
            raise InputError(
                f"{self.path}: has {len(ends)} ends; name the link with `gripper_frame`, one of"
                f" {', '.join(self.links)}"
            )
        return base or self.base_link, gripper or ends[0]

    def poses(
        self,
        names: Sequence[str],
        values: Array,
        base: str | None,
        gripper: str | None,
        source: PathLike = "joints",
    ) -> ArmPoses:
        """Compute (n,) poses of the gripper.

        Values (n, k) of the k named joints are radians, or metres for prismatic joints. `source`
        names their origin in messages.
        """
        base, gripper = self.chosen_links(base, gripper)
        arm = self.read_arm(base, gripper, names, source)
        missing = [name for name in arm.joints if name not in names]
        if missing:
            raise InputError(
                f"{source}: no values for joint {', '.join(missing)}, which {gripper} depends on;"
                f" given are {', '.join(names) or 'none'}; rename them, or give `joint_map`"
            )
        values = values[:, [names.index(name) for name in arm.joints]]
        notes = [
            f"gripper poses are those of {gripper} in {base}, from {self.path.name}"
        ]
        if self.whole:
            notes = [f"values of {len(arm.joints)} joints of {self.path.name} are read"]
        unused = [name for name in names if name not in arm.joints]
        if self.whole and unused:
            notes.append(
                f"values of no joint that moves by itself: {', '.join(unused)}"
            )
        for name, column in zip(arm.joints, values.T, strict=True):
            problem = self._no_radians(name, column)
            if problem and not self.unchecked:
                raise InputError(f"{source}: {problem}")
            if problem:
                notes.append(problem)
                break
            notes += self._beyond_limits(name, column)
        frames = FrameNames(base)
        if gripper != base:
            frames = FrameNames(base, gripper)
        return ArmPoses(arm.poses(values), arm, values, notes, frames)

    def read_arm(
        self, base: str, gripper: str, names: Sequence[str], source: PathLike
    ) -> Arm:
        """The arm whose values are taken from those of some names: the chain, or all joints."""
        arm = self.arm(base, gripper)
        if not self.whole:
            return arm
        drivers = self.drivers()
        joints = tuple(name for name in names if name in drivers)
        if not joints:
            raise InputError(
                f"{source}: no value is of a joint of {self.path}; given are"
                f" {', '.join(names) or 'none'}, its joints are {', '.join(drivers)}"
            )
        return replace(arm, joints=joints, ranges=self._ranges(joints))

    def arm(self, base: str, gripper: str) -> Arm:
        """The chain between two links; its joint values are those that others do not mimic."""
        up, root = self._joints_above(base)
        down, gripper_root = self._joints_above(gripper)
        if root != gripper_root:
            raise InputError(
                f"{self.path}: no joints connect {base} and {gripper}; name others"
            )
        common = {*up} & {*down}
        steps = [(joint, True) for joint in up if joint not in common]
        steps += [(joint, False) for joint in reversed(down) if joint not in common]
        names: dict[str, int] = {}
        chain: list[MovingJoint] = []
        before = np.eye(4)
        for joint, backwards in steps:
            if joint.type not in (*_MOVING, "fixed"):
                raise self._error(joint, f"is {joint.type}; not supported")
            origin = self._origin(joint)
            if not backwards:
                before = before @ origin
            if joint.type in _MOVING:
                name, factor, constant = self._driver(joint)
                value = names.setdefault(name, len(names))
                axis = self._axis(joint)
                if backwards:
                    axis = -axis
                rotates = joint.type != "prismatic"
                moving = MovingJoint(before, axis, rotates, value, factor, constant)
                chain.append(moving)
                before = np.eye(4)
            if backwards:
                before = before @ np.linalg.inv(origin)
        joints = tuple(names)
        return Arm(joints, tuple(chain), before, self._ranges(joints), self.path.name)

    def _ranges(self, joints: Sequence[str]) -> Array:
        """(k, 3) lower limit, middle and upper limit of joints."""
        limits = [
            self._joint_named[name].numbers[end]
            for name in joints
            for end in ("limit lower", "limit upper")
        ]
        within = np.reshape(limits, (-1, 2)).clip(-_LARGEST_RAD, _LARGEST_RAD)
        lower, upper = within.T
        return np.stack([lower, (lower + upper) / 2, upper], 1)

    def drivers(self) -> list[str]:
        """Names of the joints that move and mimic none."""
        moving = [joint for joint in self._joints if joint.type in _MOVING]
        return [joint.name for joint in moving if "mimic" not in joint.element.starts]

    def origins_with(self, offsets: Mapping[str, float]) -> dict[str, tuple[SE3, bool]]:
        """Origins of the joints that move by some values, with offsets of these values.

        Returns each origin and whether the joint rotates, by name; joints that mimic one of them
        are among them. A program that gets the values without offsets then computes the poses of
        those with them.
        """
        origins = {}
        for joint in self._joints:
            name, factor, _ = self._driver(joint)
            if joint.type not in _MOVING or name not in offsets:
                continue
            step = factor * offsets[name]
            rotates = joint.type != "prismatic"
            weights = (0, step) if rotates else (step, 0)
            motion = np.kron(weights, self._axis(joint))
            origin = SE3.from_matrix(self._origin(joint))
            moved = origin @ SE3.exp(motion)
            origins[joint.name] = (moved, rotates)
        return origins

    def _origin(self, joint: Joint) -> Array:
        """(4, 4) parent_from_joint at the value zero."""
        if problem := joint.problem():
            raise self._error(joint, problem)
        angles = Rotation.from_euler("xyz", joint.numbers["origin rpy"])
        quaternion = angles.as_quat(scalar_first=True)
        return SE3(quaternion, np.array(joint.numbers["origin xyz"])).matrix()

    def _axis(self, joint: Joint) -> Array:
        """(3,) unit vector."""
        axis = np.array(joint.numbers["axis xyz"])
        length = np.linalg.norm(axis)
        if not 0 < length < np.inf:
            raise self._error(joint, f"has the axis {axis}")
        return axis / length

    def _driver(self, joint: Joint) -> tuple[str, float, float]:
        """Name of the value that moves a joint, and factor and constant of its motion."""
        factor = 1.0
        constant = 0.0
        followers = [joint.name]
        while "mimic" in joint.element.starts:
            constant += factor * joint.numbers["mimic offset"][0]
            factor *= joint.numbers["mimic multiplier"][0]
            name = joint.element.stated.get("mimic joint", "")
            driver = self._joint_named.get(name, joint)
            if name in followers:
                problem = "mimics it"
            elif driver is joint or driver.type not in _MOVING:
                problem = "is no moving joint of it"
            else:
                problem = driver.problem()
            if problem:
                raise self._error(
                    joint, f"mimics {name}, which {problem}; correct the URDF"
                )
            joint = driver
            followers.append(name)
        return joint.name, factor, constant

    def _no_radians(self, name: str, column: Array) -> str:
        """What to do about values that are too large; empty if they are not."""
        if self._joint_named[name].type != "revolute" or not column.size:
            return ""
        largest = column[np.abs(column).argmax()]
        if abs(largest) <= _LARGEST_RAD:
            return ""
        return (
            f"joint {name} is at {largest:.1f}, too far for radians; if these are degrees, write"
            f" the column as {name}_deg or give `pose_convention` deg, else 'evercal inspect'"
            " tries what they are and writes a file for `joint_map`"
        )

    def _beyond_limits(self, name: str, column: Array) -> list[str]:
        """A sentence if values of a joint exceed its limits by 0.1, or two rotations."""
        joint = self._joint_named[name]
        least = column.min()
        most = column.max()
        covered = f"joint {name} goes from {least:.2f} to {most:.2f}"
        if joint.type == "continuous":
            if np.ptp(column) > _LARGEST_RAD:
                return [f"{covered}, more than two rotations; are these degrees?"]
            return []
        (lower,) = joint.numbers["limit lower"]
        (upper,) = joint.numbers["limit upper"]
        if least >= lower - 0.1 and most <= upper + 0.1:
            return []
        return [
            f"{covered}, the URDF allows {lower:.2f} to {upper:.2f}; are the joints in the"
            f" right order and in radians?"
        ]

    def _joints_above(self, link: str) -> tuple[list[Joint], str]:
        """Joints from a link up to its root, and the root."""
        if link not in self.links:
            raise InputError(
                f"{self.path}: has no link {link!r}; it has {', '.join(self.links)}"
            )
        joints = []
        while link in self._joint_above:
            joints.append(self._joint_above[link])
            link = joints[-1].parent
            if len(joints) > len(self.links):
                raise InputError(
                    f"{self.path}: the joints above link {link} form a circle"
                )
        return joints, link

    def _error(self, joint: Joint, problem: str) -> InputError:
        return InputError(f"{self.path}: joint {joint.name} {problem}")
