"""Images on disk and in memory: (H, W, 3) uint8 in the order red, green, blue."""

import io
import re
import zlib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypeAlias

import imagesize
import numpy as np
from numpy.typing import ArrayLike

from evercal.bounds import bounds, require_image_size
from evercal.classes import frozen
from evercal.errors import InputError
from evercal.storage.atomic import naming_file, write_bytes
from evercal.storage.text_files import named_errors, natural_key
from evercal.typing import Image, PathLike, Size, Strings

IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
"""Endings of image files, in lower case."""
ImageFile: TypeAlias = tuple[str, bytes]
"""Ending and content of an image file."""
_JPEG = b"\xff\xd8"
"""Beginning of a JPEG file."""
_SCAN = b"\xff\xda"
"""Beginning of a scan in a JPEG file."""
_TURNED = re.compile(rb"(\x01\x12\0\x03\0{3}\x01\0|\x12\x01\x03\0\x01\0{3})[\x02-\x08]")
"""EXIF orientation other than upright."""
_TIFF = {b"II*\0": "<u4", b"MM\0*": ">u4"}
"""Byte order of a TIFF file by its beginning."""
_PNG = b"\x89PNG"
"""Beginning of a PNG file."""


class StoredImage(ABC):
    """An image inside a larger file, such as a bag or a video, that is read on demand."""

    @abstractmethod
    def read(self) -> Image:
        """Decode the image to (H, W, 3) uint8 RGB."""

    def file(self) -> ImageFile | None:
        """Ending and content of the image file, or None if the image is not stored as a file."""
        return None


@frozen
class UnturnedImage(StoredImage):
    """An image file as it is stored, for programs that ignore its EXIF orientation."""

    path: Path

    def read(self) -> Image:
        """Decode the image to (H, W, 3) uint8 RGB."""
        return read_image(self.path, turned=False)


Picture = Path | Image | StoredImage
"""A file, an array that `as_rgb` accepts, or an image inside a bag or video."""
NamedPictures = Sequence[tuple[str, Picture]]
"""Pictures with their names."""


def pixels_of(image: Picture) -> Image:
    """Read a picture: (H, W, 3) uint8 RGB."""
    if isinstance(image, Path):
        return read_image(image)
    if isinstance(image, StoredImage):
        return image.read()
    return as_rgb(image)


def file_of(image: Picture) -> Path | None:
    """The file of which a picture is the only content, if there is one."""
    if isinstance(image, UnturnedImage):
        return image.path
    if isinstance(image, Path):
        return image
    return None


def files_in(folder: Path, end: Strings = IMAGE_ENDINGS, glob: str = "*") -> list[Path]:
    """Files in a folder with one of some endings, in lower case; image-2 comes before image-10.

    Hidden files, such as ._a.jpg that macOS puts beside a.jpg, are no content.
    """
    files = []
    for file in folder.glob(glob):
        name = file.name.lower()
        if name.endswith(end) and not name.startswith(".") and not file.is_fifo():
            files.append(file)
    return sorted(files, key=lambda file: natural_key(file.as_posix()))


def as_stored(path: Path) -> Path | UnturnedImage:
    """An image file whose EXIF orientation is not applied; the file itself if it states none."""
    with suppress(OSError, ValueError):  # ValueError: the file is empty
        if _orientation(np.memmap(path, mode="r")):
            return UnturnedImage(path)
    return path


def _orientation(data: Image) -> int:
    """Position of the orientation in the bytes (n,) of a file that is not upright, else 0."""
    header = data[:12].tobytes()
    kind = header[:4]
    start = 0
    if header[8:] == b"WEBP":
        start = max(0, data.tobytes().rfind(b"EXIF"))
    if kind in _TIFF:
        start = int(np.frombuffer(header, _TIFF[kind], 1, 4)[0])
    match = _TURNED.search(data[start : start + 4096].tobytes())
    if match is None:
        return 0
    return start + match.end() - 1


def is_readable(image: Path | Image) -> bool:
    """Whether a file, or its bytes (n,), is an image that can be decoded.

    Of a PNG the checksums are compared, which takes a tenth of the time.
    """
    with suppress(OSError, ValueError, InputError):  # ValueError: the file is empty
        if isinstance(image, Path):
            image = np.memmap(image, mode="r")
        data = np.asarray(image)
        require_image_size(*size_in_header(data))
        return _is_whole_png(data) or decode_image(data) is not None
    return False


def _is_whole_png(data: Image) -> bool:
    if data[:4].tobytes() != _PNG:
        return False
    start = 8
    kind = b""
    while kind != b"IEND" and start + 12 <= len(data):
        length = int.from_bytes(data[start : start + 4].tobytes(), "big")
        end = start + 8 + length
        chunk = data[start + 4 : end]
        kind = chunk[:4].tobytes()
        checksum = zlib.crc32(chunk.data)
        if checksum != int.from_bytes(data[end : end + 4].tobytes(), "big"):
            return False
        start = end + 4
    return kind == b"IEND"


def first_size(paths: Sequence[Path]) -> Size:
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
    is_list = isinstance(image, (list, tuple)) and pixels.size > 0
    if is_list and np.issubdtype(pixels.dtype, np.integer):
        is_byte = pixels.min() >= 0 and pixels.max() <= 255
        pixels = pixels.astype(np.uint8 if is_byte else pixels.dtype)
    channels = pixels.shape[2:] or (1,)
    is_image = pixels.ndim in (2, 3) and channels[0] in (1, 3, 4)
    is_known = pixels.dtype in (np.uint8, np.uint16)
    if not is_image or not is_known or not pixels.size:
        raise InputError(
            f"image: array of shape {pixels.shape} and type {pixels.dtype}; give (H, W) grey,"
            f" (H, W, 3) RGB or (H, W, 4) RGBA as uint8 or uint16"
        )
    require_image_size(pixels.shape[1], pixels.shape[0])
    if pixels.dtype == np.uint16:
        import cv2

        pixels = cv2.convertScaleAbs(pixels, alpha=1 / 257).reshape(pixels.shape)
    if channels == (1,):
        grey = pixels.reshape(*pixels.shape[:2], 1)
        pixels = np.repeat(grey, 3, axis=2)
    return np.ascontiguousarray(pixels[:, :, :3], np.uint8)


def read_image(path: PathLike, turned: bool = True) -> Image:
    """Read a grey, RGB or RGBA image file of 8 or 16 bits, converted as by `as_rgb`.

    It is turned upright as its EXIF orientation states, unless `turned` is False; intrinsics are
    those of the upright image.
    """
    path = Path(path)
    with named_errors(path, "image file"):
        data = np.fromfile(path, dtype=np.uint8)
    image = decode_image(data, turned, str(path))
    if image is None:
        raise InputError(
            f"{path}: not a readable image ({data.size} bytes); use PNG or JPEG"
        )
    return image


def decode_image(data: Image, turned: bool = True, name: str = "image") -> Image | None:
    """Decode (n,) uint8 bytes of an image file as by `read_image`; None if they are no image.

    Raises:
        TooLargeError: By the size in the header, before anything is decoded.
    """
    import cv2

    try:
        size = size_in_header(data)
    except ValueError:
        return None
    require_image_size(*size, name)
    # IMREAD_UNCHANGED would ignore the orientation; ANYDEPTH keeps 16 bits for as_rgb to round.
    # IMREAD_COLOR_RGB leaves the pixels of a TIFF of 16 bits as they were in memory.
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH
    if data[:2].tobytes() == _JPEG and data.tobytes().count(_SCAN) > bounds().scans:
        return None  # each scan takes as long as a whole image
    if not turned:
        flags |= cv2.IMREAD_IGNORE_ORIENTATION
        position = _orientation(data)
        if position and data[:4].tobytes() in _TIFF:
            data = data.copy()  # OpenCV turns these whatever the flags
            data[position] = 1
    image = None
    with suppress(cv2.error):  # also for no bytes
        image = cv2.imdecode(data, flags)
    if image is None or image.dtype not in (np.uint8, np.uint16):
        return None
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    return as_rgb(image)


def size_in_header(data: Image) -> Size:
    """Width and height by the header of an image file, (n,) uint8 bytes; not turned.

    Raises:
        ValueError: The bytes are no image.
    """
    # Broken headers raise whatever the reader of their format does.
    with suppress(Exception):
        width, height = imagesize.get(io.BytesIO(data.tobytes()), exif_rotation=False)
        if width > 0 and height > 0:
            return width, height
    raise ValueError("no image")


def image_file(data: bytes) -> ImageFile | None:
    """Ending and bytes of a PNG or JPEG file, or None for other bytes."""
    for start, ending in ((_PNG, ".png"), (b"\xff\xd8\xff", ".jpg")):
        if data.startswith(start):
            return ending, data
    return None


def write_image(path: PathLike, image: Image) -> None:
    """Write (H, W, 3) uint8 RGB in the format of the file's ending."""
    import cv2

    path = Path(path)
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise ValueError(
            f"an image is (H, W, 3) uint8, got {image.shape} {image.dtype}"
        )
    bgr = np.ascontiguousarray(image[:, :, ::-1])
    try:
        encoded, data = cv2.imencode(path.suffix, bgr)
        if not encoded:
            raise ValueError
    except (cv2.error, ValueError):
        raise InputError(
            f"{path}: '{path.suffix}' is no image format; use .png or .jpg"
        ) from None
    with naming_file(path):
        path.write_bytes(data.tobytes())


def write_jpeg(path: PathLike, image: Image, quality: int) -> None:
    """Write (H, W, 3) uint8 RGB, whole or not at all; missing folders are created."""
    data = encode_jpeg(image, quality)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, data)


def encode_jpeg(image: Image, quality: int) -> bytes:
    """Encode (H, W) grey or (H, W, 3) RGB uint8 as a JPEG file."""
    import cv2

    if image.ndim == 3:
        image = np.ascontiguousarray(image[..., ::-1])
    parameters = [cv2.IMWRITE_JPEG_QUALITY, quality]
    return cv2.imencode(".jpg", image, parameters)[1].tobytes()


def image_size(image: PathLike | StoredImage) -> Size:
    """Width and height in pixels of an image file, turned upright as by `read_image`."""
    if not isinstance(image, StoredImage):
        image = Path(image)
    height, width, _ = pixels_of(image).shape
    return width, height
