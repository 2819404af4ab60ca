"""Image patches that are aligned in other views to about a tenth of a pixel.

Inverse-compositional Lucas-Kanade alignment (Baker and Matthews, IJCV 2004): the templates, their
gradients and their Hessians belong to a keyframe and are computed once; the other image is only
sampled. Patches have zero mean and unit deviation, so gain and offset of the image drop out.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from evercal.geometry import resize_pixels
from evercal.geometry.normal_equations import gram
from evercal.typing import Array, ArrayPair, Image, IntArray

RADIUS = 5
"""Pixels of a patch beside its centre, along each axis."""
SIDE = 2 * RADIUS + 1
_MOST_ROWS = 30_000
"""Patches that are aligned at once: cv2.remap takes maps of up to 32,767 rows."""
_FLAT = 1e-3
"""Added to the deviation of a patch, which is a divisor, in intensities."""
_ROUNDING = np.float32(1e-6)
"""Rounding error of the variance of a blank patch in single precision, as a share of its square."""
_DAMPING = 1e-2
"""Added to the diagonal of a Hessian, which is inverted."""
_LONGEST_STEP = 2.0
"""Largest step of an alignment along each axis, pixels."""


def _grid(radius: int) -> Array:
    steps = np.arange(-radius, radius + 1, dtype=np.float32)
    return np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)


_OFFSETS = _grid(RADIUS)
_WIDE = _grid(RADIUS + 1)
_MEAN = np.full(SIDE * SIDE, 1 / SIDE**2, np.float32)


def image_pyramid(grey: Array | Image, levels: int) -> list[Array]:
    """Float images (h, w), each half the size of the previous one; level 0 is the image."""
    pyramid = [grey.astype(np.float32)]
    for _ in range(levels - 1):
        image = pyramid[-1]
        height = image.shape[0] // 2
        width = image.shape[1] // 2
        even = image[: 2 * height, : 2 * width]
        half = cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA)
        pyramid.append(half.astype(np.float32, copy=False))
    return pyramid


def to_level(pixels: Array, level: int) -> Array:
    """Pixels (n, 2) of level 0 in another level of the pyramid."""
    return resize_pixels(pixels, 0.5**level)


def from_level(pixels: Array, level: int) -> Array:
    """The inverse of `to_level`."""
    return resize_pixels(pixels, 2**level)


class Patches(NamedTuple):
    """Templates of n patches in one level of a keyframe's pyramid."""

    templates: Array
    """(n, 3, p) zero mean: steps u and v in keyframe pixels for a difference of intensities, and
    the intensities with unit deviation."""
    inverse_hessian: Array
    """(n, 2, 2) covariance of the aligned position in pixels per unit of intensity noise."""
    rest: Array
    """(n, 2) step of the template itself, subtracted from every step."""

    def take(self, index: IntArray | slice) -> "Patches":
        """The patches of an index."""
        return Patches(*(values[index] for values in self))

    @classmethod
    def joined(cls, parts: Sequence["Patches"]) -> "Patches":
        """Several sets of patches as one."""
        return cls(*map(np.concatenate, zip(*parts, strict=True)))


def cut_patches(image: Array, pixels: Array) -> Patches:
    """Patches of 11x11 pixels around (n, 2) pixels of a float image of one pyramid level."""
    n = len(pixels)
    centre = pixels.astype(np.float32)
    u = centre[:, :1] + _WIDE[:, 0]
    v = centre[:, 1:] + _WIDE[:, 1]
    wide = _sample(image, u, v)
    wide = wide.reshape(n, SIDE + 2, SIDE + 2)
    rows = wide[:, 1:-1]
    columns = wide[..., 1:-1]
    slope_u = (rows[..., 2:] - rows[..., :-2]) / 2
    slope_v = (columns[:, 2:] - columns[:, :-2]) / 2
    patch = columns[:, 1:-1].reshape(n, SIDE * SIDE)
    patch = patch - patch.mean(1, keepdims=True)
    deviation = np.sqrt((patch * patch).mean(1, keepdims=True)) + _FLAT
    gradient = np.stack([slope_u, slope_v], -1).reshape(n, SIDE * SIDE, 2)
    gradient /= deviation[..., None]
    hessian = gram(gradient.transpose(0, 2, 1))
    # Beside a flat patch the slopes are so large that the damping needs double precision.
    inverse = np.linalg.inv(hessian + _DAMPING * np.eye(2)).astype(np.float32)
    templates = np.empty((n, 3, SIDE * SIDE), np.float32)
    steps = templates[:, :2]
    steps[:] = (gradient @ inverse).transpose(0, 2, 1)
    steps -= steps.mean(2, keepdims=True)
    templates[:, 2] = patch / deviation
    rest = np.einsum("nkp,np->nk", steps, templates[:, 2])
    return Patches(templates, inverse, rest)


def align_patches(
    patches: Patches,
    image: Array,
    centres: Array,
    affines: Array,
    iterations: int,
) -> ArrayPair:
    """Align patches in another image.

    The affines (n, 2, 2) lead from keyframe pixels to pixels of the other image around the centres
    (n, 2) to start from. Returns pixels (n, 2) and their normalised cross-correlation (n,).
    """
    if len(centres) > _MOST_ROWS:
        head = slice(_MOST_ROWS)
        rest = slice(_MOST_ROWS, None)
        aligned = [
            align_patches(
                patches.take(p),
                image,
                centres[p],
                affines[p],
                iterations,
            )
            for p in (head, rest)
        ]
        pixels, correlations = zip(*aligned, strict=True)
        return np.concatenate(pixels), np.concatenate(correlations)
    affines = affines.astype(np.float32)
    # One array for each coordinate: interleaved ones take three times as long to add.
    right = affines[:, 0] @ _OFFSETS.T
    down = affines[:, 1] @ _OFFSETS.T
    centre = centres.astype(np.float32)
    x = np.empty_like(right)
    y = np.empty_like(down)
    product = np.zeros((len(centre), 3), np.float32)
    count = right.shape[1]
    for passed in range(iterations + 1):
        values = _sample(
            image,
            np.add(right, centre[:, :1], out=x),
            np.add(down, centre[:, 1:], out=y),
        )
        # Templates have zero mean, so that the mean of the values drops out of products with them.
        square = np.einsum("np,np->n", values, values) / count
        variance = np.maximum(square - (values @ _MEAN) ** 2, _ROUNDING * square)
        deviation = np.sqrt(variance) + _FLAT
        product = (
            np.einsum("nkp,np->nk", patches.templates, values) / deviation[:, None]
        )
        if passed < iterations:
            step = (product[:, :2] - patches.rest).clip(-_LONGEST_STEP, _LONGEST_STEP)
            centre -= affines[..., 0] * step[:, :1] + affines[..., 1] * step[:, 1:]
    return centre, product[:, 2] / count


def align_down(
    levels: Sequence[Patches],
    pyramid: Sequence[Array],
    start: Array,
    affines: Array,
    steps: Sequence[tuple[int, int]],
) -> ArrayPair:
    """`align_patches` from coarse to fine.

    `start` and the result are (n, 2) pixels of level 0, each step is (level, iterations). Returns
    the correlation (n,) at the last level too.
    """
    pixels = start
    correlation = np.zeros(len(start))
    for level, iterations in steps:
        pixels, correlation = align_patches(
            levels[level],
            pyramid[level],
            to_level(pixels, level),
            affines,
            iterations,
        )
        pixels = from_level(pixels.astype(float), level)
    return pixels, correlation


def whitening(
    affines: Array,
    inverse_hessian: Array,
    floor_px: float,
    noise: float,
    shift_px: Array | None = None,
) -> Array:
    """(2, 2, n) matrices that make the errors of aligned positions independent, of unit variance.

    A patch on an edge is located well across the edge and badly along it, as its Hessian shows.

    Args:
        affines: (n, 2, 2) from keyframe pixels to pixels of the other image.
        inverse_hessian: (n, 2, 2) of the patches.
        floor_px: error of a perfect patch where `noise` is 1, pixels; it grows with `noise`.
        noise: standard deviation of intensities, in deviations of a patch.
        shift_px: (n, 2) one standard deviation of an error along a line, such as the epipolar
            line of a landmark with an uncertain depth.
    """
    spread = (affines @ inverse_hessian @ affines.transpose(0, 2, 1)).astype(float)
    variance = noise**2
    a = variance * (spread[:, 0, 0] + floor_px**2)
    b = variance * spread[:, 0, 1]
    c = variance * (spread[:, 1, 1] + floor_px**2)
    if shift_px is not None:
        u, v = shift_px.T
        a = a + u * u
        b = b + u * v
        c = c + v * v
    # The transposed Cholesky factor of the inverse, written out for 2x2.
    inside = 1 / (a * c - b * b)
    white = np.zeros((2, 2, len(a)))
    white[0, 0] = np.sqrt(c * inside)
    white[0, 1] = -b * inside / white[0, 0]
    white[1, 1] = np.sqrt(1 / c)
    return white


def _sample(
    image: Array,
    right: Array,
    down: Array,
) -> Array:
    """(n, p) intensities at (n, p) columns and rows."""
    if not len(right):
        return np.zeros(right.shape, np.float32)
    values = cv2.remap(
        image,
        right,
        down,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(values, np.float32)
