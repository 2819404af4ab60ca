"""Masks beside images: what is black in a mask is not learned from, such as a person or a cable.

masks/NAME.png for images/NAME.jpg; also masks/NAME.jpg.png, as COLMAP names them
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.images import (
    Picture,
    StoredImage,
    file_of,
    pixels_of,
    read_image,
)
from evercal.typing import BoolArray, Image

SOFT_PX = 9
"""Width of the soft edge of a mask, pixels: a hard edge would be texture."""


@frozen_arrays
class MaskedImage(StoredImage):
    """An image file without what is black in its mask."""

    image: Picture
    mask: Path

    def read(self) -> Image:
        """(H, W, 3), with its mean colour where the mask is black."""
        image = pixels_of(self.image)
        mask = read_image(self.mask)[..., 0] > 0
        if mask.shape != image.shape[:2]:
            raise InputError(
                f"{self.mask}: mask is {mask.shape[1]}x{mask.shape[0]}, its image"
                f" {image.shape[1]}x{image.shape[0]}; give both the same size"
            )
        return without(image, mask)


@frozen_arrays
class PartOfImage(StoredImage):
    """A part of an image; it is read again each time."""

    image: Picture
    keep: BoolArray
    """(h, w) what to keep, at the size of the image or a smaller one."""

    def read(self) -> Image:
        """Decode the image to (H, W, 3) uint8 RGB."""
        return without(pixels_of(self.image), self.keep)


def without(image: Image, keep: BoolArray) -> Image:
    """The image (H, W, 3) with its mean colour, through a soft edge, outside `keep`.

    `keep` has the image's size, or is smaller.
    """
    square = np.ones((SOFT_PX, SOFT_PX), np.uint8)
    soft = cv2.dilate(keep.astype(np.uint8), square)
    soft = cv2.GaussianBlur(soft.astype(np.float32), (0, 0), SOFT_PX / 3)
    soft = cv2.resize(soft, image.shape[1::-1])[..., None]
    weighted = image * soft
    colour = weighted.sum((0, 1)) / max(float(soft.sum()), 1e-6)
    return (weighted + colour * (1 - soft)).astype(np.uint8)


def with_masks(recording: Recording, root: Path) -> Recording:
    """The recording with the masks in its folder on its training frames."""
    folder = root / "masks"
    train = tuple(_masked(frame, folder) for frame in recording.train)
    count = sum(isinstance(frame.image, MaskedImage) for frame in train)
    if not count:
        raise InputError(
            f"{folder}: no mask has the name of an image; name them as the images, or rename the"
            " folder"
        )
    note = f"Masks of {count} of {len(train)} images are used."
    return replace(recording, train=train, notes=(*recording.notes, note))


def _masked(frame: Frame, folder: Path) -> Frame:
    file = file_of(frame.image)
    if file:
        for name in (file.stem, file.name):
            mask = folder / f"{name}.png"
            if mask.is_file():
                return replace(frame, image=MaskedImage(frame.image, mask))
    return frame
