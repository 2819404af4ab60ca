"""A recording with gripper poses that grows sample by sample, in the format `wrist`.

    ROOT/images/0000.jpg, ...     one image of each sample
    ROOT/base_from_gripper.csv    its gripper pose
    ROOT/camera.json              intrinsics of the camera
    ROOT/frames.json              names of base, gripper and camera, where they are known

The table is replaced as a whole after every change, so that the folder is a valid recording at any
time. A folder that was begun earlier is continued.
"""

import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.formats import wrist
from evercal.recordings.frame import Frame, stated_grippers
from evercal.recordings.images import write_jpeg
from evercal.recordings.read_options import ReadOptions
from evercal.robot.frame_names import UNKNOWN, FrameNames
from evercal.storage import write_bytes, write_json
from evercal.storage.text_files import is_link
from evercal.typing import Image

POSES = "base_from_gripper.csv"
"""File name of the gripper poses."""
JPEG_QUALITY = 95
"""Quality of the images, as of libjpeg."""
_NUMBER = re.compile("[0-9]{1,9}")
"""A name that counts; cameras write longer ones, such as times."""
_COLUMNS = "x,y,z,qw,qx,qy,qz"
"""Columns of a pose: metres, then the quaternion."""


class WristRecorder:
    """Adds and removes samples of a recording; one of the same camera is continued."""

    def __init__(self, root: Path, camera: Camera, names: FrameNames = UNKNOWN):
        self._root = Path(root)
        self._camera = camera
        self.names = names
        """Frames, as far as they are known when the first sample is added."""
        self._frames: list[Frame] = []
        require_own(self._root / "images")
        if wrist.detect(self._root):
            if not (self._root / POSES).is_file():
                raise InputError(
                    f"{root}: holds gripper poses, but no {POSES}; use a new folder"
                )
            begun = wrist.load(self._root, ReadOptions())
            self.names = names.or_of(begun.frames)
            if self.names != begun.frames.or_of(names):
                raise InputError(
                    f"{root}: was recorded with other frames; use a new folder"
                )
            self._frames = list(begun.train)
            if any(frame.camera != camera for frame in self._frames):
                raise InputError(
                    f"{root}: was recorded with other intrinsics; use a new folder"
                )

    @property
    def frames(self) -> tuple[Frame, ...]:
        """The samples in recorded order."""
        return tuple(self._frames)

    def add(self, image: Image, base_from_gripper: SE3) -> Frame:
        """Write a sample and return it, or raise InputError for an image of another size."""
        if image.shape != (self._camera.height, self._camera.width, 3):
            raise InputError(
                f"image of shape {image.shape}: the camera is {self._camera.width}x"
                f"{self._camera.height}; give the intrinsics of this image size"
            )
        if not self._frames:
            (self._root / "images").mkdir(parents=True, exist_ok=True)
            write_json(self._root / "camera.json", asdict(self._camera))
            if self.names != UNKNOWN:
                write_json(self._root / wrist.NAMES, asdict(self.names))
        images = self._root / "images"
        path = images / next_name(images)
        write_jpeg(path, image, JPEG_QUALITY)
        frame = Frame(path.name, path, self._camera, None, base_from_gripper)
        self._frames.append(frame)
        self._write_poses()
        return frame

    def remove(self, name: str) -> None:
        """Remove a sample by name; InputError if it does not exist."""
        left = [frame for frame in self._frames if frame.name != name]
        if len(left) == len(self._frames):
            raise InputError(f"{name}: no such sample in {self._root}")
        self._frames = left
        self._write_poses()
        (self._root / "images" / name).unlink(missing_ok=True)

    def _write_poses(self) -> None:
        path = self._root / POSES
        if self._frames:
            poses = stated_grippers(self._frames)
            names = [frame.name for frame in self._frames]
            write_bytes(path, pose_rows(poses, names).encode())
        else:
            path.unlink(missing_ok=True)


def require_own(folder: Path) -> None:
    """Refuse a folder that is a link: files that are removed there may be another recording's."""
    if is_link(folder):
        raise InputError(f"{folder}: is a link; use a new folder")


def next_name(folder: Path) -> str:
    """File name of the next image: one more than the largest number among the names."""
    number = 0
    for path in folder.iterdir():
        if _NUMBER.fullmatch(path.stem):
            number = max(number, int(path.stem) + 1)
    return f"{number:04d}.jpg"


def pose_rows(poses: SE3, names: Sequence[str] = ()) -> str:
    """A table of (n,) poses, with a column of (n,) image names if given."""
    rows = [_COLUMNS]
    for pose in poses:
        numbers = (*pose.translation_m, *pose.rotation_wxyz)
        rows.append(",".join(map("{:.8f}".format, numbers)))
    if names:
        rows = list(map("{},{}".format, ("image", *names), rows))
    return "\n".join(rows) + "\n"
