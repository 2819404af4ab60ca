"""What the studio is connected to, and the newest image and pose of each."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_distance_mm_deg
from evercal.live.camera import LiveCamera
from evercal.live.robot import Robot

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
    """It moves on request if it is a `MovingRobot`."""
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


class Connection:
    """Reads cameras and robot; raises `InputError` where one gives nothing."""

    def __init__(self, devices: Devices):
        self.devices = devices
        self.images: dict[Which, Image] = {}
        """The newest image of each camera."""
        self.problems: dict[str, str] = {}
        """Reasons why a camera or the `robot` gives nothing now."""
        self.base_from_gripper: SE3 | None = None
        self._lock = threading.Lock()

    @property
    def complete(self) -> bool:
        """Whether image and pose have arrived and nothing failed since."""
        have = "wrist" in self.images and self.base_from_gripper is not None
        return have and not self.problems.keys() & {"wrist", "robot"}

    def look(self, which: Which | None = "wrist") -> None:
        """Read the pose and an image of one camera, or none; failures are kept in `problems`."""
        for name in ("robot", which):
            try:
                if name == "robot":
                    self._pose()
                elif which is not None:
                    self.image(which)
            except (InputError, OSError) as error:
                self.problems[str(name)] = str(error)

    def image(self, which: Which) -> Image:
        """Read an image."""
        devices = self.devices
        camera = devices.wrist_camera if which == "wrist" else devices.fixed_camera
        if camera is None:
            raise InputError("no fixed camera was given; start the studio with --fixed SOURCE")
        with self._lock:
            self.images[which] = camera.read()[1]
        self.problems.pop(which, None)
        return self.images[which]

    def sample(self) -> tuple[Image, SE3]:
        """Read an image of the camera on the gripper, and the pose at which it was taken."""
        before, image, after = self._pose(), self.image("wrist"), self._pose()
        if _moved(before, after):
            raise InputError("the arm moved while the image was taken; let it stand still")
        return image, after

    def _pose(self) -> SE3:
        pose = self.devices.robot.base_from_gripper()
        self.base_from_gripper = pose
        self.problems.pop("robot", None)
        return pose


def _moved(before: SE3, after: SE3) -> bool:
    millimetres, degrees = pose_distance_mm_deg(before, after)
    return bool(millimetres > STILL_MM or degrees > STILL_DEG)
