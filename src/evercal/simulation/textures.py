"""Procedural pictures: the only image source of the shipped weights.

A picture is a "dead leaves" collage (Lee, Mumford, Huang: Occlusion models for natural images,
IJCV 2001): shapes of power-law size painted over each other, each filled with 1/f noise, stripes,
checks, a plain tone or text. It has edges, corners, blobs and flat parts at every scale.
"""

from functools import lru_cache

import numpy as np

_LETTERS = "ABCDEFGHJKLMNPRSTUVWXYZabcdefghkmnpqrstuvwxyz0123456789&%#?!"


def one_over_f(size: int, exponent: float, rng: np.random.Generator) -> np.ndarray:
    """Noise (size, size) whose amplitude falls with frequency as 1/f^exponent, float32.

    An exponent of 1 resembles natural images. The noise tiles, with mean 0 and deviation 1.
    """
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :])
    frequency[0, 0] = 1.0
    spectrum = np.fft.rfft2(rng.standard_normal((size, size))) / frequency**exponent
    spectrum[0, 0] = 0.0
    noise = np.fft.irfft2(spectrum, s=(size, size))
    return (noise / noise.std()).astype(np.float32)


@lru_cache(maxsize=1)
def _noise_bank() -> list[np.ndarray]:
    # New FFT noise for each of 200 leaves would cost more than the rest of the picture.
    rng = np.random.default_rng(20_01)
    return [one_over_f(256, exponent, rng) for exponent in np.linspace(0.9, 2.0, 16)]


def _noise_fill(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    bank = _noise_bank()
    noise = bank[rng.integers(len(bank))]
    rows = (np.arange(height) + rng.integers(256)) % 256
    columns = (np.arange(width) + rng.integers(256)) % 256
    return rng.uniform(0.02, 0.16) * noise[np.ix_(rows, columns)]


def _wave_fill(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    angle = rng.uniform(0, np.pi)
    period = rng.uniform(4, 40)
    v, u = np.mgrid[0:height, 0:width].astype(np.float32)
    along = (u * np.cos(angle) + v * np.sin(angle)) / period
    wave = np.sign(np.sin(2 * np.pi * along))
    if rng.random() < 0.4:  # checks
        across = (v * np.cos(angle) - u * np.sin(angle)) / period
        wave = wave * np.sign(np.sin(2 * np.pi * across))
    return (rng.uniform(0.05, 0.25) * wave).astype(np.float32)


def _gradient_fill(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    v, u = np.mgrid[0:height, 0:width].astype(np.float32)
    slope = rng.uniform(-0.3, 0.3, 2)
    return (slope[0] * (u / width - 0.5) + slope[1] * (v / height - 0.5)).astype(
        np.float32
    )


_FILLS = (_noise_fill, _noise_fill, _gradient_fill, _wave_fill)


def _leaf_mask(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    import cv2

    mask = np.zeros((height, width), np.uint8)
    centre = (width // 2, height // 2)
    kind = rng.integers(5)
    if kind == 0:
        axes = (max(1, width // 2 - 1), max(1, height // 2 - 1))
        cv2.ellipse(mask, centre, axes, 0.0, 0.0, 360.0, 1.0, -1, cv2.LINE_8)
    elif kind == 1:
        mask[:] = 1
    elif kind == 2:
        angle = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 8)))
        corners = (
            np.stack([np.cos(angle) * width / 2, np.sin(angle) * height / 2], -1)
            + centre
        )
        cv2.fillPoly(mask, [np.round(corners).astype(np.int32)], 1.0)
    elif kind == 3:
        box = cv2.boxPoints(
            (centre, (width * 0.8, height * 0.5), float(rng.uniform(0, 180)))
        )
        cv2.fillPoly(mask, [np.round(box).astype(np.int32)], 1.0)
    else:
        text = "".join(rng.choice(list(_LETTERS), rng.integers(1, 7)))
        scale = height / 30.0
        thickness = max(1, int(height / 12))
        origin = (2, int(height * 0.8))
        cv2.putText(mask, text, origin, int(rng.integers(8)), scale, 1.0, thickness)
    return mask


def dead_leaves(
    height: int, width: int, rng: np.random.Generator, leaves: int | None = None
) -> np.ndarray:
    """A dead-leaves picture (height, width, 3), RGB uint8; few leaves give a calm one."""
    tint = (
        rng.uniform(0.2, 0.8, 3)
        if rng.random() < 0.5
        else np.full(3, rng.uniform(0.2, 0.8))
    )
    picture = np.empty((height, width, 3), np.float32)
    picture[:] = tint + _noise_fill(height, width, rng)[..., None]
    count = int(rng.integers(20, 220)) if leaves is None else leaves
    # Power-law sizes. The largest are painted first, so small leaves stay visible.
    low = 10.0
    high = 0.6 * min(height, width)
    u = rng.random(count)
    sizes = np.sort(1.0 / (u / low + (1 - u) / high))[::-1]
    saturation = rng.uniform(0.0, 0.35)
    for size in sizes:
        h = int(np.clip(size * rng.uniform(0.6, 1.6), 4, height - 1))
        w = int(np.clip(size * rng.uniform(0.6, 1.6), 4, width - 1))
        top = rng.integers(-h // 2, height - h // 2)
        left = rng.integers(-w // 2, width - w // 2)
        mask = _leaf_mask(h, w, rng)
        fill = _FILLS[rng.integers(len(_FILLS))](h, w, rng)
        colour = rng.uniform(0.02, 0.98) + saturation * rng.uniform(-1, 1, 3)
        y0 = max(top, 0)
        y1 = min(top + h, height)
        x0 = max(left, 0)
        x1 = min(left + w, width)
        window = (slice(y0 - top, y1 - top), slice(x0 - left, x1 - left))
        leaf = (colour + fill[window][..., None]).astype(np.float32)
        np.copyto(
            picture[y0:y1, x0:x1], leaf, where=mask[window][..., None].astype(bool)
        )
    return (np.clip(picture, 0.0, 1.0) * 255).astype(np.uint8)
