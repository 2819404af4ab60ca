"""Patches that several images repeat at one place: what stands still in them."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from evercal.typing import BoolArray, Float32Array, Image

PATCH_PX = 9
"""Side of a patch."""
LEAST_CORRELATION = 0.8
"""Patches with a larger correlation are equal, up to gain and offset."""
LEAST_CONTRAST = 2.0
"""Least variance of a textured patch, in variances of the noise."""
LEAST_NOISE = 2.0
"""Least standard deviation of the intensities of any camera."""


class Repeats(NamedTuple):
    """Patches around the pixels of n images (h, w)."""

    images: NDArray[np.int16]
    """(n, h, w) images that repeat the patch."""
    textured: BoolArray
    """(n, h, w) whether it shows more than noise."""


def reduced_grey(image: Image, long_side: int) -> Image:
    """(h, w) of an image (H, W, 3) in grey; a larger one is reduced to `long_side`, pixels."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    scale = min(1.0, long_side / max(image.shape[:2]))
    small = cv2.resize(grey, None, None, scale, scale, cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


def repeats(greys: Sequence[Image], apart: int = 1, equal: float = 0.5) -> Repeats:
    """Compare each image (h, w) with every `apart`-th other one, at the same place.

    Noise is half of that quantile of their differences: `equal` is at most the share of two
    images that is equal but for noise.
    """
    size = (PATCH_PX, PATCH_PX)
    images = [grey.astype(np.float32) for grey in greys]
    means = [cv2.blur(image, size) for image in images]
    variances = np.maximum([_raw_variance(image) for image in images], 0)
    pairs = itertools.pairwise(images)
    changes = [np.quantile(_raw_variance(b - a), equal) for a, b in pairs]
    noise = max(float(np.median(changes)) / 2, LEAST_NOISE**2)
    signals = np.maximum(variances - noise, noise)
    repeated = np.zeros(variances.shape, np.int16)
    for i, image in enumerate(images):
        for j in range(i % apart, i, apart):
            covariance = cv2.blur(image * images[j], size) - means[i] * means[j]
            same = covariance > LEAST_CORRELATION * np.sqrt(signals[i] * signals[j])
            repeated[i] += same
            repeated[j] += same
    return Repeats(repeated, variances > (1 + LEAST_CONTRAST) * noise)


def _raw_variance(image: Float32Array) -> Float32Array:
    """Variance of the patch around each pixel, with its rounding errors."""
    size = (PATCH_PX, PATCH_PX)
    return cv2.blur(image**2, size) - cv2.blur(image, size) ** 2
