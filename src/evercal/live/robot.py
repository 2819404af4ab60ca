"""Where gripper poses come from while a robot runs.

A robot is any object with `base_from_gripper()`. One that can move on request also has `move_to`. A
robot of any maker is connected by a file that its own program appends poses to.
"""

import time
from pathlib import Path
from typing import Protocol, runtime_checkable

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.robot_poses import read_last_robot_pose
from evercal.robot.frame_names import UNKNOWN, FrameNames


@runtime_checkable
class Robot(Protocol):
    """A robot that states the pose of its gripper."""

    def base_from_gripper(self) -> SE3:
        """Current pose of the gripper in the base frame, a single transform, metres."""
        ...


@runtime_checkable
class MovingRobot(Robot, Protocol):
    """A robot that moves on request."""

    def move_to(self, base_from_gripper: SE3) -> None:
        """Move to a pose and return once the gripper stands still, or raise InputError."""
        ...


@runtime_checkable
class TimedRobot(Robot, Protocol):
    """A robot that remembers where its gripper was."""

    def at(self, stamp_s: float) -> SE3:
        """Pose of the gripper when an image was taken, by the clock of the images."""
        ...


class PoseFileRobot:
    """A robot read from a table (CSV, TUM) or JSON lines that another program appends to.

    The last complete line counts. The file may appear later. `convention`, such as `kuka`, is that
    of numbers without a header. A file that was last changed more than `most_age_s` seconds ago is
    refused as stale, as is one that was changed in the future.
    """

    def __init__(
        self,
        path: Path | str,
        convention: str | None = None,
        most_age_s: float | None = None,
        frames: FrameNames = UNKNOWN,
    ):
        self._path = Path(path)
        self._convention = convention
        self._most_age_s = most_age_s
        self.frames = frames
        """Names of the frames, which the file does not state."""

    def base_from_gripper(self) -> SE3:
        """Read the pose of the last complete line; InputError without such a line."""
        pose = read_last_robot_pose(self._path, self._convention)
        if self._most_age_s is not None:
            # First: it may be written at any time.
            changed_s = self._path.stat().st_mtime
            age = time.time() - changed_s
            if age < 0:
                raise InputError(
                    f"{self._path}: last written {-age:.1f} s in the future; set the clocks of this"
                    " machine and of the one that writes it"
                )
            if age > self._most_age_s:
                raise InputError(
                    f"{self._path}: last written {age:.1f} s ago, at most {self._most_age_s:g} s"
                    " are allowed; check the program that writes it"
                )
        return pose
