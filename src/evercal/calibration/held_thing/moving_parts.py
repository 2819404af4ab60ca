"""What a fixed camera sees of a thing that the gripper holds: everything that moves with it.

A pixel that shows the same patch in other images, up to gain and offset, stands still. The rest is
the thing, the arm, and people. Matches that agree with the gripper's motion locate the thing; a
window around it (`windows`) makes a thing of a few pixels as large as the encoder needs.
"""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from evercal.classes import frozen_arrays
from evercal.recordings.frame import Frame
from evercal.recordings.images import Picture, StoredImage, pixels_of
from evercal.recordings.masks import without
from evercal.typing import BoolArray, Float32Array, Image

PATCH_PX = 9
"""Side of a patch."""
LEAST_CORRELATION = 0.8
"""Patches with a larger correlation are equal."""
STILL_IMAGES = 2
"""Number of other images that repeat a patch which stands still."""
LEAST_CONTRAST = 2.0
"""Least variance of a textured patch, in variances of the noise."""
COMPARED = 40
"""Approximate number of images that each one is compared with."""
LEAST_NOISE = 2.0
"""Least standard deviation of the intensities of any camera."""
LONG_SIDE = 640
"""Long side at which images are compared, pixels."""


@frozen_arrays
class MovingPart(StoredImage):
    """An image without what stands still; it is read again each time."""

    image: Picture
    moving: BoolArray
    """(h, w) what to keep, at the size at which images are compared."""

    def read(self) -> Image:
        """Decode the image to (H, W, 3) uint8 RGB."""
        return without(pixels_of(self.image), self.moving)


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
    still, textured = _still([_compared(frame) for frame in frames])
    share = float((still & textured).sum() / max(textured.sum(), 1))
    moving = []
    for frame, stands, visible in zip(frames, still, textured, strict=True):
        image = MovingPart(frame.image, _opened(~stands & visible))
        moving.append(replace(frame, image=image))
    return tuple(moving), share


def in_full_size(
    moving: Frame,
    frame: Frame,
) -> Frame:
    """A frame of `moving_parts` with the image and camera of the frame that it was reduced from."""
    assert isinstance(moving.image, MovingPart), "a frame of moving_parts"
    image = replace(moving.image, image=frame.image)
    return replace(moving, image=image, camera=frame.camera)


def _compared(frame: Frame) -> NDArray[Any]:
    """The image in grey, at the size at which images are compared."""
    image = frame.read_image()
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    scale = min(1.0, LONG_SIDE / max(image.shape[:2]))
    return cv2.resize(grey, None, None, scale, scale, cv2.INTER_AREA)


def _still(greys: Sequence[NDArray[Any]]) -> tuple[BoolArray, BoolArray]:
    """(n, h, w) whether a patch is repeated at its place, and whether it shows anything."""
    size = (PATCH_PX, PATCH_PX)
    images = [grey.astype(np.float32) for grey in greys]
    means = [cv2.blur(image, size) for image in images]
    variances = np.maximum([_raw_variance(image) for image in images], 0)
    # Most of two images is equal but for the noise.
    pairs = itertools.pairwise(images)
    changes = [float(np.median(_raw_variance(b - a))) for a, b in pairs]
    noise = max(float(np.median(changes)) / 2, LEAST_NOISE**2)
    signals = np.maximum(variances - noise, noise)
    apart = -(-len(images) // COMPARED)
    repeated = np.zeros(variances.shape, np.int16)
    for i, image in enumerate(images):
        for j in range(i % apart, i, apart):
            covariance = cv2.blur(image * images[j], size) - means[i] * means[j]
            equal = covariance > LEAST_CORRELATION * np.sqrt(signals[i] * signals[j])
            repeated[i] += equal
            repeated[j] += equal
    return repeated >= STILL_IMAGES, variances > (1 + LEAST_CONTRAST) * noise


def _raw_variance(image: Float32Array) -> Float32Array:
    """Variance of the patch around each pixel, with its rounding errors."""
    size = (PATCH_PX, PATCH_PX)
    return cv2.blur(image**2, size) - cv2.blur(image, size) ** 2


def _opened(moving: BoolArray) -> BoolArray:
    """Without single pixels."""
    pixels = moving.astype(np.uint8)
    kernel = np.ones((3, 3), np.uint8)
    return cv2.morphologyEx(pixels, cv2.MORPH_OPEN, kernel) > 0
