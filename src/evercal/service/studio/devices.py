"""What the studio is connected to, and the newest image and pose of each."""

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.live.camera import LiveCamera
from evercal.live.robot import Robot
from evercal.live.sampling import sample
from evercal.robot.frame_names import UNKNOWN, FrameNames
from evercal.typing import Array, Image

Which = Literal["wrist", "fixed"]


@frozen_arrays
class Devices:
    """Cameras and the robot."""

    wrist_camera: LiveCamera | None
    """The camera on the gripper; None where only a fixed camera is calibrated."""
    intrinsics: Camera
    """Its intrinsics, at the size of its images; without it, those of the fixed camera."""
    robot: Robot
    """It moves on request if it is a `MovingRobot`."""
    fixed_camera: LiveCamera | None = None
    fixed_intrinsics: Camera | None = None
    """Intrinsics of the fixed camera; None if both cameras have the same."""
    reachable: SE3 | None = None
    """(n,) gripper poses that the arm can reach; None if unknown."""
    holding: SE3 | None = None
    """(n,) gripper poses at which the fixed camera sees what the gripper holds; None if unknown."""
    hold: Callable[[bool], None] = lambda _: None
    """Lets a virtual gripper hold something or let go; a real one is loaded by hand."""
    rough: SE3 | None = None
    """A rough gripper_from_camera."""
    arm: Callable[[], Array] | None = None
    """Points (k, 3) along the arm in the base frame, for the drawing."""
    settle_s: float = 0.8
    """Time from a motion on request to a sample, seconds: images arrive late from networks and USB,
    and would show the arm on its way."""
    live: bool = True
    """Whether images are shown all the time; those of a file are read for samples only."""

    @property
    def cameras(self) -> dict[Which, LiveCamera]:
        """The cameras that were given, that on the gripper first."""
        cameras: dict[Which, LiveCamera] = {}
        if self.wrist_camera is not None:
            cameras["wrist"] = self.wrist_camera
        if self.fixed_camera is not None:
            cameras["fixed"] = self.fixed_camera
        return cameras


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
        first = next(iter(self.devices.cameras))
        have = first in self.images and self.base_from_gripper is not None
        return have and not self.problems.keys() & {first, "robot"}

    def look(self, which: Which | None = "wrist") -> None:
        """Read the pose and an image of one camera, or none; failures are kept in `problems`."""
        try:
            self._pose()
        except (InputError, OSError) as error:
            self.problems["robot"] = str(error)
        if which is None:
            return
        try:
            self.image(which)
        except (InputError, OSError) as error:
            self.problems[which] = str(error)

    def frames(self, which: Which) -> FrameNames:
        """Names of frames, as far as the robot and the images of a camera state them.

        The name that was given with the robot's is that of the first camera.
        """
        names = getattr(self.devices.robot, "frames", UNKNOWN)
        camera = getattr(self.devices.cameras[which], "frame_id", "")
        if not camera and which == next(iter(self.devices.cameras)):
            camera = names.camera
        return replace(names, camera=camera)

    def image(self, which: Which) -> Image:
        """Read an image."""
        return self._read(which)[1]

    def sample(self, which: Which = "wrist") -> tuple[Image, SE3]:
        """Read an image, of a fixed camera one of a held thing, and the pose of the gripper."""
        self.devices.hold(which == "fixed")
        image, pose = sample(lambda: self._read(which), self.devices.robot)
        self.base_from_gripper = pose
        self.problems.pop("robot", None)
        return image, pose

    def _read(self, which: Which) -> tuple[float, Image]:
        camera = self.devices.cameras.get(which)
        if camera is None:
            option = {"wrist": "`camera`", "fixed": "`fixed`"}[which]
            raise InputError(
                f"no {which} camera was given; restart with {option} SOURCE"
            )
        with self._lock:
            stamp_s, self.images[which] = camera.read()
        self.problems.pop(which, None)
        return stamp_s, self.images[which]

    def _pose(self) -> SE3:
        pose = self.devices.robot.base_from_gripper()
        self.base_from_gripper = pose
        self.problems.pop("robot", None)
        return pose
