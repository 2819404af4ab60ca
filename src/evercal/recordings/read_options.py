"""Choices for reading a recording that lacks some information."""

from dataclasses import dataclass, fields
from pathlib import Path

from evercal.choices import ConventionName
from evercal.errors import InputError
from evercal.typing import Strings


@dataclass(frozen=True)
class ReadOptions:
    """Options for reading a recording; each format uses some of them and refuses the others."""

    camera: Path | None = None
    """Camera file for all images, see `read_camera`. If omitted, the recording's intrinsics."""
    image_topic: str | None = None
    """Image topic of a bag, or camera key of a LeRobot dataset. Required if there are several."""
    pose_topic: str | None = None
    """tf or joint state topic of a bag. Required if several topics move the same frame or joint."""
    base_frame: str | None = None
    """The robot's base: a tf frame of a bag or a link of the URDF, if omitted the usual one.
    Elsewhere its name."""
    gripper_frame: str | None = None
    """The gripper: a tf frame, a link of the URDF, or a feature or arm of a LeRobot dataset, if
    omitted the usual one. Elsewhere its name."""
    camera_frame: str | None = None
    """Name of the camera's optical frame. If omitted, that of the images of a bag."""
    urdf: Path | None = None
    """URDF of the robot, for joint angles. If omitted, the file beside them."""
    joint_map: Path | None = None
    """File that says which column each joint is, its sense, zero, unit and coupling, as 'evercal
    inspect' writes it."""
    unchecked_joints: bool = False
    """Read joint values that are too large for radians, too, to find out what they are."""
    pose_convention: ConventionName | str | None = None
    """Convention of a pose file, see `read_robot_poses`; rad or deg for joint angles. If omitted,
    the file defines it."""
    metres: bool = False
    """The lengths of a COLMAP or nerfstudio recording are metres. If omitted, their unit is
    unknown."""
    poses: str = "original"
    """Poses of 7-Scenes and 12-Scenes: original; colour for those of the colour camera of 7-Scenes,
    whose original ones are of the depth camera; or a folder of those by structure from motion. Of
    other folders of images, the file or folder of camera poses."""
    split: str | None = None
    """Test frames of a recording that has none: 4:1 for one after every four training frames."""
    whole_robot: bool = False
    """Read the values of all joints that the URDF has, as for the arm in the images, instead of
    gripper poses, which are those of the base then."""
    every: int = 1
    """Take every N-th image; 1 for all."""

    def __post_init__(self) -> None:
        """Refuse a step that takes no image."""
        if self.every < 1:
            raise InputError(f"`every` {self.every}: give a number >= 1")
        if self.whole_robot and self.gripper_frame:
            raise InputError("`gripper_frame`: all joints are read; leave it out")

    def given(self) -> Strings:
        """Names of the fields that differ from their defaults."""
        return tuple(f.name for f in fields(self) if getattr(self, f.name) != f.default)
