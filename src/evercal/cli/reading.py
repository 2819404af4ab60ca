"""Options for reading a recording, shared by all verbs that take one."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from evercal.cli.options import File, Name

if TYPE_CHECKING:
    from evercal.recordings import Recording


@dataclass(frozen=True)
class Reading:
    """How the recording is read; options that do not apply to its format are refused."""

    format: Name = None
    """Format of the recording: generic, 7scenes, 12scenes, nerfstudio, colmap, wrist, lerobot or
    rosbag. Default: recognised from its files."""
    camera: File = None
    """Intrinsics of all images, if the recording has none: 3x3 matrix as text, JSON, YAML,
    NPZ, ROS camera_info or OpenCV's storage."""
    image_topic: Annotated[str | None, arg(metavar="TOPIC", help_behavior_hint="")] = None
    """Images of a bag or a LeRobot dataset; required if there are several topics."""
    pose_topic: Annotated[str | None, arg(metavar="TOPIC", help_behavior_hint="")] = None
    """tf or joint states of a bag; required if there are several topics."""
    base_frame: Name = None
    """The robot's base, a tf frame of a bag or a link of the URDF."""
    gripper_frame: Name = None
    """The gripper: a tf frame of a bag, a link of the URDF, or a feature or arm of a LeRobot
    dataset."""
    urdf: File = None
    """URDF of the robot, for recordings with joint angles."""
    pose_convention: Name = None
    """Format of the gripper poses, if the file's header does not state it; rad or deg for joint
    angles."""
    metres: bool = False
    """The poses of a COLMAP or nerfstudio recording are in metres. Default: their unit is unknown
    until 'evercal align'."""
    every: Annotated[int, arg(metavar="N")] = 1
    """Use every N-th image."""

    def recording(self, path: Path, name: str | None = None) -> "Recording":
        """Read the recording.

        Raises:
            InputError: It cannot be read, or an option does not apply to its format.
        """
        from evercal.recordings import ReadOptions, load_recording

        given = {field.name: getattr(self, field.name) for field in fields(ReadOptions)}
        return load_recording(path, self.format, name, ReadOptions(**given))

    def words(self) -> list[str]:
        """The options that were given, as words of a command."""
        words = []
        for field in fields(self):
            if (value := getattr(self, field.name)) != field.default:
                words.append("--" + field.name.replace("_", "-"))
                words += [] if value is True else [str(value)]
        return words
