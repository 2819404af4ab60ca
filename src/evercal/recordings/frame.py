"""What every dataset yields: frames with a camera and poses, in scenes with a train/test split."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.images import StoredImage, read_image

MIN_TRAIN_FRAMES = 16
"""Posed training frames that a scene needs to be learned."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One image and what is known about it."""

    name: str
    """Unique within its scene."""
    image: Path | NDArray[np.uint8] | StoredImage
    """A file, (H, W, 3) uint8 RGB, or one inside a bag or video."""
    camera: Camera
    """Intrinsics at the size of `image`."""
    base_from_camera: SE3 | None
    """Camera pose in the scene's base frame; None if it is not known."""
    base_from_gripper: SE3 | None = None
    """Gripper pose in the robot's base frame when the image was taken; None if there is no arm."""
    depth: Path | None = None
    """16-bit PNG of the image's size: millimetres along the optical axis, 0 where unknown."""
    joints_rad: tuple[float, ...] | None = None
    """The arm's joint angles when the image was taken."""

    def read_image(self) -> NDArray[np.uint8]:
        """Reads the pixels.

        Returns:
            (H, W, 3) uint8 RGB.

        Raises:
            InputError: The file is missing or broken, or its size is not the camera's.
        """
        image = self.image
        if isinstance(image, Path):
            image = read_image(image)
        elif isinstance(image, StoredImage):
            image = image.read()
        if image.shape[:2] != (self.camera.height, self.camera.width):
            where = self.image if isinstance(self.image, Path) else self.name
            raise InputError(
                f"{where}: image is {image.shape[1]}x{image.shape[0]}, its camera"
                f" {self.camera.width}x{self.camera.height}; give the intrinsics of this image size"
            )
        return image


def posed_frames(frames: Iterable[Frame]) -> tuple[Frame, ...]:
    """The frames whose pose is known."""
    return tuple(frame for frame in frames if frame.base_from_camera is not None)


def stated_poses(frames: Iterable[Frame]) -> SE3:
    """(n,) base_from_camera of the frames that have one."""
    return SE3.stack([f.base_from_camera for f in frames if f.base_from_camera is not None])


@dataclass(frozen=True, eq=False)
class Recording:
    """One place: frames in the order they were recorded, all poses in one base frame."""

    name: str
    """What the scene is called."""
    train: tuple[Frame, ...]
    """Frames to learn from."""
    test: tuple[Frame, ...]
    """Frames to score on; never learned from."""
    untracked: int = 0
    """How many recorded frames were left out because they have no valid pose."""
    base: str | None = None
    """What its base frame is called, where scenes share one; None if it is the scene's own."""
    notes: tuple[str, ...] = ()
    """What its reader chose, left out or could not know, one sentence each."""


def posed_recording(scene: Recording) -> Recording:
    """The scene without training frames that have no pose, which count as untracked."""
    train = posed_frames(scene.train)
    lost = len(scene.train) - len(train)
    return replace(scene, train=train, untracked=scene.untracked + lost)
