"""Whether what stands still before a fixed camera moved in its images: then the camera moved."""

from collections.abc import Sequence

import cv2
import numpy as np

from evercal.recordings.frame import Frame
from evercal.recordings.images import pixels_of
from evercal.recordings.masks import PartOfImage
from evercal.typing import Array, BoolArray, Image

POINTS = 400
"""Maximum number of points that are tracked."""
LEAST_POINTS = 30
"""Minimum number of points in an image."""
AGAIN_PX = 0.3
"""Largest distance of a point that is tracked there and back."""


def background_motion(moving: Sequence[Frame]) -> Array:
    """(n, 2) radians by which the background moved in frames of `moving_parts`, against the first.

    NaN where too few points are tracked, or move differently.
    """
    first = moving[0]
    assert isinstance(first.image, PartOfImage), "a frame of moving_parts"
    motion = motion_of_still([*map(_grey, moving)], ~first.image.keep)
    return motion / [first.camera.fx, first.camera.fy]


def motion_of_still(greys: Sequence[Image], still: BoolArray) -> Array:
    """(n, 2) pixels by which images in grey move where the first of them stands still (h, w).

    NaN where too few points are tracked, or move differently.
    """
    motion = np.full((len(greys), 2), np.nan)
    grey = greys[0]
    mask = cv2.erode(still.astype(np.uint8), np.ones((9, 9), np.uint8))
    mask = cv2.resize(mask, grey.shape[::-1], interpolation=cv2.INTER_NEAREST)
    points = cv2.goodFeaturesToTrack(grey, POINTS, 0.01, 8, mask=mask)
    if points is None or len(points) < LEAST_POINTS:
        return motion
    for i, other in enumerate(greys):
        tracked, _, _ = cv2.calcOpticalFlowPyrLK(grey, other, points, points.copy())
        back, _, _ = cv2.calcOpticalFlowPyrLK(other, grey, tracked, points.copy())
        again = np.abs(back - points).max((1, 2)) < AGAIN_PX
        if again.sum() < max(LEAST_POINTS, len(points) / 3):
            continue
        # A camera that turns; what moves by itself is an outlier.
        _, inliers = cv2.findHomography(
            points[again], tracked[again], cv2.RANSAC, 2 * AGAIN_PX
        )
        if inliers is not None and inliers.mean() > 0.5:
            shift = (tracked - points)[again]
            motion[i] = np.median(shift[inliers.ravel() > 0], (0, 1))
    return motion


def _grey(frame: Frame) -> Image:
    assert isinstance(frame.image, PartOfImage), "a frame of moving_parts"
    grey = cv2.cvtColor(pixels_of(frame.image.image), cv2.COLOR_RGB2GRAY)
    return np.asarray(grey, np.uint8)
