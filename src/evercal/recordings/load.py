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
from evercal.recordings.held_out import split_again
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
    uses: Strings = ()
    """Fields of `ReadOptions` that its `load` takes, apart from `every`."""

    @property
    def reader(self) -> ModuleType:
        """The module."""
        return importlib.import_module(f"evercal.recordings.formats.{self.module}")


FORMATS: dict[FormatName, RecordingFormat] = {
    "generic": RecordingFormat("generic"),
    "7scenes": RecordingFormat("seven_scenes", ("poses",)),
    "12scenes": RecordingFormat("twelve_scenes", ("poses",)),
    "cambridge": RecordingFormat("cambridge", ("camera",)),
    "nerfstudio": RecordingFormat("nerfstudio", ("metres",)),
    "colmap": RecordingFormat("colmap", ("metres",)),
    "wrist": RecordingFormat(
        "wrist",
        ("camera", "urdf", "joint_map", "whole_robot", "pose_convention", "poses"),
    ),
    "lerobot": RecordingFormat(
        "lerobot",
        (
            "camera",
            "image_topic",
            "gripper_frame",
            "urdf",
            "joint_map",
            "whole_robot",
            "pose_convention",
        ),
    ),
    "rosbag": RecordingFormat(
        "ros_bag",
        (
            "camera",
            "image_topic",
            "pose_topic",
            "base_frame",
            "gripper_frame",
            "urdf",
            "joint_map",
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
    if not recognised(root) and options.poses not in ("original", "colour"):
        format = format or "wrist"
    format = format_of(root, format)
    uses = FORMATS[format].uses
    for option in options.given():
        if option not in ("every", "split", "unchecked_joints", *FRAMES, *uses):
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
        if options.split:
            recording = split_again(recording, options.split)
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
    inside: list[Path] = []
    for pattern in ("*", "*/*"):
        inside = inside or [*filter(recognised, sorted(root.glob(pattern)))]
    names = " or ".join(map(str, inside[:4]))
    if len(inside) == 1:
        names += f", or move what it holds to {root}"
    if inside:
        raise InputError(f"{root}: no recording, but it has some; give {names}")
    outer = root.resolve().parent
    if recognised(outer):
        raise InputError(f"{root}: a part of a recording; give {outer}")
    from evercal.recordings.near_misses import what_it_lacks

    raise InputError(f"{root}: {what_it_lacks(root)}")


vars(load_recording)["check"] = format_of
