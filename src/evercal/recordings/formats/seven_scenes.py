"""The folder layout of Microsoft's 7-Scenes, see docs/formats.md.

Without an intrinsics file the focal length is 525 pixels at 640x480, as is usual, scaled with the
image size, and the principal point is the middle of the image. All sequences come from one camera.
"""

import re
from collections.abc import Sequence
from pathlib import Path

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.recordings.cameras.camera_file import centred_camera, read_camera_of_size
from evercal.recordings.formats.tracked_frames import frame_key, tracked_recording
from evercal.recordings.frame import Recording
from evercal.recordings.images import files_in, first_size
from evercal.recordings.read_options import ReadOptions
from evercal.storage.text_files import named_errors, read_text, refuse_repeated

_SPLITS = ("TrainSplit.txt", "TestSplit.txt")
"""Files that list sequences."""
_FOCAL_AT_640 = 525.0
"""Focal length at 640x480, pixels."""


def detect(root: Path) -> bool:
    """Whether `root` looks like this format, even if it is damaged."""
    if not root.is_dir():
        return False
    has_split = any((root / split).is_file() for split in _SPLITS)
    return has_split or any(root.glob("seq-*/"))


def load(root: Path, options: ReadOptions) -> Recording:
    """Read split files and poses, and the size of one image; no other image is opened."""
    folders: list[Path] = []
    splits: list[list[Path]] = []
    split = options.split
    for name in _SPLITS:
        images: list[Path] = []
        for folder in _sequences(root, name, split):
            if folder in folders:
                raise InputError(
                    f"{root}: {folder.name} comes twice in {' and '.join(_SPLITS)}; keep one"
                )
            folders.append(folder)
            images += colour_images(folder)
        splits.append(images)
    if not folders:
        raise InputError(
            f"{root}: {' and '.join(_SPLITS)} are empty; name a sequence in one"
        )
    camera = _camera(root, splits[0] + splits[1])
    return tracked_recording(root, root.resolve().name, splits, camera, options.poses)


def _sequences(root: Path, name: str, split: str | None) -> list[Path]:
    file = root / name
    if split and not file.exists():
        return sorted(root.glob("seq-*/")) if name == _SPLITS[0] else []
    text = read_text(
        file,
        "split file",
        "write lines like 'sequence1' for the seq-XX folders, or give `split` 4:1 for a test frame"
        " after every four",
    )
    folders = []
    for line in filter(None, map(str.strip, text.splitlines())):
        match = re.fullmatch(r"(?:sequence|seq-?)?(\d+)", line, re.IGNORECASE)
        if not match:
            raise InputError(
                f"{file}: cannot read line {line!r}; a line looks like 'sequence1'"
            )
        folder = root / f"seq-{int(match[1]):02d}"
        if not folder.is_dir():
            raise InputError(
                f"{file}: line {line!r} names {folder.name}, which is not in {root}"
            )
        folders.append(folder)
    return folders


def _camera(root: Path, images: Sequence[Path]) -> Camera:
    size = first_size(images)
    file = root / "camera-intrinsics.txt"
    if file.exists():
        return read_camera_of_size(file, size, images[0].name)
    return centred_camera(_FOCAL_AT_640 * max(size) / 640, size)


def colour_images(folder: Path) -> list[Path]:
    """Colour images of a folder, sorted by name."""
    endings = (".color.png", ".color.jpg", ".color.jpeg")
    images = files_in(folder, endings)
    if not images:
        raise InputError(
            f"{folder}: no images; expected frame-XXXXXX.color.png or .jpg"
        )
    with named_errors(folder, "images"):
        names = [frame_key(image.name) for image in images]
        refuse_repeated(names, "keep its .png or its .jpg")
    return images
