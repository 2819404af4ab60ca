"""`load_recording`: recognise the format of a recording and read it."""

import dataclasses
import importlib
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from evercal.errors import InputError
from evercal.recordings.frame import Recording, with_images
from evercal.recordings.read_options import ReadOptions, flag
from evercal.storage.text_files import named_errors
from evercal.typing import PathLike


@dataclass(frozen=True)
class Format:
    """Recognition and reader of one format; its module is loaded on first use."""

    module: str
    """Module of `recordings.formats` with functions `detect` and `load`."""
    contents: str
    """Files that identify it, for messages."""

    @property
    def reader(self) -> ModuleType:
        """The module."""
        return importlib.import_module(f"evercal.recordings.formats.{self.module}")

    @property
    def uses(self) -> tuple[str, ...]:
        """Fields of `ReadOptions` that it uses, apart from `every`."""
        return getattr(self.reader, "USES", ())


FORMATS = {
    "generic": Format("generic", "scene.json"),
    "7scenes": Format(
        "seven_scenes", "TrainSplit.txt, TestSplit.txt and seq-XX folders"
    ),
    "12scenes": Format("twelve_scenes", "info.txt and data"),
    "nerfstudio": Format("nerfstudio", "transforms.json"),
    "colmap": Format("colmap", "sparse/0 with cameras and images"),
    "wrist": Format(
        "wrist", "images beside base_from_gripper.csv, joints.csv, base_from_camera.csv"
    ),
    "lerobot": Format("lerobot", "meta/info.json"),
    "rosbag": Format("ros_bag", "a .bag or .mcap file or bag folder"),
}
"""All formats by name, in the order in which they are tried."""


def recognised(root: Path) -> str | None:
    """The format that the files of a folder or a bag are of; None if they are of none."""
    return next(
        (key for key, entry in FORMATS.items() if entry.reader.detect(root)), None
    )


def load_recording(
    path: PathLike,
    format: str | None = None,
    name: str | None = None,
    options: ReadOptions | None = None,
) -> Recording:
    """Read a folder or a bag file.

    Args:
        path: Folder of the recording, or a bag file.
        format: One of `FORMATS`. If omitted, it is recognised from the files.
        name: Name of the scene. If omitted, the name in the file or of the folder.
        options: Information that the recording lacks.

    Raises:
        InputError: The recording is missing or broken, or its format is unknown or does not use an
            option that was given.
    """
    root = Path(path)
    options = options or ReadOptions()
    if format is not None and format not in FORMATS:
        raise InputError(
            f"format {format!r} is not known; use one of {', '.join(FORMATS)}"
        )
    if not root.exists():
        raise InputError(f"{root}: no such folder; give the folder of a recorded scene")
    if format is None:
        format = recognised(root)
    if format is None:
        what = (
            "no known scene format"
            if root.is_dir()
            else "a file, not a folder, and no bag"
        )
        known = ", ".join(f"{entry.contents} ({key})" for key, entry in FORMATS.items())
        raise InputError(f"{root}: {what}; expected {known}")
    if options.every < 1:
        raise InputError(f"--every {options.every}: give a number >= 1")
    read = FORMATS[format].reader.load
    uses = FORMATS[format].uses
    for given in options.given():
        if given not in ("every", *uses):
            users = [key for key, entry in FORMATS.items() if given in entry.uses]
            raise InputError(
                f"{flag(given)}: not used by recordings of format {format}, only by"
                f" {', '.join(users)}; leave it out"
            )
    recording = read(root, options) if uses else read(root)
    if options.every > 1:
        train, test = (
            part[:: options.every] for part in (recording.train, recording.test)
        )
        recording = dataclasses.replace(recording, train=train, test=test)
    with named_errors(root, "recording"):
        recording = with_images(recording, root if root.is_dir() else root.parent)
    if (root / "masks").is_dir():
        from evercal.recordings.masks import with_masks

        recording = with_masks(recording, root)
    return recording if name is None else dataclasses.replace(recording, name=name)
