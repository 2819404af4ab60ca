"""`WholeRobot`: a robot of which all joint values are read."""

from collections.abc import Sequence
from dataclasses import replace

from evercal.errors import InputError
from evercal.robot.arm import Arm
from evercal.robot.robot_model import ArmPoses, RobotModel
from evercal.typing import Array, PathLike


class WholeRobot(RobotModel):
    """A robot without a gripper: all its joint values count, and its pose is that of its base."""

    def chosen_links(self, base: str | None, gripper: str | None) -> tuple[str, str]:
        """The base, twice; if omitted, the root."""
        return super().chosen_links(base, gripper or base or self.base_link)

    def read_arm(
        self, base: str, gripper: str, names: Sequence[str], source: PathLike
    ) -> Arm:
        """An arm of all joints that are named; it stands still."""
        drivers = self.drivers()
        joints = [name for name in names if name in drivers]
        if not joints:
            raise InputError(
                f"{source}: no value is of a joint of {self.path}; given are"
                f" {', '.join(names) or 'none'}, its joints are {', '.join(drivers)}"
            )
        ranges = self.ranges(joints)
        return replace(self.arm(base, gripper), joints=tuple(joints), ranges=ranges)

    def poses(
        self,
        names: Sequence[str],
        values: Array,
        base: str | None,
        gripper: str | None,
        source: PathLike = "joints",
    ) -> ArmPoses:
        """Pick the values of all joints; all poses are the identity."""
        moved = super().poses(names, values, base, gripper, source)
        joints = moved.arm.joints
        notes = [f"values of {len(joints)} joints of {self.path.name} are read"]
        unused = [name for name in names if name not in joints]
        if unused:
            notes.append(
                f"values of no joint that moves by itself: {', '.join(unused)}"
            )
        return moved._replace(notes=[*notes, *moved.notes[1:]])
