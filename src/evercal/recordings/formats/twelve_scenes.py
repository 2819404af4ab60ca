"""The folder layout of Stanford's 12-Scenes (Valentin et al., 3DV 2016), see docs/formats.md.

As is usual, the first sequence is for testing and the others are for training. The intrinsics of
info.txt are scaled to the image size. Pixel (0, 0) is taken as a pixel centre: the data set states
no convention, and its cy of 483.5 is then the middle of 968 rows.
"""

import re
from pathlib import Path

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.recordings.cameras.camera_file import camera_from_fields, fields_of
from evercal.recordings.formats.seven_scenes import colour_images
from evercal.recordings.formats.tracked_frames import tracked_recording
from evercal.recordings.frame import Recording
from evercal.recordings.images import first_size
from evercal.recordings.read_options import ReadOptions
from evercal.storage.text_files import named_errors, read_text


def detect(root: Path) -> bool:
    """Whether `root` looks like this format, even if it is damaged."""
    parts = map(root.joinpath, ("info.txt", "split.txt", "data"))
    return sum(map(Path.exists, parts)) > 1


def load(root: Path, options: ReadOptions) -> Recording:
    """Read split, calibration and poses, and the size of one image; no other image is opened."""
    images = colour_images(root / "data")
    split = _test_count(root, len(images))
    camera = _camera(root, images)
    if options.poses == "colour":
        raise InputError("`poses` colour is for 7-Scenes; here the cameras are one")
    place = root.resolve()
    name = f"{place.parent.name}_{place.name}"
    splits = (images[split:], images[:split])
    return tracked_recording(root, name, splits, camera, options.poses)


def _test_count(root: Path, frames: int) -> int:
    file = root / "split.txt"
    text = read_text(file, "split file", "its first line is '... [frames=N]'")
    match = re.search(r"\[frames=(\d+)\]", text.split("\n")[0])
    if not match:
        raise InputError(f"{file}: the first line holds no '[frames=N]'")
    count = int(match[1])
    if count > frames:
        raise InputError(
            f"{file}: {count} test frames, but {root / 'data'} has {frames} images"
        )
    return count


def _camera(root: Path, images: list[Path]) -> Camera:
    file = root / "info.txt"
    with named_errors(file, "calibration", "it holds m_calibrationColorIntrinsic"):
        camera = camera_from_fields(fields_of(file), None, "color")
    return camera.resized(*first_size(images))
