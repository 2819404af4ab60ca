"""Images on disk: (H, W, 3) uint8 in the order red, green, blue."""

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError


def read_image(path: str | os.PathLike[str]) -> NDArray[np.uint8]:
    """Decodes an image file as it is stored, without applying an EXIF rotation.

    Returns:
        (H, W, 3) uint8 RGB.

    Raises:
        InputError: The file is missing, is a folder, or is not an image.
    """
    import cv2

    path = Path(path)
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except FileNotFoundError:
        raise InputError(f"{path}: image file is missing; check the path") from None
    except OSError as error:
        raise InputError(f"{path}: image file cannot be read ({error.strerror})") from None
    # A rotated image would not fit the intrinsics, which are those of the sensor.
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(data, flags) if data.size else None
    if image is None:
        raise InputError(
            f"{path}: not a readable image ({data.size} bytes); replace it with a PNG or JPEG file"
        )
    return np.ascontiguousarray(image[:, :, ::-1]).astype(np.uint8, copy=False)


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
