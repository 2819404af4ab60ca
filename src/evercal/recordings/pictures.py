"""What the images of a recording show, before anything is computed from them."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from evercal.geometry import spread
from evercal.recordings.frame import Frame
from evercal.typing import Array, Image, Strings

_LOOKED_AT = 12
"""Number of images that are looked at, spread over a recording."""
_SIDE_PX = 240
"""Shorter side to which they are reduced, pixels."""
_BLANK = 20.0
"""An image is blank if the grey values of its 1 % and 99 % quantiles differ by less. A room at 1/8,
1/16 and 1/32 of its brightness has 27, 14 and 7: all, half and none of its images were located."""
_BLURRED = 0.65
"""Median sharpness below which a recording is blurred: recordings have 0.8 to 1.3. With 0.6
(Gaussian blur of 2 px) the median error of a room rises from 0.8 to 2.9 mm, with 0.4 to 6.9 mm."""
_SAME = 0.7
"""Median change from one image to the next, grey values, of one that is repeated: 0.4 with noise of
4 grey values. Recordings have 8 or more."""
_FLAT = 1.0
"""Squared slope below which an image shows no structure, grey values."""


class Pictures(NamedTuple):
    """What images show."""

    warnings: Strings
    usable: bool
    """Whether a map can be learned from them."""


def look_at(frames: Sequence[Frame]) -> Pictures:
    """Look at some images of a recording, in recorded order."""
    if not frames:
        return Pictures((), usable=True)
    chosen = spread(len(frames), _LOOKED_AT)
    images = [_small(frames[i].read_image()) for i in chosen]
    blank = [image for image in images if is_blank(image)]
    if blank:
        look = _look_of_blank(blank)
        words = f"{len(blank)} of {len(images)} images that were looked at are {look}"
        return Pictures((words,), 2 * len(blank) <= len(images))
    if len(images) > 1 and np.median(_changes(images)) < _SAME:
        return Pictures(
            ("all images are the same; is each pose that of its image?",), False
        )
    if np.median([sharpness(image) for image in images]) < _BLURRED:
        return Pictures(
            ("all images are blurred; check focus and exposure time",), usable=True
        )
    return Pictures((), usable=True)


def changes(frames: Sequence[Frame]) -> Array:
    """(n - 1,) mean change from image to image, grey values."""
    return _changes([_small(frame.read_image()) for frame in frames])


def _changes(images: Sequence[Image]) -> Array:
    tiny = [
        cv2.resize(image, (40, 30), interpolation=cv2.INTER_AREA) for image in images
    ]
    steps = np.diff(np.array(tiny, float), axis=0)
    return np.abs(steps).mean((1, 2, 3))


def _look_of_blank(images: Sequence[Image]) -> str:
    level = float(np.median([np.median(image) for image in images]))
    if level < 48:
        return (
            "almost black; if 12-bit values are stored in 16 bits, multiply them by 16"
        )
    if level > 207:
        return "almost white"
    return "of one colour"


def is_blank(image: Image) -> bool:
    """Whether an image (h, w, 3) is black, white or of one colour."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    darkest, brightest = np.quantile(grey, [0.01, 0.99])
    return bool(brightest - darkest < _BLANK)


def sharpness(image: Image) -> float:
    """Contrast of fine structure relative to coarser one, in the direction of motion blur.

    It is the smallest generalised eigenvalue of the structure tensors of two octaves, which hardly
    depends on what is shown. An image without structure has 0.
    """
    from scipy.linalg import eigh

    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    fine = cv2.GaussianBlur(grey, (0, 0), 1.0)
    middle = cv2.GaussianBlur(grey, (0, 0), 2.0)
    coarse = cv2.GaussianBlur(grey, (0, 0), 4.0)
    above = _structure(fine - middle)
    below = _structure(middle - coarse)
    if np.linalg.eigvalsh(below)[0] < _FLAT:
        return 0.0
    smallest = eigh(above, below, eigvals_only=True)[0]
    return float(np.sqrt(max(smallest, 0.0)))


def _structure(band: Any) -> Array:
    across = cv2.Sobel(band, cv2.CV_32F, 1, 0).ravel()
    down = cv2.Sobel(band, cv2.CV_32F, 0, 1).ravel()
    return np.cov([across, down], bias=True)


def _small(image: Image) -> Image:
    scale = min(1.0, _SIDE_PX / min(image.shape[:2]))
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)
