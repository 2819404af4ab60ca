"""What a fixed camera sees of a thing that the gripper holds: everything that moves with it.

A pixel that shows the same patch in other images, up to gain and offset, stands still. The rest is
the thing, the arm, and people. Matches that agree with the gripper's motion locate the thing; a
window around it makes a thing of a few pixels as large as the encoder needs.
"""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from evercal.recordings.frame import Frame
from evercal.recordings.masks import without
from evercal.typing import BoolArray

PATCH_PX, SAME, STILL_IN, LEAST_CONTRAST = 9, 0.8, 2, 2.0
"""Side of a patch; correlation of equal patches; other images that show a patch where it stands
still; least variance of a patch that shows something, in variances of the noise."""
COMPARED = 40
"""Images that each one is compared with, about."""
LEAST_NOISE = 2.0
"""Standard deviation of intensities that every camera has at least."""
LONG_SIDE = 640
"""Images are compared at this size, pixels."""
MARGIN = 1.2
"""Side of the window around a thing, as a factor."""
MOST_WINDOW = 0.75
"""Windows larger than this share of the image are not worth it."""


def moving_parts(frames: Sequence[Frame]) -> tuple[tuple[Frame, ...], float]:
    """The frames without what stands still, and the share of their texture that stands still."""
    images = [frame.read_image() for frame in frames]
    scale = min(1.0, LONG_SIDE / max(images[0].shape[:2]))
    greys = [
        cv2.resize(
            cv2.cvtColor(image, cv2.COLOR_RGB2GRAY),
            None,
            None,
            scale,
            scale,
            cv2.INTER_AREA,
        )
        for image in images
    ]
    still, textured = _still(greys)
    share = float((still & textured).sum() / max(textured.sum(), 1))
    return tuple(
        replace(frame, image=without(image, _opened(~stands & visible)))
        for frame, image, stands, visible in zip(
            frames, images, still, textured, strict=True
        )
    ), share


def _still(
    greys: Sequence[NDArray[Any]],
) -> tuple[BoolArray, BoolArray]:
    """(n, h, w) whether a patch is repeated at its place, and whether it shows anything."""
    size = (PATCH_PX, PATCH_PX)
    images = [grey.astype(np.float32) for grey in greys]
    means = [cv2.blur(image, size) for image in images]
    variances = np.stack(
        [
            np.maximum(cv2.blur(i * i, size) - m * m, 0)
            for i, m in zip(images, means, strict=True)
        ]
    )
    # Most of two images is equal but for the noise.
    changes = [
        float(np.median(cv2.blur((b - a) ** 2, size) - cv2.blur(b - a, size) ** 2)) / 2
        for a, b in itertools.pairwise(images)
    ]
    noise = max(float(np.median(changes)), LEAST_NOISE**2)
    signals = np.maximum(variances - noise, noise)
    apart = -(-len(images) // COMPARED)
    repeated = np.zeros(variances.shape, np.int16)
    for i, image in enumerate(images):
        for j in range(i % apart, i, apart):
            covariance = cv2.blur(image * images[j], size) - means[i] * means[j]
            same = covariance > SAME * np.sqrt(signals[i] * signals[j])
            repeated[i] += same
            repeated[j] += same
    return repeated >= STILL_IN, variances > (1 + LEAST_CONTRAST) * noise


def _opened(moving: BoolArray) -> BoolArray:
    """Without single pixels."""
    return (
        cv2.morphologyEx(
            moving.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)
        )
        > 0
    )
