"""`load_recording`: recognise the format of a recording and read it."""

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import NoReturn

from evercal.choices import FormatName
from evercal.classes import frozen
from evercal.errors import InputError
from evercal.recordings.frame import Recording, with_images
from evercal.recordings.images import files_in
from evercal.recordings.read_options import ReadOptions
from evercal.robot.frame_names import FrameNames
from evercal.storage.text_files import few, named_errors
from evercal.typing import PathLike, Strings

FRAMES = ("base_frame", "gripper_frame", "camera_frame")
"""Fields of `ReadOptions` that name frames, for all formats that do not choose by them."""
_ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".rar")
"""Endings of archives."""


@frozen
class RecordingFormat:
    """Recognition and reader of one format; its module is loaded on first use."""

    module: str
    """Module of `recordings.formats` with functions `detect` and `load`."""
    contents: str
    """Files that identify it, for messages."""
    uses: Strings = ()
    """Fields of `ReadOptions` that its `load` takes, apart from `every`."""

    @property
    def reader(self) -> ModuleType:
        """The module."""
        return importlib.import_module(f"evercal.recordings.formats.{self.module}")


FORMATS: dict[FormatName, RecordingFormat] = {
    "generic": RecordingFormat("generic", "scene.json"),
    "7scenes": RecordingFormat(
        "seven_scenes",
        "TrainSplit.txt, TestSplit.txt and seq-XX folders",
        ("poses",),
    ),
    "12scenes": RecordingFormat(
        "twelve_scenes", "info.txt, split.txt and data", ("poses",)
    ),
    "cambridge": RecordingFormat(
        "cambridge", "dataset_train.txt and dataset_test.txt", ("camera",)
    ),
    "nerfstudio": RecordingFormat("nerfstudio", "transforms.json", ("metres",)),
    "colmap": RecordingFormat(
        "colmap", "sparse/0 with cameras and images", ("metres",)
    ),
    "wrist": RecordingFormat(
        "wrist",
        "images beside base_from_gripper.csv, joints.csv, base_from_camera.csv",
        ("camera", "urdf", "whole_robot", "pose_convention"),
    ),
    "lerobot": RecordingFormat(
        "lerobot",
        "meta/info.json",
        (
            "camera",
            "image_topic",
            "gripper_frame",
            "urdf",
            "whole_robot",
            "pose_convention",
        ),
    ),
    "rosbag": RecordingFormat(
        "ros_bag",
        "a .bag or .mcap file or bag folder",
        (
            "camera",
            "image_topic",
            "pose_topic",
            "base_frame",
            "gripper_frame",
            "urdf",
            "whole_robot",
        ),
    ),
}
"""All formats by name, in the order in which they are tried."""


def recognised(root: Path) -> FormatName | None:
    """The format that the files of a folder or a bag are of; None if they are of none."""
    for name, entry in FORMATS.items():
        if entry.reader.detect(root):
            return name
    return None


@contextmanager
def naming_archives(path: Path) -> Iterator[None]:
    """Name archives at a path in the `InputError` of a recording that cannot be read.

    They are those in the folder, that of a missing folder, or the path itself. An archive beside a
    file or folder of its name is unpacked.
    """
    try:
        yield
    except InputError as error:
        folder = next(place for place in (path, *path.parents) if place.is_dir())
        wanted = {path, *path.parents}
        archives = []
        for file in files_in(folder, _ARCHIVES):
            content = folder / file.name.partition(".")[0]
            is_near = folder == path or not wanted.isdisjoint((file, content))
            if is_near and not content.exists():
                archives.append(file.name)
        if not archives:
            raise
        text = f"{error}; not unpacked: {few(archives)}; unpack in {folder}"
        raise InputError(text) from None


def load_recording(
    path: PathLike,
    format: FormatName | None = None,
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
    format = format_of(root, format)
    uses = FORMATS[format].uses
    for option in options.given():
        if option not in ("every", *FRAMES, *uses):
            users = [key for key, entry in FORMATS.items() if option in entry.uses]
            raise InputError(
                f"`{option}`: not used by recordings of format {format}, only by"
                f" {', '.join(users)}; leave it out"
            )
    load = FORMATS[format].reader.load
    with naming_archives(root):
        recording = load(root, options) if uses else load(root)
        if options.every > 1:
            train = recording.train[:: options.every]
            test = recording.test[:: options.every]
            recording = replace(recording, train=train, test=test)
        with named_errors(root, "recording"):
            folder = root if root.is_dir() else root.parent
            recording = with_images(recording, folder)
    names = [getattr(options, o) or "" if o not in uses else "" for o in FRAMES]
    frames = recording.frames.completed_by(FrameNames(*names), root)
    recording = replace(recording, frames=frames)
    if (root / "masks").is_dir():
        from evercal.recordings.masks import with_masks

        recording = with_masks(recording, root)
    if name is not None:
        recording = replace(recording, name=name)
    return recording


def format_of(root: Path, stated: FormatName | None = None) -> FormatName:
    """The format of a recording; one that is not known is refused."""
    if stated is not None and stated not in FORMATS:
        raise InputError(
            f"format {stated!r} is not known; use one of {', '.join(FORMATS)}"
        )
    with naming_archives(root):
        if not root.exists():
            raise InputError(
                f"{root}: no such folder; give the folder of a recorded scene"
            )
        return stated or recognised(root) or _refuse(root)


def _refuse(root: Path) -> NoReturn:
    """Say what a file or folder lacks to be a recording."""
    what = "a file, not a folder, and no bag"
    if root.is_dir():
        what = "no known scene format"
        inside = [path for path in sorted(root.iterdir()) if recognised(path)]
        names = " or ".join(map(str, inside[:4]))
        if len(inside) == 1:
            names += f", or move what it holds to {root}"
        if inside:
            raise InputError(f"{root}: no recording, but it has some; give {names}")
    known = ", ".join(f"{entry.contents} ({key})" for key, entry in FORMATS.items())
    raise InputError(f"{root}: {what}; expected {known}")


vars(load_recording)["check"] = format_of
