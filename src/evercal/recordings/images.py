"""Images on disk and in memory: (H, W, 3) uint8 in the order red, green, blue."""

import re
import zlib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from evercal.bounds import bounds
from evercal.errors import InputError
from evercal.storage.atomic import write_bytes
from evercal.storage.text_files import named_errors, natural_key
from evercal.typing import Image, PathLike

IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
"""Endings of image files, in lower case."""
_JPEG, _SCAN, _MOST_SCANS = b"\xff\xd8", b"\xff\xda", 100
"""Beginning of a JPEG file, and of a scan in it: progressive files have about ten."""
_TURNED = re.compile(rb"(\x01\x12\0\x03\0{3}\x01\0|\x12\x01\x03\0\x01\0{3})[\x02-\x08]")
"""EXIF orientation other than upright."""
_TIFF = {b"II*\0": "<u4", b"MM\0*": ">u4"}
_PNG = b"\x89PNG"


class StoredImage(ABC):
    """An image inside a larger file, such as a bag or a video, that is read on demand."""

    @abstractmethod
    def read(self) -> Image:
        """Decode the image to (H, W, 3) uint8 RGB."""

    def file(self) -> tuple[str, bytes] | None:
        """Ending and content of the image file, or None if the image is not stored as a file."""
        return None


@dataclass(frozen=True)
class UnturnedImage(StoredImage):
    """An image file as it is stored, for programs that ignore its EXIF orientation."""

    path: Path

    def read(self) -> Image:
        """Decode the image to (H, W, 3) uint8 RGB."""
        return read_image(self.path, turned=False)


Picture = Path | Image | StoredImage
"""A file, an array that `as_rgb` accepts, or an image inside a bag or video."""


def pixels_of(image: Picture) -> Image:
    """Read a picture: (H, W, 3) uint8 RGB."""
    if isinstance(image, Path):
        return read_image(image)
    return image.read() if isinstance(image, StoredImage) else as_rgb(image)


def file_of(image: Picture) -> Path | None:
    """The file of which a picture is the only content, if there is one."""
    file = image.path if isinstance(image, UnturnedImage) else image
    return file if isinstance(file, Path) else None


def files_in(
    folder: Path, end: tuple[str, ...] = IMAGE_ENDINGS, glob: str = "*"
) -> list[Path]:
    """Files in a folder with one of some endings, in lower case; image-2 comes before image-10.

    Hidden files, such as ._a.jpg that macOS puts beside a.jpg, are no content.
    """
    files = (file for file in folder.glob(glob) if file.name[0] != ".")
    own = (file for file in files if file.name.lower().endswith(end))
    return sorted(own, key=lambda file: natural_key(file.as_posix()))


def as_stored(path: Path) -> Path | UnturnedImage:
    """An image file whose EXIF orientation is not applied; the file itself if it states none."""
    with suppress(OSError, ValueError):  # ValueError: the file is empty
        return UnturnedImage(path) if _orientation(np.memmap(path, mode="r")) else path
    return path


def _orientation(data: Image) -> int:
    """Position of the orientation in the bytes (n,) of a file that is not upright, else 0."""
    start = data[:12].tobytes()
    at = max(0, data.tobytes().rfind(b"EXIF")) if start[8:] == b"WEBP" else 0
    if start[:4] in _TIFF:
        at = int(np.frombuffer(start, _TIFF[start[:4]], 1, 4)[0])
    match = _TURNED.search(data[at : at + 4096].tobytes())
    return at + match.end() - 1 if match else 0


def is_readable(image: Path | Image) -> bool:
    """Whether a file, or its bytes (n,), is an image that can be decoded.

    Of a PNG the checksums are compared, which takes a tenth of the time.
    """
    with suppress(OSError, ValueError):  # ValueError: the file is empty
        data = np.asarray(
            np.memmap(image, mode="r") if isinstance(image, Path) else image
        )
        return _is_whole_png(data) or decode_image(data) is not None
    return False


def _is_whole_png(data: Image) -> bool:
    at = 8
    kind = b""
    while data[:4].tobytes() == _PNG and kind != b"IEND" and at + 12 <= len(data):
        end = at + 8 + int.from_bytes(data[at : at + 4].tobytes(), "big")
        kind = data[at + 4 : at + 8].tobytes()
        if (
            zlib.crc32(data[at + 4 : end].data).to_bytes(4, "big")
            != data[end : end + 4].tobytes()
        ):
            return False
        at = end + 4
    return kind == b"IEND"


def first_size(paths: Sequence[Path]) -> tuple[int, int]:
    """Width and height of the first image that can be read, turned upright as by `read_image`."""
    return image_size(next(filter(is_readable, paths), paths[0]))


def as_rgb(image: ArrayLike) -> Image:
    """Convert an image in memory to (H, W, 3) uint8 RGB.

    Args:
        image: (H, W), (H, W, 1), (H, W, 3) RGB or (H, W, 4) RGBA; uint8 or uint16, or nested lists
            of integers from 0 to 255. Grey becomes equal red, green and blue. Alpha is dropped.
            16-bit values are divided by 257 and rounded, so that 65535 becomes 255.
    """
    try:
        pixels = np.asarray(image)
    except (TypeError, ValueError):
        raise InputError("image: not an array; give (H, W, 3) uint8 RGB") from None
    if (
        isinstance(image, (list, tuple))
        and np.issubdtype(pixels.dtype, np.integer)
        and pixels.size
    ):
        in_range = pixels.min() >= 0 and pixels.max() <= 255
        pixels = pixels.astype(np.uint8) if in_range else pixels
    channels = pixels.shape[2:] or (1,)
    valid = pixels.ndim in (2, 3) and channels[0] in (1, 3, 4) and pixels.size
    if not valid or pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"image: array of shape {pixels.shape} and type {pixels.dtype}; give (H, W) grey,"
            f" (H, W, 3) RGB or (H, W, 4) RGBA as uint8 or uint16"
        )
    if pixels.dtype == np.uint16:
        wide = pixels
        pixels = np.empty(pixels.shape, np.uint8)
        # In parts, because the sums take four bytes each.
        for row in range(0, len(wide), 64):
            pixels[row : row + 64] = (
                wide[row : row + 64].astype(np.uint32) + 128
            ) // 257
    if channels == (1,):
        pixels = np.repeat(pixels.reshape(*pixels.shape[:2], 1), 3, axis=2)
    return np.ascontiguousarray(pixels[:, :, :3])


def read_image(path: PathLike, turned: bool = True) -> Image:
    """Read a grey, RGB or RGBA image file of 8 or 16 bits, converted as by `as_rgb`.

    It is turned upright as its EXIF orientation states, unless `turned` is False; intrinsics are
    those of the upright image.
    """
    path = Path(path)
    with named_errors(path, "image file"):
        data = np.fromfile(path, dtype=np.uint8)
    image = decode_image(data, turned)
    if image is None:
        raise InputError(
            f"{path}: not a readable image ({data.size} bytes) of at most {bounds().pixels:,}"
            " pixels; use PNG or JPEG, or add --limits pixels=NUMBER"
        )
    return image


def decode_image(data: Image, turned: bool = True) -> Image | None:
    """Decode (n,) uint8 bytes of an image file as by `read_image`; None if they are no image."""
    import cv2

    # IMREAD_UNCHANGED would ignore the orientation; ANYDEPTH keeps 16 bits for as_rgb to round.
    # IMREAD_COLOR_RGB leaves the pixels of a TIFF of 16 bits as they were in memory.
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH
    flags |= 0 if turned else cv2.IMREAD_IGNORE_ORIENTATION
    if data[:2].tobytes() == _JPEG and data.tobytes().count(_SCAN) > _MOST_SCANS:
        return None  # each scan takes as long as a whole image
    if not turned and data[:4].tobytes() in _TIFF and (at := _orientation(data)):
        data = data.copy()  # OpenCV turns these whatever the flags
        data[at] = 1
    try:
        image = cv2.imdecode(data, flags) if data.size else None
    except cv2.error:
        return None
    if image is None or image.dtype not in (np.uint8, np.uint16):
        return None
    return as_rgb(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


def image_file(data: bytes) -> tuple[str, bytes] | None:
    """Ending and bytes of a PNG or JPEG file, or None for other bytes."""
    starts = {_PNG: ".png", b"\xff\xd8\xff": ".jpg"}
    ending = next((e for start, e in starts.items() if data.startswith(start)), None)
    return None if ending is None else (ending, data)


def write_image(path: PathLike, image: Image) -> None:
    """Write (H, W, 3) uint8 RGB in the format of the file's ending."""
    import cv2

    path = Path(path)
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise ValueError(
            f"an image is (H, W, 3) uint8, got {image.shape} {image.dtype}"
        )
    try:
        encoded, data = cv2.imencode(
            path.suffix, np.ascontiguousarray(image[:, :, ::-1])
        )
    except cv2.error:
        encoded = False
        data = np.empty(0, np.uint8)
    if not encoded:
        raise InputError(
            f"{path}: '{path.suffix}' is no image format; use .png or .jpg"
        )
    path.write_bytes(data.tobytes())


def write_jpeg(path: PathLike, image: Image, quality: int) -> None:
    """Write (H, W, 3) uint8 RGB, whole or not at all; missing folders are created."""
    data = encode_jpeg(image, quality)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, data)


def encode_jpeg(image: Image, quality: int) -> bytes:
    """Encode (H, W) grey or (H, W, 3) RGB uint8 as a JPEG file."""
    import cv2

    bgr = np.ascontiguousarray(image[..., ::-1]) if image.ndim == 3 else image
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def image_size(image: PathLike | StoredImage) -> tuple[int, int]:
    """Width and height in pixels of an image file, turned upright as by `read_image`."""
    height, width = pixels_of(
        image if isinstance(image, StoredImage) else Path(image)
    ).shape[:2]
    return width, height
