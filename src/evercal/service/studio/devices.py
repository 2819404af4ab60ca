"""What the studio is connected to, and the newest image and pose of each."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_distance_mm_deg
from evercal.live.camera import LiveCamera
from evercal.live.robot import MovingRobot, Robot

Image = NDArray[np.uint8]
Which = Literal["wrist", "fixed"]

STILL_MM, STILL_DEG = 0.2, 0.05
"""The arm stands still while its stated pose changes by less."""


@dataclass(frozen=True, eq=False)
class Devices:
    """Cameras and the robot."""

    wrist_camera: LiveCamera
    """The camera on the gripper."""
    intrinsics: Camera
    """Its intrinsics, at the size of its images."""
    robot: Robot
    fixed_camera: LiveCamera | None = None
    fixed_intrinsics: Camera | None = None
    """Those of the fixed camera; None for those of the camera on the gripper."""
    reachable: SE3 | None = None
    """(n,) gripper poses that the arm can reach; None if unknown."""
    rough: SE3 | None = None
    """A rough gripper_from_camera."""
    arm: Callable[[], NDArray[np.floating]] | None = None
    """Points (k, 3) along the arm in the base frame, for the drawing."""
    settle_s: float = 0.8
    """Time from a motion on request to a sample, seconds: images arrive late from networks and USB,
    and would show the arm on its way."""
    live: bool = True
    """Whether images are shown all the time; those of a file are read for samples only."""

    @property
    def can_move(self) -> bool:
        """Whether the arm moves on request."""
        return isinstance(self.robot, MovingRobot)


@dataclass(frozen=True, eq=False)
class Seen:
    """What arrived last."""

    image: Image | None = None
    """Of the camera on the gripper."""
    fixed: Image | None = None
    """Of the fixed camera."""
    base_from_gripper: SE3 | None = None
    still_since: float = 0.0
    """Time of the last change of the pose, seconds of the monotonic clock."""
    camera_problem: str = ""
    """Reason why there is no image of the camera on the gripper; empty if there is one."""
    fixed_problem: str = ""
    """The same for the fixed camera."""
    robot_problem: str = ""
    """The same for the pose."""

    @property
    def complete(self) -> bool:
        """Whether image and pose have arrived and nothing failed since."""
        have = self.image is not None and self.base_from_gripper is not None
        return have and not (self.camera_problem or self.robot_problem)

    def still_s(self) -> float:
        """How long the arm has stood still, seconds."""
        return 0.0 if self.base_from_gripper is None else time.monotonic() - self.still_since


class Connection:
    """Reads cameras and robot, one caller at a time.

    Args:
        devices: cameras and robot.
    """

    def __init__(self, devices: Devices):
        self.devices = devices
        self.seen = Seen()
        self._lock, self._state = threading.Lock(), threading.Lock()

    def look(self, which: Which | None = "wrist") -> Seen:
        """Read the pose and an image of one camera, or none; problems are part of the answer."""
        self._keep_pose()
        if which is not None:
            try:
                self.image(which)
            except (InputError, OSError) as error:
                problem = "camera_problem" if which == "wrist" else "fixed_problem"
                self._keep(**{problem: str(error)})
        return self.seen

    def image(self, which: Which) -> Image:
        """Read an image.

        Raises:
            InputError: There is no such camera, or it gives no image.
        """
        devices = self.devices
        camera = devices.wrist_camera if which == "wrist" else devices.fixed_camera
        if camera is None:
            raise InputError("no fixed camera was given; start the studio with --fixed SOURCE")
        with self._lock:
            image = camera.read()[1]
        if which == "wrist":
            self._keep(image=image, camera_problem="")
        else:
            self._keep(fixed=image, fixed_problem="")
        return image

    def sample(self) -> tuple[Image, SE3]:
        """Read an image of the camera on the gripper, and the pose at which it was taken.

        Raises:
            InputError: No image, no pose, or the arm moved meanwhile.
        """
        before = self.devices.robot.base_from_gripper()
        image = self.image("wrist")
        after = self.devices.robot.base_from_gripper()
        if moved(before, after):
            raise InputError("the arm moved while the image was taken; let it stand still")
        self._keep_pose()
        return image, after

    def _keep_pose(self) -> None:
        try:
            pose = self.devices.robot.base_from_gripper()
        except (InputError, OSError) as error:
            self._keep(robot_problem=str(error))
            return
        last, now = self.seen.base_from_gripper, time.monotonic()
        still = last is not None and not moved(last, pose)
        since = self.seen.still_since if still else now
        # The first pose stays, so that a slow motion is no rest.
        kept = last if still else pose
        self._keep(base_from_gripper=kept, still_since=since, robot_problem="")

    def _keep(self, **changes: object) -> None:
        with self._state:
            self.seen = replace(self.seen, **changes)  # pyright: ignore[reportArgumentType]


def moved(before: SE3, after: SE3) -> bool:
    """Whether the arm did not stand still between two poses."""
    millimetres, degrees = pose_distance_mm_deg(before, after)
    return bool(millimetres > STILL_MM or degrees > STILL_DEG)
