"""Mounts of a camera: on the gripper, or fixed beside the arm."""

from typing import Literal

from evercal.choices import MountName
from evercal.classes import frozen
from evercal.errors import InputError
from evercal.geometry import SE3

Frame = Literal["base", "gripper"]


@frozen
class Mount:
    """Which frame carries a camera, and in which frame its scene stands still."""

    name: MountName
    parent: Frame
    """Frame that carries the camera; `parent_from_camera` is what a calibration estimates."""
    scene: Frame
    """Frame of the scene: the gripper holds what a fixed camera observes, a board or a thing."""
    other_name: MountName

    @property
    def moves(self) -> bool:
        """Whether the camera moves with the gripper."""
        return self.parent == "gripper"

    @property
    def other(self) -> "Mount":
        """The mount that this one is mistaken for, with inverted gripper poses."""
        return MOUNTS[self.other_name]

    def scene_from_parent(self, base_from_gripper: SE3) -> SE3:
        """(n,) poses of the parent frame in the frame of the scene."""
        if self.moves:
            return base_from_gripper
        return base_from_gripper.inverse()


EYE_IN_HAND = Mount("eye_in_hand", "gripper", "base", "eye_to_hand")
"""The gripper carries the camera, which observes a scene that stands still in the base."""
EYE_TO_HAND = Mount("eye_to_hand", "base", "gripper", "eye_in_hand")
"""The camera stands still and observes what the gripper holds."""
MOUNTS = {mount.name: mount for mount in (EYE_TO_HAND, EYE_IN_HAND)}
"""Mounts by name."""


def mount_named(name: MountName) -> Mount:
    """The mount of a name; another word is refused."""
    if name not in MOUNTS:
        raise InputError(f"mount {name!r}: give {' or '.join(MOUNTS)}")
    return MOUNTS[name]
