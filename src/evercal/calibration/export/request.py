"""`Export`: what a writer of a format gets, and the names of frames that tf takes."""

import re
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.calibration import Calibration
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.robot_poses import RobotPoses

Content: TypeAlias = str | bytes | dict[str, str]
"""Text, bytes, or a folder of texts by file name."""

# tf itself refuses only empty names and a leading slash; blanks, quotes and brackets break the
# shell lines, launch files and XML that names stand in.
_FRAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]*(/[A-Za-z0-9_.\-]+)*")


@dataclass(frozen=True, eq=False)
class Export:
    """A calibration on its way into another program's file.

    Raises:
        InputError: A frame name that tf does not take.
    """

    calibration: Calibration
    """With the frame names that are written."""
    name: str = "evercal"
    """What easy_handeye files it under."""
    other_frame: str | None = None
    """The robot's frame that is not the parent: the gripper's for eye_to_hand, else the base."""
    robot_poses: RobotPoses | None = None
    """base_from_gripper of every image, for formats that hold them."""
    target_poses: RobotPoses | None = None
    """camera_from_target of every image, for formats that hold them."""
    optical: bool = True
    """Whether the child frame is the camera's optical frame, not the driver's root frame."""

    def __post_init__(self) -> None:
        check_frame(self.parent, "parent frame")
        check_frame(self.child, "child frame")
        if self.other_frame is not None:
            check_frame(self.other_frame, "robot frame")

    @property
    def parent(self) -> str:
        """Name of the parent frame."""
        return self.calibration.parent_frame

    @property
    def child(self) -> str:
        """Name of the child frame."""
        return self.calibration.child_frame

    @property
    def pose(self) -> SE3:
        """parent_from_child, metres."""
        return self.calibration.parent_from_child

    @property
    def sentence(self) -> str:
        """What the numbers mean, for a comment; the frame names in it are harmless anywhere."""
        return f"{self.calibration.meaning}. Written by evercal."


@dataclass(frozen=True, eq=False)
class CameraViews:
    """Where the camera was at every image that is written."""

    names: tuple[str, ...]
    """Of the images."""
    stamps_s: NDArray[np.float64]
    """(n,) seconds; counted from 0 where no stamps are known."""
    base_from_camera: SE3
    """(n,)."""


def check_frame(name: str, what: str) -> None:
    """Refuses what tf, or a file that it stands in, does not take.

    Raises:
        InputError: Empty, a leading slash, or characters other than letters, digits, _ . - and /.
    """
    if not _FRAME.fullmatch(name):
        raise InputError(
            f"{what} {name!r} is no name of a tf frame; use letters, digits, _ . - and / inside,"
            f" such as 'camera_color_optical_frame' (--parent and --child rename them)"
        )


def renamed(
    calibration: Calibration, parent: str | None = None, child: str | None = None
) -> Calibration:
    """The calibration with other frame names.

    Raises:
        InputError: One name for both.
    """
    parent, child = parent or calibration.parent_frame, child or calibration.child_frame
    if parent == child:
        raise InputError(f"parent and child frame are both called {parent!r}; rename one of them")
    return replace(calibration, parent_frame=parent, child_frame=child)


def camera_views(export: Export, form: str) -> CameraViews:
    """The camera's poses in the base, of a fixed camera or along the robot's poses.

    Args:
        export: what is written.
        form: the format, for messages.

    Raises:
        InputError: The camera is on the arm and no robot poses are given, or the calibration was
            moved to the driver's root frame, which has other axes than a camera.
    """
    require_optical(export, form)
    robot = export.robot_poses
    if export.calibration.mount == "eye_to_hand":
        used = tuple(image.name for image in export.calibration.images if image.used)
        names = used or (f"{export.child.replace('/', '_')}.png",)
        poses = SE3.stack([export.pose] * len(names))
        return CameraViews(names, np.arange(len(names), dtype=np.float64), poses)
    if robot is None:
        raise InputError(
            f"{form}: a camera on the arm has a pose in the base at every image only; give the"
            f" gripper's poses with --robot-poses"
        )
    count = len(robot)
    names = robot.names or tuple(f"{i:06d}.png" for i in range(count))
    stamps = np.arange(count, dtype=np.float64) if robot.stamps_s is None else robot.stamps_s
    return CameraViews(names, stamps, robot.poses @ export.pose)


def require_optical(export: Export, form: str) -> None:
    """Refuses the driver's root frame where a camera's axes are meant.

    Raises:
        InputError: The export is of the driver's root frame.
    """
    if not export.optical:
        raise InputError(
            f"{form} holds the pose of the camera itself, not of {export.child!r}; leave --via out"
        )
