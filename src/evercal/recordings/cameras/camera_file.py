"""Camera files: a matrix, JSON, YAML, NPZ, ROS camera_info, OpenCV's FileStorage, and others.

The content decides the kind, not the file ending. Of ROS, both calibration files and printed
messages are read. A camera may stand inside other entries, such as `cam0` of a Kalibr chain.
"""

import re
from contextlib import nullcontext
from pathlib import Path

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.recordings.cameras.camera_blocks import cameras_of
from evercal.recordings.cameras.camera_fields import (
    CENTRAL,
    camera_of,
    off_centre,
    refuse_misfit,
    states_size,
)
from evercal.recordings.cameras.camera_notations import entries_of
from evercal.recordings.poses.array_files import arrays_as_lists
from evercal.recordings.poses.row_files import is_number
from evercal.storage.text_files import few, named_errors, naming, read_text
from evercal.typing import PathLike, Record, Size

_UNREADABLE = {
    "ModelParameters": "raw calibration of an Azure Kinect, for the whole sensor; write fx, fy, cx,"
    " cy, k1 to k6, p1 and p2 of the mode of the images, as k4a's calibration tool prints them",
    "ParGroup": "camera parameters of HALCON; change the images to no distortion and write the"
    " matrix of cam_par_to_cam_mat",
}
"""Words of formats that are not read, and what to do."""


def read_camera(path: PathLike, size: Size | None = None) -> Camera:
    """Read the intrinsics of one camera.

    `FILE:NAME` chooses one of several cameras in a file. `size` is (width, height) of the images
    in pixels, for files without one.
    """
    path = Path(path)
    name = ""
    if not path.exists():
        file, colon, word = str(path).rpartition(":")
        if colon and Path(file).is_file():
            path = Path(file)
            name = word
    with named_errors(path, "camera file"):
        return camera_from_fields(fields_of(path, size), size, name)


def read_camera_of_size(path: Path, size: Size, images: str) -> Camera:
    """Read the intrinsics of images of one size; another size is refused."""
    camera = read_camera(path, size)
    check_size(str(path), camera, size, images)
    return camera


def check_size(source: str, camera: Camera, size: Size, images: str) -> None:
    """Raise `InputError` if a camera from `source` has another size than its images."""
    width, height = size
    if camera.width != width or camera.height != height:
        resized = f"squeezed or cut out from {camera.width}x{camera.height}"
        if abs(width * camera.height - height * camera.width) <= max(camera.size):
            own = camera.resized(width, height)
            resized = f"resized, with fx {own.fx:.1f}, cx {own.cx:.1f}, cy {own.cy:.1f}"
        raise InputError(
            f"{source}: is for images of {camera.width}x{camera.height}, {images} is"
            f" {width}x{height} ({resized}?); give the intrinsics of this image size with `camera`"
        )


def camera_from_fields(
    data: Record, size: Size | None = None, name: str = ""
) -> Camera:
    """Build a camera from the fields of a file, or of a ROS message.

    The camera may stand inside other fields. Of several, the one with `name` in the names of its
    blocks is taken, or the only one of the images' size. `size` is (width, height) in pixels of the
    images, if the fields may lack it. ValueError: the fields are no camera or several, or the
    images are distorted otherwise or cut out.
    """
    entries = cameras_of(data)
    if not entries:
        return camera_of({str(key): value for key, value in data.items()}, size)
    places = [place for place in entries if name.lower() in place.lower()]
    if name in entries:
        places = [name]
    if not places:
        raise ValueError(f"no camera {name!r}, only {few([*entries], most=8)}")
    cameras: dict[str, Camera] = {}
    fitting = []
    for place in places:
        entry = entries[place]
        with naming(place) if len(entries) > 1 else nullcontext():
            camera = camera_of(entry, size)
        cameras[place] = camera
        if camera.size == size and (states_size(entry) or off_centre(camera) < CENTRAL):
            fitting.append(place)
    choice = {cameras[place]: place for place in fitting or places}
    first = next(iter(choice))
    if len(choice) == 1:
        refuse_misfit(first)
        return first
    descriptions = []
    for place, camera in cameras.items():
        pixels = f"{camera.width}x{camera.height}"
        descriptions.append(f"{place} ({pixels}, fx {camera.fx:.1f})")
    raise ValueError(
        f"holds {len(cameras)} cameras: {few(descriptions, most=8)}; append a part of one name to"
        f" `camera`, such as FILE:{choice[first].split()[0]}"
    )


def fields_of(path: Path, size: Size | None = None) -> Record:
    """Entries of a camera file, as written; ValueError for other files.

    A focal length alone has its principal point in the middle of images of `size`.
    """
    with path.open("rb") as file:
        start = file.read(6)
    if start[:2] == b"PK":
        return arrays_as_lists(path)
    if start == b"MATLAB":
        raise ValueError(
            "MATLAB's pixels start at (1, 1); write fx, fy, cx - 1, cy - 1 and the distortion as"
            " JSON"
        )
    text = read_text(path, "camera file")
    words = re.sub(r"#.*|[,;\[\]]", " ", text).split()
    if all(map(is_number, words)):
        numbers = [*map(float, words)]
        if len(numbers) == 1 and size:
            numbers = centred_camera(numbers[0], size).matrix().ravel().tolist()
        return {"camera_matrix": numbers}
    for mark, problem in _UNREADABLE.items():
        if mark in text:
            raise ValueError(problem)
    return entries_of(text)


def centred_camera(focal_px: float, size: Size) -> Camera:
    """The camera of a focal length, with the principal point in the middle of the image."""
    width, height = size
    centre = ((width - 1) / 2, (height - 1) / 2)
    return Camera(width, height, focal_px, focal_px, *centre)
