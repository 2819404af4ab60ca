"""The flags with which a verb reads a recording, the same for all that take one."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

if TYPE_CHECKING:
    from evercal.recordings import Recording


@dataclass(frozen=True)
class Reading:
    """How a recording is read; what a format has no use for is refused."""

    format: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """Format of the recording: generic, 7scenes, 12scenes, nerfstudio, colmap, wrist, lerobot or
    rosbag; it is recognised when left out."""
    camera: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """File of the intrinsics of all images, where the recording has none: 3x3 matrix as text, JSON,
    ROS camera_info YAML or OpenCV's storage."""
    image_topic: Annotated[str | None, arg(metavar="TOPIC", help_behavior_hint="")] = None
    """Which images of a bag or a LeRobot dataset; needed where there are several."""
    pose_topic: Annotated[str | None, arg(metavar="TOPIC", help_behavior_hint="")] = None
    """Which tf or joint states of a bag; needed where several topics say where the arm was."""
    base_frame: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """The robot's base, a tf frame of a bag or a link of the URDF."""
    gripper_frame: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """The gripper: a tf frame of a bag, a link of the URDF, or a feature or arm of a LeRobot
    dataset."""
    urdf: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """URDF of the robot, where the recording has joint angles and no poses."""
    pose_convention: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """How a file of gripper poses is written, where its header does not say; of joint angles rad or
    deg."""
    every: Annotated[int, arg(metavar="N", help_behavior_hint="")] = 1
    """Take every N-th image only."""

    def scene(self, path: Path, name: str | None = None) -> "Recording":
        """Reads the recording.

        Raises:
            InputError: It cannot be read, or a flag means nothing to its format.
        """
        from evercal.recordings import ReadOptions, load_recording

        given = {field.name: getattr(self, field.name) for field in fields(ReadOptions)}
        return load_recording(path, self.format, name, ReadOptions(**given))

    def words(self) -> list[str]:
        """The flags that were given, as words of a command."""
        found = []
        for field in fields(self):
            if (value := getattr(self, field.name)) != field.default:
                found += ["--" + field.name.replace("_", "-"), str(value)]
        return found
