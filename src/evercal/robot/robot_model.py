"""`RobotModel`: an arm from its URDF, which yourdfpy reads (extra `urdf`)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evercal.errors import InputError, optional_module
from evercal.geometry import SE3
from evercal.robot.arm import Arm, MovingJoint
from evercal.storage.text_files import library_errors, read_text, refuse_repeated
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


class RobotModel:
    """Links and joints of a URDF; its meshes are not read."""

    def __init__(self, path: PathLike) -> None:
        self.path = Path(path)
        need = f"{path}: reading a URDF needs yourdfpy"
        yourdfpy = optional_module("yourdfpy", need, "urdf")
        etree = optional_module("lxml.etree", need, "urdf")
        if not self.path.is_file():
            raise InputError(f"{path}: no such URDF file")
        if self.path.suffix == ".xacro":
            raise InputError(
                f"{path}: is a macro file; make a URDF of it with 'xacro' first"
            )
        # Its scene graph fails where a part of no interest is wrong.
        plain = ("load_meshes", "load_collision_meshes", "build_scene_graph")
        with library_errors(f"{path}: no usable URDF"):
            if "</robot" not in read_text(self.path, "URDF"):
                # Else the parts before a cut would be read as the whole.
                raise ValueError("it does not end with </robot>, so a part is missing")
            self._urdf = yourdfpy.URDF.load(
                str(self.path), **dict.fromkeys(plain, False)
            )
            self.links = tuple(link.name for link in self._urdf.robot.links)
            joints = self._urdf.robot.joints
            self._joint_above = {joint.child: joint for joint in joints}
            for names in (self.links, [joint.name for joint in joints]):
                refuse_repeated(names, "give each link and each joint its own name")
            refuse_repeated(
                (joint.child for joint in joints), "a link is below one joint at most"
            )
            roots = [link for link in self.links if link not in self._joint_above]
            self.base_link = [*roots, *self.links][0]
            # Of the readers pinocchio alone heeds quat_xyzw, and yourdfpy does not keep it.
            tree = etree.parse(str(self.path), etree.XMLParser(recover=True))
            for text in tree.xpath("/robot/joint/*/@xyz | /robot/joint/*/@rpy"):
                if np.isfinite(list(map(float, text.split()))).sum() != 3:
                    raise ValueError(f"'{text}' are not three finite numbers")
            self._turned = set(tree.xpath("/robot/joint[origin/@quat_xyzw]/@name"))

    def has_joint(self, name: str) -> bool:
        """Whether the URDF has a joint of this name."""
        return name in self._urdf.joint_map

    def chosen_links(self, base: str | None, gripper: str | None) -> tuple[str, str]:
        """Base and gripper link; if omitted, the root and the only end of the arm."""
        parents = {joint.parent for joint in self._joint_above.values()}
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
        arm = self.arm(base, gripper)
        needed = arm.joints
        missing = [name for name in needed if name not in names]
        if missing:
            raise InputError(
                f"{source}: no values for joint {', '.join(missing)}, which {gripper} depends on;"
                f" given are {', '.join(names) or 'none'}"
            )
        values = values[:, [list(names).index(name) for name in needed]]
        for name, column in zip(needed, values.T, strict=True):
            revolute = self._urdf.joint_map[name].type == "revolute"
            if revolute and column.size and np.abs(column).max() > _LARGEST_RAD:
                raise InputError(
                    f"{source}: joint {name} is at {column[np.abs(column).argmax()]:.1f}, too far"
                    f" for radians; if these are degrees, write the column as {name}_deg or give"
                    f" `pose_convention` deg"
                )
        note = f"gripper poses are those of {gripper} in {base}, from {self.path.name}"
        notes = [note, *self._beyond_limits(needed, values)]
        return ArmPoses(arm.poses(values), arm, values, notes)

    def arm(self, base: str, gripper: str) -> Arm:
        """The chain between two links; its joint values are those that others do not mimic."""
        up = self._ancestors(base)
        down = self._ancestors(gripper)
        if (up[-1].parent if up else base) != (down[-1].parent if down else gripper):
            raise InputError(
                f"{self.path}: no joints connect {base} and {gripper}; name others"
            )
        steps = [(joint, True) for joint in up if joint not in down]
        steps += [(joint, False) for joint in reversed(down) if joint not in up]
        names: list[str] = []
        chain: list[MovingJoint] = []
        before = np.eye(4)
        for joint, backwards in steps:
            if joint.type not in (*_MOVING, "fixed"):
                raise InputError(
                    f"{self.path}: joint {joint.name} is {joint.type}; not supported"
                )
            origin = self._origin(joint)
            before = before if backwards else before @ origin
            if joint.type in _MOVING:
                name, factor, constant = self._driver(joint)
                names += [] if name in names else [name]
                axis = -self._axis(joint) if backwards else self._axis(joint)
                rotates = joint.type != "prismatic"
                value = names.index(name)
                chain.append(
                    MovingJoint(before, axis, rotates, value, factor, constant)
                )
                before = np.eye(4)
            before = before @ np.linalg.inv(origin) if backwards else before
        return Arm(tuple(names), tuple(chain), before)

    def origins_with(self, offsets: Mapping[str, float]) -> dict[str, tuple[SE3, bool]]:
        """Origins of the joints that move by some values, with offsets of these values.

        Returns each origin and whether the joint rotates, by name; joints that mimic one of them
        are among them. A program that gets the values without offsets then computes the poses of
        those with them.
        """
        moved = {}
        for joint in self._urdf.robot.joints:
            name, factor, _ = self._driver(joint)
            if joint.type in _MOVING and name in offsets:
                step = factor * offsets[name]
                rotates = joint.type != "prismatic"
                motion = np.kron((0, step) if rotates else (step, 0), self._axis(joint))
                moved[joint.name] = (
                    SE3.from_matrix(self._origin(joint)) @ SE3.exp(motion),
                    rotates,
                )
        return moved

    def _origin(self, joint: Any) -> Array:
        if joint.name in self._turned:
            what = "turned by quat_xyzw, which most programs ignore; write rpy"
            raise InputError(f"{self.path}: joint {joint.name} is {what}")
        return np.eye(4) if joint.origin is None else joint.origin

    def _axis(self, joint: Any) -> Array:
        """(3,) unit vector."""
        length = np.linalg.norm(joint.axis)
        if not 0 < length < np.inf:
            raise InputError(
                f"{self.path}: joint {joint.name} has the axis {joint.axis}"
            )
        return joint.axis / length

    def _driver(self, joint: Any) -> tuple[str, float, float]:
        """Name of the value that moves a joint, and factor and constant of its motion."""
        factor = 1.0
        constant = 0.0
        passed = [joint.name]
        while joint.mimic is not None:
            constant += factor * joint.mimic.offset
            factor *= joint.mimic.multiplier
            other = self._urdf.joint_map.get(joint.mimic.joint)
            if other is None or other.name in passed or other.type not in _MOVING:
                why = (
                    "mimics it"
                    if joint.mimic.joint in passed
                    else "is no moving joint of it"
                )
                raise InputError(
                    f"{self.path}: joint {joint.name} mimics {joint.mimic.joint}, which {why};"
                    " correct the URDF"
                )
            joint = other
            passed.append(joint.name)
        return joint.name, factor, constant

    def rotates(self, name: str) -> bool:
        """Whether a joint exists and its values are angles."""
        joint = self._urdf.joint_map.get(name)
        return joint is not None and joint.type in ("revolute", "continuous")

    def _beyond_limits(self, names: Sequence[str], values: Array) -> list[str]:
        """One sentence for each joint that exceeds its limits by 0.1, or two rotations."""
        notes = []
        for name, column in zip(names, values.T, strict=True):
            joint = self._urdf.joint_map[name]
            covered = f"joint {name} goes from {column.min():.2f} to {column.max():.2f}"
            if joint.type == "continuous" and np.ptp(column) > _LARGEST_RAD:
                notes.append(f"{covered}, more than two rotations; are these degrees?")
            lower, upper = (
                getattr(joint.limit, end, None) for end in ("lower", "upper")
            )
            if joint.type == "continuous" or lower is None or upper is None:
                continue
            if column.min() < lower - 0.1 or column.max() > upper + 0.1:
                notes.append(
                    f"{covered}, the URDF allows {lower:.2f} to {upper:.2f}; are the joints in the"
                    f" right order and in radians?"
                )
        return notes

    def _ancestors(self, link: str) -> list[Any]:
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
        return joints
