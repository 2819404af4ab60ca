"""`Export`: the input of every format writer, prepared from a calibration and `ExportOptions`."""

import os
import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.export.driver_frame import (
    read_link_from_optical,
    standard_link_from_optical,
)
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.poses.conventions import numbers_from_poses, pose_convention
from evercal.recordings.poses.robot_poses import RobotPoses, read_robot_poses

if TYPE_CHECKING:
    from evercal.calibration.calibration import Calibration

PoseSource: TypeAlias = RobotPoses | str | os.PathLike[str] | None

# tf itself refuses only empty names and a leading slash; blanks, quotes and brackets would break
# the shell commands, launch files and XML that hold the names.
_FRAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]*(/[A-Za-z0-9_.\-]+)*")


class ExportOptions(TypedDict, total=False):
    """Options of an export; all may be omitted."""

    parent: str | None
    """New name of the parent frame."""
    child: str | None
    """New name of the child frame."""
    via: str | None
    """Root frame of the camera driver, which becomes the child frame."""
    via_transform: str | os.PathLike[str] | None
    """File with the transforms between the root frame and the optical frame."""
    via_offset: tuple[float, float, float] | None
    """Origin of the optical frame in the root frame: forward, left, up, metres."""
    via_optical: bool
    """Whether the two frames share their origin."""
    robot_frame: str | None
    """The robot frame that is not the parent: the gripper for eye_to_hand, else the base."""
    robot_poses: PoseSource
    """base_from_gripper of every image, or a file of them."""
    target_poses: PoseSource
    """camera_from_target of every image, or a file of them."""
    convention: str | None
    """Pose convention of the file of robot poses."""


@dataclass(frozen=True, eq=False)
class Export:
    """A calibration with what a format writer may need, see `ExportOptions`."""

    calibration: "Calibration"
    """Calibration with the exported frames."""
    name: str
    """Name of the calibration in easy_handeye."""
    robot_frame: str | None
    robot_poses: RobotPoses | None
    target_poses: RobotPoses | None

    @property
    def parent(self) -> str:
        """Name of the parent frame."""
        return self.calibration.parent_frame

    @property
    def child(self) -> str:
        """Name of the child frame."""
        return self.calibration.child_frame

    @property
    def in_hand(self) -> bool:
        """Whether the gripper carries the camera."""
        return self.calibration.mount == "eye_in_hand"

    @property
    def pose(self) -> SE3:
        """parent_from_child, metres."""
        return self.calibration.parent_from_child

    @property
    def camera(self) -> Camera:
        """Intrinsics; raises InputError if the calibration has no intrinsics."""
        if self.calibration.camera is None:
            raise InputError("intrinsics are required, but this calibration holds no camera")
        return self.calibration.camera

    @property
    def comment(self) -> str:
        """Meaning of the numbers; the frame names in it are safe in any file."""
        return f"{self.calibration.meaning}. Written by evercal."

    def numbers(self, convention: str = "xyzw") -> list[float]:
        """The pose as numbers of a convention."""
        return pose_numbers(self.pose, convention).tolist()


def pose_numbers(poses: SE3, convention: str = "xyzw") -> NDArray[np.float64]:
    """Return (...) poses as numbers (..., k) of a convention, without negative zeros."""
    return numbers_from_poses(poses, pose_convention(convention)) + 0.0


def prepare_export(
    calibration: "Calibration", name: str = "evercal", **options: Unpack[ExportOptions]
) -> Export:
    """Rename the frames, move the pose to the driver's root frame, and read the files."""
    parent = options.get("parent") or calibration.parent_frame
    child = options.get("child") or calibration.child_frame
    link, other = options.get("via"), options.get("robot_frame")
    if parent in (child, link):
        raise InputError(f"parent and child frame are both called {parent!r}; rename one of them")
    link_from_optical = _link_from_optical(child, options)
    for role, frame in {"parent": parent, "child": link or child, "robot": other}.items():
        if frame is not None and not _FRAME.fullmatch(frame):
            raise InputError(
                f"{role} frame {frame!r} is no name of a tf frame; use letters, digits, _ . - and"
                f" inner /, such as 'camera_color_optical_frame' (rename with --parent or --child)"
            )
    calibration = replace(calibration, parent_frame=parent, child_frame=link or child)
    if link is not None:
        moved = calibration.uncertain_pose @ link_from_optical.inverse()
        pose, covariance = moved.pose, moved.covariance
        calibration = replace(calibration, parent_from_child=pose, covariance=covariance)
    robot, target = options.get("robot_poses"), options.get("target_poses")
    if robot is not None and not isinstance(robot, RobotPoses):
        what, convention = "file of robot poses", options.get("convention")
        robot = read_robot_poses(robot, convention, what=what, option="--convention")
    if target is not None and not isinstance(target, RobotPoses):
        target = read_robot_poses(target, what="file of target poses", option=None)
    return Export(calibration, name, other, robot, target)


def _link_from_optical(optical: str, options: ExportOptions) -> SE3:
    link, file, offset = (options.get(key) for key in ("via", "via_transform", "via_offset"))
    sources = (file is not None) + (offset is not None) + options.get("via_optical", False)
    if link is None and sources:
        raise InputError("name the driver's root frame with --via, such as camera_link")
    if link is not None and sources != 1:
        raise InputError(
            f"--via {link} needs the pose of the optical frame in it; give one of --via-transform"
            f" FILE, --via-offset X Y Z, or --via-optical if their origins are the same"
        )
    if link is not None and file is not None:
        return read_link_from_optical(file, link, optical)
    return standard_link_from_optical(offset or (0.0, 0.0, 0.0))
