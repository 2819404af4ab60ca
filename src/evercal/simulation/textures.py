"""Procedural pictures: the only image source of the shipped weights.

A picture is a "dead leaves" collage (Lee, Mumford, Huang: Occlusion models for natural images,
IJCV 2001): shapes of power-law size painted over each other, each filled with 1/f noise, stripes,
checks, a plain tone or text. It has edges, corners, blobs and flat parts at every scale.
"""

from functools import lru_cache

import cv2
import numpy as np
from numpy.random import Generator, default_rng

from evercal.typing import Array, Float32Array, Image

_LETTERS = "ABCDEFGHJKLMNPRSTUVWXYZabcdefghkmnpqrstuvwxyz0123456789&%#?!"
"""Characters of text in leaves, without those that look alike."""


def one_over_f(size: int, exponent: float, rng: Generator) -> Float32Array:
    """Noise (size, size) whose amplitude falls with frequency as 1/f^exponent.

    An exponent of 1 resembles natural images. The noise tiles, with mean 0 and deviation 1.
    """
    rows = np.fft.fftfreq(size)
    columns = np.fft.rfftfreq(size)
    frequency = np.hypot(rows[:, None], columns)
    frequency[0, 0] = 1.0
    white = rng.standard_normal((size, size))
    spectrum = np.fft.rfft2(white) / frequency**exponent
    spectrum[0, 0] = 0.0
    noise = np.fft.irfft2(spectrum, s=(size, size))
    return (noise / noise.std()).astype(np.float32)


@lru_cache(maxsize=1)
def _noise_bank() -> list[Float32Array]:
    # New FFT noise for each of 200 leaves would cost more than the rest of the picture.
    rng = default_rng(20_01)
    exponents = np.linspace(0.9, 2.0, 16)
    return [one_over_f(256, exponent, rng) for exponent in exponents]


def _noise_fill(
    height: int,
    width: int,
    rng: Generator,
) -> Array:
    bank = _noise_bank()
    noise = bank[rng.integers(len(bank))]
    rows = np.arange(height) + rng.integers(256)
    columns = np.arange(width) + rng.integers(256)
    window = np.ix_(rows % 256, columns % 256)
    contrast = rng.uniform(0.02, 0.16)
    return contrast * noise[window]


def _wave_fill(
    height: int,
    width: int,
    rng: Generator,
) -> Array:
    angle = rng.uniform(0, np.pi)
    period = rng.uniform(4, 40)
    c = np.cos(angle)
    s = np.sin(angle)
    v, u = _pixels(height, width)
    along = u * c + v * s
    wave = _square_wave(along / period)
    if rng.random() < 0.4:  # checks
        across = v * c - u * s
        wave = wave * _square_wave(across / period)
    contrast = rng.uniform(0.05, 0.25)
    return (contrast * wave).astype(np.float32)


def _gradient_fill(
    height: int,
    width: int,
    rng: Generator,
) -> Array:
    v, u = _pixels(height, width)
    slope_u, slope_v = rng.uniform(-0.3, 0.3, 2)
    across = slope_u * (u / width - 0.5)
    down = slope_v * (v / height - 0.5)
    return (across + down).astype(np.float32)


def _pixels(height: int, width: int) -> Float32Array:
    """Row and column of every pixel, shape (2, height, width)."""
    return np.mgrid[:height, :width].astype(np.float32)


def _square_wave(periods: Array) -> Array:
    sine = np.sin(2 * np.pi * periods)
    return np.sign(sine)


_FILLS = (
    _noise_fill,
    _noise_fill,
    _gradient_fill,
    _wave_fill,
)
"""Fills of leaves; each is drawn with the same probability."""


def _ellipse(mask: Image, rng: Generator) -> None:
    height, width = mask.shape
    radius_u = max(1, width // 2 - 1)
    radius_v = max(1, height // 2 - 1)
    cv2.ellipse(
        mask,
        center=(width // 2, height // 2),
        axes=(radius_u, radius_v),
        angle=0.0,
        startAngle=0.0,
        endAngle=360.0,
        color=1.0,
        thickness=cv2.FILLED,
        lineType=cv2.LINE_8,
    )


def _rectangle(mask: Image, rng: Generator) -> None:
    mask[:] = 1


def _polygon(mask: Image, rng: Generator) -> None:
    height, width = mask.shape
    corners = rng.integers(3, 8)
    angles = rng.uniform(0, 2 * np.pi, corners)
    angles.sort()
    x = width // 2 + np.cos(angles) * width / 2
    y = height // 2 + np.sin(angles) * height / 2
    _fill_polygon(mask, np.stack([x, y], -1))


def _turned_box(mask: Image, rng: Generator) -> None:
    height, width = mask.shape
    centre = (width // 2, height // 2)
    size = (width * 0.8, height * 0.5)
    turn_deg = float(rng.uniform(0, 180))
    _fill_polygon(mask, cv2.boxPoints((centre, size, turn_deg)))


def _text(mask: Image, rng: Generator) -> None:
    height = len(mask)
    letters = rng.choice(list(_LETTERS), rng.integers(1, 7))
    cv2.putText(
        mask,
        text="".join(letters),
        org=(2, int(height * 0.8)),
        fontFace=int(rng.integers(8)),
        fontScale=height / 30.0,
        color=1.0,
        thickness=max(1, int(height / 12)),
    )


def _fill_polygon(mask: Image, corners: cv2.typing.MatLike) -> None:
    pixels = np.round(corners).astype(np.int32)
    cv2.fillPoly(mask, [pixels], 1.0)


_SHAPES = (
    _ellipse,
    _rectangle,
    _polygon,
    _turned_box,
    _text,
)
"""Shapes of leaves; each is drawn with the same probability."""


def dead_leaves(
    height: int,
    width: int,
    rng: Generator,
    leaves: int | None = None,
) -> Image:
    """A dead-leaves picture (height, width, 3), RGB uint8; few leaves give a calm one."""
    if rng.random() < 0.5:
        tint = rng.uniform(0.2, 0.8, 3)
    else:
        tint = np.full(3, rng.uniform(0.2, 0.8))
    background = tint + _noise_fill(height, width, rng)[..., None]
    picture = background.astype(np.float32)
    if leaves is None:
        leaves = int(rng.integers(20, 220))
    # Power-law sizes. The largest are painted first, so small leaves stay visible.
    smallest = 10.0
    largest = 0.6 * min(height, width)
    u = rng.random(leaves)
    inverse_sizes = u / smallest + (1 - u) / largest
    sizes = 1.0 / inverse_sizes
    saturation = rng.uniform(0.0, 0.35)
    for size in np.sort(sizes)[::-1]:
        _add_leaf(picture, size, saturation, rng)
    return (np.clip(picture, 0.0, 1.0) * 255).astype(np.uint8)


def _add_leaf(
    picture: Float32Array,
    size: float,
    saturation: float,
    rng: Generator,
) -> None:
    bounds = np.array(picture.shape[:2])
    stretched = size * rng.uniform(0.6, 1.6, 2)
    sides = np.clip(stretched, 4, bounds - 1).astype(int)
    low = rng.integers(-sides // 2, bounds - sides // 2)
    mask: Image = np.zeros(sides, np.uint8)
    draw = _SHAPES[rng.integers(len(_SHAPES))]
    draw(mask, rng)
    fill = _FILLS[rng.integers(len(_FILLS))]
    height, width = mask.shape
    texture = fill(height, width, rng)
    grey = rng.uniform(0.02, 0.98)
    tint = rng.uniform(-1, 1, 3)
    colour = grey + saturation * tint
    start = np.maximum(low, 0)
    stop = np.minimum(low + sides, bounds)
    in_picture = tuple(map(slice, start, stop))
    in_leaf = tuple(map(slice, start - low, stop - low))
    leaf = colour + texture[in_leaf][..., None]
    visible = mask[in_leaf][..., None].astype(bool)
    np.copyto(
        picture[in_picture],
        leaf.astype(np.float32),
        where=visible,
    )
