"""Frames with camera and poses, in recordings with a split into training and test frames."""

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from evercal.bounds import bounds
from evercal.errors import InputError, is_plain
from evercal.geometry import SE3, Camera
from evercal.recordings.images import Picture, file_of, files_in, is_readable, pixels_of
from evercal.robot.frame_names import UNKNOWN, FrameNames
from evercal.storage.text_files import few
from evercal.typing import Floats, Image, Strings

if TYPE_CHECKING:
    from evercal.robot.arm import Arm

MIN_TRAIN_FRAMES = 8
"""Minimum number of training frames with a pose: a few views around one place."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One image with its camera and poses."""

    name: str
    """Unique within its recording."""
    image: Picture
    camera: Camera
    """Intrinsics at the size of `image`."""
    base_from_camera: SE3 | None = None
    """Camera pose in the base frame, if stated."""
    base_from_gripper: SE3 | None = None
    """Gripper pose in the robot's base frame at the time of the image, if there is an arm."""
    depth: Path | None = None
    """16-bit PNG of the image's size: millimetres along the optical axis, 0 where unknown."""
    joints_rad: Floats | None = None
    """Joint values of the arm at the time of the image, if stated: radians, or metres of sliding
    joints."""

    def read_image(self) -> Image:
        """Read the pixels, (H, W, 3) uint8 RGB; a size that is not the camera's is refused."""
        image = pixels_of(self.image)
        if image.shape[:2] != (self.camera.height, self.camera.width):
            where = file_of(self.image) or self.name
            raise InputError(
                f"{where}: image is {image.shape[1]}x{image.shape[0]}, its camera"
                f" {self.camera.width}x{self.camera.height}; give the intrinsics of this image size"
            )
        return image


def posed_frames(frames: Iterable[Frame]) -> tuple[Frame, ...]:
    """Frames with a camera pose."""
    return tuple(frame for frame in frames if frame.base_from_camera is not None)


def stated_poses(frames: Iterable[Frame]) -> SE3:
    """(n,) base_from_camera of the frames that have one."""
    return SE3.stack(
        [f.base_from_camera for f in frames if f.base_from_camera is not None]
    )


def stated_grippers(frames: Iterable[Frame]) -> SE3:
    """(n,) base_from_gripper of the frames that have one."""
    return SE3.stack(
        [f.base_from_gripper for f in frames if f.base_from_gripper is not None]
    )


@dataclass(frozen=True, eq=False)
class Recording:
    """Frames of one place in recorded order, with all poses in one base frame."""

    name: str
    train: tuple[Frame, ...]
    """Frames to learn from."""
    test: tuple[Frame, ...]
    """Frames to evaluate on; never learned from."""
    untracked: int = 0
    """Number of recorded frames left out for lack of a valid pose."""
    base: str | None = None
    """Name of the base frame, if several scenes share it."""
    notes: Strings = ()
    """Choices and omissions of the reader, one sentence each."""
    metric: bool = True
    """Whether lengths are metres; False where their unit is unknown, as in structure from motion.
    `base_from_camera` is then in that unit."""
    arm: "Arm | None" = None
    """Kinematics that `Frame.joints_rad` are values of, where gripper poses are computed."""
    frames: FrameNames = UNKNOWN
    """Names of the frames of its poses, where they are known."""
    convention: str = ""
    """Name of the convention of the numbers that its poses were read from, if there are any."""


def checked_name(name: str) -> str:
    """A name that a scene can have."""
    most = bounds().name_characters
    plain = all(map(is_plain, name)) and not re.search(r"[/\\=]", name)
    if not name.strip() or name.startswith(".") or len(name) > most or not plain:
        raise InputError(
            f"scene name {name[:most]!r}: give one of at most {most} characters that is not"
            " empty, does not begin with a dot and holds no slash, '=' or control character"
        )
    return name


def with_images(recording: Recording, folder: Path) -> Recording:
    """Leave out frames without a readable image file in `folder`; more than half are refused."""
    files = {}
    lost = {}
    for frame in (*recording.train, *recording.test):
        file = file_of(frame.image)
        if file:
            files[frame.name] = file
            if not is_readable(file):
                lost[frame.name] = file
    if not lost:
        return recording
    unused: set[Path] = set()
    if not next(iter(lost.values())).is_file():
        unused = {*files_in(folder, glob="**/*")}.difference(files.values())
    relative = partial(os.path.relpath, start=folder)
    names = [*map(relative, lost.values())]
    note = lost_images(names, len(files), map(relative, unused))
    kept = []
    for frames in (recording.train, recording.test):
        kept.append(tuple(frame for frame in frames if frame.name not in lost))
    notes = (*recording.notes, note)
    return replace(recording, train=kept[0], test=kept[1], notes=notes)


def lost_images(lost: Sequence[str], total: int, unused: Iterable[str] = ()) -> str:
    """A note of images that are left out, with one of `unused` files that the first may be."""
    words = f"{len(lost)} of {total} images are missing or unreadable"
    if 2 * len(lost) > total:
        raise ValueError(
            f"{words}: {few(lost, unused)}; restore them or take their entries out"
        )
    return f"{words} and left out: {few(lost, unused)}"


def posed_recording(recording: Recording) -> Recording:
    """Drop training frames without a pose and count them as untracked."""
    train = posed_frames(recording.train)
    lost = len(recording.train) - len(train)
    return replace(recording, train=train, untracked=recording.untracked + lost)


def lacks_camera_poses(recording: Recording) -> bool:
    """Whether a recording states gripper poses but no camera poses."""
    if posed_frames(recording.train):
        return False
    return any(frame.base_from_gripper is not None for frame in recording.train)
