"""What a request may contain: sizes, images, and small files such as intrinsics."""

import tempfile
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from evercal.bounds import (
    RequestBounds,
    TooLargeError,
    reading_a_request,
    request_bounds,
)
from evercal.calibration.calibration import Calibration, read_calibration
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.cameras.camera_file import read_camera
from evercal.recordings.images import decode_image, size_in_header
from evercal.recordings.poses.pairing import poses_of_images
from evercal.typing import Size

Content = TypeVar("Content")


def decoded(data: bytes, name: str, limits: RequestBounds) -> np.ndarray:
    """Pixels (h, w, 3) uint8 RGB of an image file, see `decode_image`."""
    with reading_a_request(limits):
        image = decode_image(np.frombuffer(data, np.uint8), name=name)
    if image is None:
        raise _unreadable(data, name)
    return image


class Sent(Sequence[tuple[str, np.ndarray]]):
    """Images of a request: names, and pixels that are decoded whenever they are asked for."""

    def __init__(self, files: Sequence[tuple[str, bytes]], limits: RequestBounds):
        if len(files) > limits.images:
            raise TooLargeError(f"images: {len(files)} given; at most {limits.images}")
        self.before_image: Callable[[], None] = lambda: None
        self._files = files
        self._limits = limits

    def check_pixels(self) -> None:
        """Refuse more pixels than a request may hold, by the headers of the images."""
        total = 0
        for name, data in self._files:
            width, height = _header_size(data, name)
            total += width * height
        most = self._limits.request_pixels
        if total > most:
            raise TooLargeError(f"images: {total:,} pixels in all; at most {most:,}")

    @property
    def names(self) -> list[str]:
        """Names of the images."""
        return [name for name, _ in self._files]

    def camera(self, intrinsics: bytes | None) -> Camera | None:
        """The camera in a file of intrinsics, by the size of the first image."""
        if intrinsics is None:
            return None
        return camera_of(intrinsics, self[0][1].shape[1::-1])

    def __len__(self) -> int:
        return len(self._files)

    def __getitem__(self, index: Any) -> Any:
        self.before_image()
        name, data = self._files[index]
        return name, decoded(data, name, self._limits)


def _header_size(data: bytes, name: str) -> Size:
    try:
        return size_in_header(np.frombuffer(data, np.uint8))
    except ValueError:
        raise _unreadable(data, name) from None


def _unreadable(data: bytes, name: str) -> InputError:
    return InputError(
        f"{name}: not a readable image ({len(data)} bytes); send PNG, JPEG, BMP, TIFF or WebP"
    )


@lru_cache(maxsize=8)  # a robot sends the same intrinsics with every image
def camera_of(data: bytes | None, size: Size) -> Camera | None:
    """Intrinsics in a file of any format, for images of a size (width, height)."""
    if data is None:
        return None
    return _from_text(data, "camera", ".json", lambda path: read_camera(path, size))


def poses_of(
    data: bytes, ending: str, images: list[str], convention: str | None
) -> SE3:
    """(n,) base_from_gripper of n named images, by a pose table whose file had an ending."""
    files = list(map(Path, images))
    ending = ending.lower()
    if ending not in (".txt", ".json", ".tum"):
        ending = ".csv"

    def read(path: Path) -> SE3:
        return poses_of_images(path, files, convention)[0]

    return _from_text(data, "robot_poses", ending, read)


def calibration_of(data: bytes) -> Calibration:
    """A calibration file that came over the network."""
    return _from_text(data, "calibration", ".json", read_calibration)


def _from_text(
    data: bytes, name: str, ending: str, read: Callable[[Path], Content]
) -> Content:
    """Read text that came over the network as a file.

    One line for whatever a reader raises, with the name of the request's part.
    """
    most = request_bounds().text_bytes
    if len(data) > most:
        raise TooLargeError(f"{name}: {len(data)} bytes; at most {most}")
    if data[:2] == b"PK" or b"\0" in data:
        raise InputError(f"{name}: not a text file; send JSON, YAML or a table as text")
    with tempfile.TemporaryDirectory(prefix="evercal-") as folder:
        path = Path(folder, name + ending)
        path.write_bytes(data)
        try:
            with reading_a_request():
                return read(path)
        except InputError as error:
            raise InputError(str(error).replace(str(path), name)) from None
        except Exception as error:  # deep nesting, infinite numbers, wrong types
            what = str(error).partition("\n")[0] or type(error).__name__
            raise InputError(f"{name}: cannot be read ({what[:200]})") from None
