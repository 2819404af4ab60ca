"""What a fixed camera sees of a thing that the gripper holds: everything that moves with it.

A pixel that shows the same patch in other images, up to gain and offset, stands still. The rest is
the thing, the arm, and people. Matches that agree with the gripper's motion locate the thing; a
window around it (`windows`) makes a thing of a few pixels as large as the encoder needs.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from evercal.recordings.frame import Frame
from evercal.recordings.masks import PartOfImage
from evercal.recordings.repeated_patches import reduced_grey, repeats
from evercal.typing import BoolArray, Image

STILL_IMAGES = 2
"""Number of other images that repeat a patch which stands still."""
COMPARED = 40
"""Approximate number of images that each one is compared with."""
LONG_SIDE = 640
"""Long side at which images are compared, pixels."""


def reduced(
    frame: Frame,
    short_side: int,
) -> Frame:
    """The frame with a smaller image in memory, if it is larger."""
    image = frame.read_image()
    if min(image.shape[:2]) <= short_side:
        return replace(frame, image=image)
    camera = frame.camera.short_side_resized(short_side)
    size = camera.size
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return replace(frame, image=np.asarray(small, np.uint8), camera=camera)


def moving_parts(frames: Sequence[Frame]) -> tuple[tuple[Frame, ...], float]:
    """The frames without what stands still, and the share of their texture that stands still."""
    still, textured = _still(
        [reduced_grey(frame.read_image(), LONG_SIDE) for frame in frames]
    )
    share = float((still & textured).sum() / max(textured.sum(), 1))
    moving = []
    for frame, stands, visible in zip(frames, still, textured, strict=True):
        image = PartOfImage(frame.image, _opened(~stands & visible))
        moving.append(replace(frame, image=image))
    return tuple(moving), share


def in_full_size(
    moving: Frame,
    frame: Frame,
) -> Frame:
    """A frame of `moving_parts` with the image and camera of the frame that it was reduced from."""
    assert isinstance(moving.image, PartOfImage), "a frame of moving_parts"
    image = replace(moving.image, image=frame.image)
    return replace(moving, image=image, camera=frame.camera)


def _still(greys: Sequence[Image]) -> tuple[BoolArray, BoolArray]:
    """(n, h, w) whether a patch is repeated at its place, and whether it shows anything."""
    apart = -(-len(greys) // COMPARED)
    compared = repeats(greys, apart)
    return compared.images >= STILL_IMAGES, compared.textured


def _opened(moving: BoolArray) -> BoolArray:
    """Without single pixels."""
    pixels = moving.astype(np.uint8)
    kernel = np.ones((3, 3), np.uint8)
    return cv2.morphologyEx(pixels, cv2.MORPH_OPEN, kernel) > 0
