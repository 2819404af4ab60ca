"""Pixels that show the same in all images of a camera that moves.

Text that the camera burns in, the edge of a lens, or a part of the gripper: they match at the same
place in every image, and contradict the motion of the camera.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from evercal.geometry import spread
from evercal.recordings.frame import Recording
from evercal.recordings.masks import PartOfImage
from evercal.recordings.repeated_patches import reduced_grey, repeats
from evercal.typing import BoolArray, Image

COMPARED = 12
"""Number of images that are compared, spread over a recording."""
LONG_SIDE = 320
"""Long side at which they are compared, pixels."""
FEWEST = 5
"""Fewer images are not compared: two of them may be the same view."""
ALWAYS = 0.75
"""Share of the pairs of images that repeat a fixed patch."""
SMOOTH = 0.1
"""Share of the image that is smooth enough to show the noise, before a camera that moves."""
MOST = 0.5
"""Largest share of the texture. Where more of it is fixed, the camera stands still."""
LEAST = 2e-3
"""Smallest share of the image. Letters of one word have more."""
BETWEEN_PX = 15
"""Gaps between fixed patches that are closed, pixels: between letters and lines of text."""
MARGIN_PX = 7
"""Width by which fixed patches grow, pixels: their edges, and digits that change."""


def without_fixed_pixels(recording: Recording) -> tuple[Recording, float]:
    """The recording whose training images lack fixed pixels, and their share of the image.

    Frames of another camera than the first have their own fixed pixels.
    """
    train = list(recording.train)
    most = 0.0
    by_size: dict[tuple[int, int], list[int]] = {}
    for number, frame in enumerate(train):
        by_size.setdefault(frame.camera.size, []).append(number)
    for rows in by_size.values():
        greys = []
        for i in spread(len(rows), COMPARED):
            image = train[rows[i]].read_image()
            greys.append(reduced_grey(image, LONG_SIDE))
        fixed = fixed_pixels(greys)
        if fixed.any():
            most = max(most, float(fixed.mean()))
            for i in rows:
                image = PartOfImage(train[i].image, ~fixed)
                train[i] = replace(train[i], image=image)
    return replace(recording, train=tuple(train)), most


def fixed_pixels(greys: Sequence[Image]) -> BoolArray:
    """(h, w) what is the same in all images (h, w), and gaps between it; none if most is."""
    none = np.zeros(greys[0].shape, bool)
    if len(greys) < FEWEST:
        return none
    compared = repeats(greys, equal=SMOOTH)
    fixed = compared.images.mean(0) >= ALWAYS * (len(greys) - 1)
    if fixed.mean() > MOST * compared.textured.mean():
        return none
    patches = fixed.astype(np.uint8)
    patches = cv2.morphologyEx(patches, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    square = np.ones((BETWEEN_PX, BETWEEN_PX), np.uint8)
    closed = cv2.morphologyEx(patches, cv2.MORPH_CLOSE, square)
    if closed.mean() < LEAST:
        return none
    return cv2.dilate(closed, np.ones((MARGIN_PX, MARGIN_PX), np.uint8)) > 0
