"""The folder layout of Stanford's 12-Scenes (Valentin et al., 3DV 2016), read as it is.

    ROOT/split.txt                        first line `sequence0 [frames=357] ...`: the test frames
    ROOT/info.txt                         `m_calibrationColorIntrinsic = fx 0 cx 0 0 fy cy ...`
    ROOT/data/frame-000000.color.jpg
    ROOT/data/frame-000000.pose.txt       4x4 base_from_camera, metres

As the field does, the first sequence is tested on and the others are learned. Camera axes are
OpenCV's; the intrinsics are those of info.txt at the size it names, scaled to the images'. They are
taken as they stand, with pixel (0, 0) a centre: the data set states no convention, and its cy of
483.5 is the middle of 968 rows counted so. A pose with inf or nan marks a frame that was not
tracked: it is left out and counted.
"""

import os
import re
from pathlib import Path

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.images import image_size
from evercal.recordings.poses.pose_files import tracked_frames


def detect(root: Path) -> bool:
    """Whether `root` looks like this format, be it a damaged one."""
    return (root / "info.txt").is_file() and (root / "data").is_dir()


def load(root: str | os.PathLike[str]) -> Recording:
    """Reads split, calibration and poses, and the size of one image; no other image is opened.

    Raises:
        InputError: A file is missing or broken; the message names it.
    """
    root = Path(root)
    images = _images(root)
    tested = _tested(root, len(images))
    camera = _camera(root, images[0])
    train, test = (_frames(part, camera) for part in (images[tested:], images[:tested]))
    return Recording(root.resolve().name, train, test, len(images) - len(train) - len(test))


def _images(root: Path) -> list[Path]:
    folder = root / "data"
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; expected frame-XXXXXX.color.jpg in it")
    names = [name for name in os.listdir(folder) if re.search(r"\.color\.(jpe?g|png)$", name)]
    if not names:
        raise InputError(f"{folder}: no images; expected frame-XXXXXX.color.jpg")
    return [folder / name for name in sorted(names)]


def _tested(root: Path, frames: int) -> int:
    """How many of the frames, from the first on, are for testing."""
    file = root / "split.txt"
    text = _text(file, "its first line says '... [frames=N]'")
    match = re.search(r"\[frames=(\d+)\]", text.split("\n")[0])
    if match is None:
        raise InputError(f"{file}: the first line holds no '[frames=N]'")
    if int(match[1]) > frames:
        raise InputError(f"{file}: {match[1]} test frames, but {root / 'data'} has {frames} images")
    return int(match[1])


def _camera(root: Path, image: Path) -> Camera:
    file = root / "info.txt"
    text = _text(file, "it holds m_calibrationColorIntrinsic")
    found = dict(re.findall(r"^\s*(\w+)\s*=\s*(.+?)\s*$", text, re.MULTILINE))
    try:
        numbers = [float(word) for word in found["m_calibrationColorIntrinsic"].split()]
        fx, cx, fy, cy = numbers[0], numbers[2], numbers[5], numbers[6]
        size = int(found["m_colorWidth"]), int(found["m_colorHeight"])
        camera = Camera(*size, fx, fy, cx, cy)
    except (KeyError, ValueError, IndexError) as error:
        raise InputError(
            f"{file}: needs m_colorWidth, m_colorHeight and m_calibrationColorIntrinsic ({error!r})"
        ) from None
    return camera.resized(*image_size(image))


def _text(file: Path, holds: str) -> str:
    try:
        return file.read_text()
    except (OSError, UnicodeDecodeError):
        raise InputError(f"{file}: missing; {holds}") from None


def _frames(images: list[Path], camera: Camera) -> tuple[Frame, ...]:
    names = [image.name[: image.name.rindex(".color.")] for image in images]
    poses = [image.with_name(f"{name}.pose.txt") for image, name in zip(images, names, strict=True)]
    return tracked_frames(names, images, poses, camera)
