"""What a user may tell the reader of a recording that the recording does not say itself."""

from dataclasses import dataclass, fields
from pathlib import Path


@dataclass(frozen=True)
class ReadOptions:
    """Choices for reading a recording; a format uses some of them and refuses the others."""

    camera: Path | None = None
    """File of the intrinsics of all images, as `read_camera` takes them; None for those that the
    recording has."""
    image_topic: str | None = None
    """Which images: a topic of a bag, or a camera's key in a LeRobot dataset; None for the only
    one."""
    pose_topic: str | None = None
    """The tf or joint state topic of a bag that holds where several say where the arm was; None
    where each frame or joint is on one only."""
    base_frame: str | None = None
    """The robot's base: a tf frame of a bag or a link of the URDF; None for the usual one."""
    gripper_frame: str | None = None
    """What carries the camera or the target: a tf frame, a link of the URDF, or a feature or arm of
    a LeRobot dataset; None for the usual one."""
    urdf: Path | None = None
    """The robot's URDF, where the recording has joint angles; None for the one beside them."""
    pose_convention: str | None = None
    """How a pose file is written, a name that `read_robot_poses` knows; of joint angles rad or deg.
    None where the file says so."""
    every: int = 1
    """Every how manyeth image is taken, 1 for all; of use for video."""

    def given(self) -> tuple[str, ...]:
        """The names of the fields that are not at their defaults."""
        return tuple(f.name for f in fields(self) if getattr(self, f.name) != f.default)


def flag(name: str) -> str:
    """How the command line writes a field: `image_topic` is `--image-topic`."""
    return "--" + name.replace("_", "-")
