"""Images on disk: (H, W, 3) uint8 in the order red, green, blue."""

import os
from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError

IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
"""Of the image files that recordings are made of, in lower case."""


class StoredImage(ABC):
    """An image inside a larger file, such as a bag or a video, read when it is needed."""

    @abstractmethod
    def read(self) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 RGB.

        Raises:
            InputError: It cannot be read or decoded.
        """

    def file(self) -> tuple[str, bytes] | None:
        """The ending and content of an image file where it is stored as one, else None."""
        return None


def read_image(path: str | os.PathLike[str]) -> NDArray[np.uint8]:
    """Decodes an image file as it is stored, without applying an EXIF rotation.

    Returns:
        (H, W, 3) uint8 RGB.

    Raises:
        InputError: The file is missing, is a folder, or is not an image.
    """
    path = Path(path)
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except FileNotFoundError:
        raise InputError(f"{path}: image file is missing; check the path") from None
    except OSError as error:
        raise InputError(f"{path}: image file cannot be read ({error.strerror})") from None
    image = decode_image(data)
    if image is None:
        raise InputError(
            f"{path}: not a readable image ({data.size} bytes); replace it with a PNG or JPEG file"
        )
    return image


def decode_image(data: NDArray[np.uint8]) -> NDArray[np.uint8] | None:
    """The pixels of an image file's content, without applying an EXIF rotation.

    Args:
        data: (n,) uint8 bytes of a file.

    Returns:
        (H, W, 3) uint8 RGB, or None if it is no image.
    """
    import cv2

    # A rotated image would not fit the intrinsics, which are those of the sensor.
    flags = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(data, flags) if data.size else None
    return None if image is None else image.astype(np.uint8, copy=False)


def image_file(data: bytes) -> tuple[str, bytes] | None:
    """The ending that goes with the bytes of a PNG or JPEG file, and the bytes; None for others."""
    starts = {b"\x89PNG": ".png", b"\xff\xd8\xff": ".jpg"}
    ending = next((e for start, e in starts.items() if data.startswith(start)), None)
    return None if ending is None else (ending, data)


def write_image(path: str | os.PathLike[str], image: NDArray[np.uint8]) -> None:
    """Writes (H, W, 3) uint8 RGB in the format that the file's ending names.

    Raises:
        InputError: An ending that names no image format.
        ValueError: Not (H, W, 3) uint8.
    """
    import cv2

    path = Path(path)
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise ValueError(f"an image is (H, W, 3) uint8, got {image.shape} {image.dtype}")
    try:
        done, data = cv2.imencode(path.suffix, np.ascontiguousarray(image[:, :, ::-1]))
    except cv2.error:
        done, data = False, np.empty(0, np.uint8)
    if not done:
        raise InputError(f"{path}: '{path.suffix}' is no image format; use .png or .jpg")
    path.write_bytes(data.tobytes())


def image_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """(width, height) in pixels of the stored image.

    Raises:
        InputError: As `read_image`.
    """
    height, width = read_image(path).shape[:2]
    return width, height
