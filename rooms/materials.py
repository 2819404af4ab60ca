"""Materials: procedural sRGB textures that tile, and one of three kinds of reflection.

Matt surfaces are diffuse; coated ones are plastic, varnished wood or glaze; the third is metal.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import cv2
import numpy as np
from numpy.random import Generator

from evercal.simulation.textures import dead_leaves, one_over_f
from evercal.typing import Image

Colour = tuple[float, float, float]
"""sRGB in [0, 1]."""
Reflection = Literal["matt", "coated", "metal"]
"""Kind of reflection of a surface."""
SIZE = 512
"""Side of a tiling texture in pixels."""


@dataclass(frozen=True, eq=False)
class Material:
    """Texture, reflection and emission of a surface."""

    name: str
    """Surfaces with the same name are rendered as one mesh."""
    texture: Image
    """sRGB bytes, shape (h, w, 3); a plain colour has shape (1, 1, 3)."""
    tile_m: float = 1.0
    """Size of one repetition, metres."""
    kind: Reflection = "matt"
    """Kind of reflection."""
    roughness: float = 0.2
    """Microfacet roughness of coated and metal surfaces."""
    emission: float = 0.0
    """Factor from texture to radiance; 0 except for lamps."""

    def bsdf(self, mi: Any) -> dict[str, Any]:
        """Mitsuba dictionary of the reflection. Back sides are black."""
        colour: dict[str, Any]
        if self.texture.shape[:2] == (1, 1):
            colour = {"type": "rgb", "value": linear(self.texture[0, 0]).tolist()}
        else:
            # Rows run downwards, v of our meshes runs upwards.
            bitmap = mi.Bitmap(np.ascontiguousarray(self.texture[::-1]))
            colour = {"type": "bitmap", "bitmap": bitmap, "wrap_mode": "repeat"}
        if self.kind == "matt":
            return {"type": "diffuse", "reflectance": colour}
        if self.kind == "coated":
            return {
                "type": "roughplastic",
                "int_ior": 1.45,
                "alpha": self.roughness,
                "diffuse_reflectance": colour,
            }
        return {
            "type": "roughconductor",
            "material": "none",
            "alpha": self.roughness,
            "specular_reflectance": colour,
        }

    def emitter(self) -> dict[str, Any] | None:
        """Mitsuba dictionary of the emission; None for surfaces that emit no light."""
        if self.emission <= 0:
            return None
        value = (linear(self.texture.reshape(-1, 3).mean(0)) * self.emission).tolist()
        # Small lamps get few samples, so that windows keep most of them.
        weight = 0.12 if self.name == "glow" else 1.0
        radiance = {"type": "rgb", "value": value}
        return {"type": "area", "radiance": radiance, "sampling_weight": weight}


def linear(srgb: np.ndarray | Image) -> np.ndarray:
    """Convert sRGB bytes to linear values in [0, 1]."""
    value = np.asarray(srgb, float) / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def plain(
    name: str, rgb: Colour, kind: Reflection = "matt", roughness: float = 0.2,
    emission: float = 0.0,
) -> Material:  # fmt: skip
    """A plain colour."""
    texel = _bytes(np.array([[rgb]]))
    return Material(name, texel, kind=kind, roughness=roughness, emission=emission)


def wood(name: str, rgb: Colour, rng: Generator) -> Material:
    """Varnished wood: grain along u, fine fibres, sometimes a knot."""
    v, u = np.mgrid[0:SIZE, 0:SIZE].astype(np.float32) / SIZE
    warp = 0.05 * _stretched(rng, 6) + 0.02 * _noise(1.8, rng)
    rings = np.sin(2 * np.pi * (rng.integers(5, 11) * v + 2.2 * warp * 8))
    value = 1 + 0.11 * rings + 0.09 * _stretched(rng, 24) + 0.07 * _stretched(rng, 8)
    if rng.random() < 0.6:
        knot_u, knot_v = rng.uniform(0.2, 0.8, 2)
        distance = ((u - knot_u) * 26) ** 2 + ((v - knot_v) * 40) ** 2
        value -= 0.35 * np.exp(-distance)
    tint = np.array([0.02, 0.0, -0.02]) * rings[..., None]
    return Material(name, _bytes(_shaded(rgb, value) + tint), 0.9, "coated", 0.25)


def boards(name: str, rgb: Colour, rng: Generator) -> Material:
    """A floor of staggered planks."""
    base = wood(name, rgb, rng).texture.astype(np.float32)
    picture = np.zeros_like(base)
    height = SIZE // 8
    for top in range(0, SIZE, height):
        joint = rng.integers(SIZE)
        for start in (joint, joint + SIZE // 2):
            columns = np.arange(start, start + SIZE // 2) % SIZE
            lines = (np.arange(height) + rng.integers(SIZE)) % SIZE
            shade = rng.uniform(0.8, 1.12)
            block = base[np.ix_(lines, (columns + rng.integers(SIZE)) % SIZE)] * shade
            block[:2] *= 0.45
            block[:, :2] *= 0.45
            picture[top : top + height, columns] = block
    return Material(name, clipped(picture), 1.1, "coated", 0.3)


def tiles(
    name: str, rgb: Colour, rng: Generator, count: int, tile_m: float
) -> Material:
    """Glazed tiles with grout, `count` along `tile_m`, each in a slightly different shade."""
    side = SIZE // count
    marble = 0.05 * _noise(1.6, rng)
    shade = np.kron(rng.normal(1, 0.05, (count, count)), np.ones((side, side)))
    shade = np.pad(shade, (0, SIZE - side * count), mode="wrap")
    picture = _shaded(rgb, shade + marble)
    if rng.random() < 0.5:  # an ornament on some tiles
        v, u = np.abs(np.mgrid[0:side, 0:side] / side - 0.5)
        cross = (u < 0.04) ^ (v < 0.04)
        mark = (np.abs(np.hypot(u, v) - 0.28) < 0.05) | cross
        colour = rng.uniform(0.15, 0.7, 3)
        for row, column in side * np.argwhere(rng.random((count, count)) < 0.4):
            picture[row : row + side, column : column + side][mark] = colour
    line = max(2, side // 28)
    grout = (np.arange(SIZE) % side) < line
    picture[grout[:, None] | grout] = 0.55
    return Material(name, _bytes(picture), tile_m, "coated", 0.12)


def equal_tiles(
    name: str, rgb: Colour, other: Colour, tile_m: float, rng: Generator
) -> Material:
    """Identical glazed tiles with grout, two along `tile_m`, in two colours like a chessboard."""
    side = SIZE // 2
    value = 1 + 0.06 * _noise(1.6, rng)[:side, :side]
    v, u = np.mgrid[0:side, 0:side] / side - 0.5
    value[np.abs(np.abs(u) + np.abs(v) - 0.36) < 0.02] *= 0.6  # a rhombus
    grout = np.minimum(u, v) < -0.48
    first = _shaded(rgb, value)
    second = _shaded(other, value)
    first[grout] = 0.5
    second[grout] = 0.5
    row = np.concatenate([first, second], 1)
    picture = np.concatenate([row, np.roll(row, side, 1)])
    return Material(name, _bytes(picture), tile_m, "coated", 0.12)


def fabric(name: str, rgb: Colour, rng: Generator) -> Material:
    """Woven cloth with threads, shading and sometimes stripes, checks or dots."""
    v, u = np.mgrid[0:SIZE, 0:SIZE].astype(np.float32)
    weave = np.where(((u // 3) + (v // 3)) % 2, 1.06, 0.94)
    value = weave + 0.05 * _noise(0.8, rng) + 0.04 * _noise(1.8, rng)
    picture = _shaded(rgb, value)
    other = np.clip(np.array(rgb) + rng.uniform(-0.35, 0.35, 3), 0.05, 0.95)
    pattern = rng.integers(4)
    period = SIZE // rng.integers(2, 6)
    u %= period
    v %= period
    if pattern == 1:
        stripes = u < period * 0.3
        picture[stripes] = _shaded(other, value)[stripes]
    elif pattern == 2:
        share = 0.5 * np.add(u < period / 2, v < period / 2, dtype=float)[..., None]
        picture = picture * (1 - share) + share * other * value[..., None]
    elif pattern == 3:
        dots = np.hypot(u / period - 0.5, v / period - 0.5) < 0.24
        picture[dots] = _shaded(other, value)[dots]
    return Material(name, _bytes(picture), rng.uniform(0.4, 0.7))


def striped(name: str, rgb: Colour, other: Colour, tile_m: float) -> Material:
    """Plain cloth with equal stripes along v in two colours; one pair of stripes is `tile_m`."""
    stripes = np.repeat(np.array([rgb, other]), SIZE // 2, axis=0)
    return Material(name, np.tile(_bytes(stripes), (SIZE, 1, 1)), tile_m)


def carpet(name: str, rgb: Colour, rng: Generator) -> Material:
    """A woven rug with a border and figures that are mirrored at both axes."""
    half = dead_leaves(SIZE // 2, SIZE // 2, rng, 70).astype(np.float32) / 255
    base = np.array(rgb)
    half = 0.35 * half + 0.2 * half.mean(-1, keepdims=True) + 0.45 * base
    picture = np.concatenate([half, half[:, ::-1]], 1)
    picture = np.concatenate([picture, picture[::-1]])
    line = np.arange(SIZE)
    edge = np.minimum(line, line[::-1])
    distance = np.minimum(edge[:, None], edge)
    for margin, colour in ((0, 0.6 * base), (26, 0.4 + 0.6 * base)):
        picture[(distance >= margin) & (distance < margin + 22)] = colour
    picture *= (1 + 0.16 * rng.standard_normal((SIZE, SIZE)))[..., None]
    return Material(name, _bytes(picture))


def plaster(name: str, rgb: Colour, rng: Generator) -> Material:
    """A painted wall: nearly plain, with faint roller marks."""
    value = 1 + 0.018 * _noise(1.0, rng) + 0.012 * _noise(2.0, rng)
    return Material(name, _bytes(_shaded(rgb, value)), 1.5)


def wallpaper(name: str, rgb: Colour, rng: Generator) -> Material:
    """Wallpaper with a repeated figure, so the same patch appears many times."""
    period = SIZE // 4
    other = np.clip(np.array(rgb) * rng.uniform(0.72, 0.9), 0, 1).tolist()
    cell = np.full((period, period, 3), rgb, np.float32)
    for _ in range(3):
        centre = rng.integers(20, period - 20, 2).tolist()
        axes = (int(rng.integers(6, 18)), int(rng.integers(3, 10)))
        cv2.ellipse(cell, centre, axes, rng.uniform(0, 180), 0, 360, other, -1)
    picture = np.tile(cell, (4, 4, 1)) * (1 + 0.02 * _noise(1.0, rng))[..., None]
    return Material(name, _bytes(picture), 1.2)


def stone(name: str, rgb: Colour, rng: Generator) -> Material:
    """A polished worktop: speckles and shading."""
    speck = (rng.random((SIZE, SIZE)) < 0.16) * rng.normal(0, 0.18, (SIZE, SIZE))
    value = 1 + speck + 0.06 * _noise(1.4, rng)
    return Material(name, _bytes(_shaded(rgb, value)), 0.7, "coated", 0.12)


def lacquer(name: str, rgb: Colour, rng: Generator) -> Material:
    """Painted wood with brush strokes."""
    value = 1 + 0.035 * _stretched(rng, 16) + 0.02 * _noise(1.6, rng)
    return Material(name, _bytes(_shaded(rgb, value)), 0.8, "coated", 0.18)


def brushed(name: str, rgb: Colour, rng: Generator) -> Material:
    """Brushed steel."""
    value = 0.95 + 0.05 * _stretched(rng, 40)
    return Material(name, _bytes(_shaded(rgb, value)), 0.5, "metal", 0.28)


@lru_cache(maxsize=8)
def _noise_bank(exponent: float) -> np.ndarray:
    rng = np.random.default_rng([7, round(10 * exponent)])
    return np.stack([one_over_f(SIZE, exponent, rng) for _ in range(3)])


def _noise(exponent: float, rng: Generator) -> np.ndarray:
    """Tiling noise (SIZE, SIZE): one of three stored ones, shifted and flipped for speed."""
    noise = _noise_bank(exponent)[rng.integers(3)]
    noise = np.roll(noise, rng.integers(0, SIZE, 2), (0, 1))
    return noise[:: rng.choice((1, -1))]


def _stretched(rng: Generator, factor: int) -> np.ndarray:
    """Noise stretched along u by `factor`."""
    short = _noise(1, rng)[:, : max(SIZE // factor, 4)]
    short = np.concatenate([short, short[:, ::-1]], 1)  # mirrored, so that it tiles
    drawn = cv2.resize(short, (SIZE, SIZE), interpolation=cv2.INTER_LINEAR)
    return drawn.astype(np.float32)


def _shaded(rgb: Colour | np.ndarray, value: np.ndarray) -> np.ndarray:
    """A colour times brightness values (h, w), shape (h, w, 3)."""
    return np.array(rgb) * value[..., None]


def _bytes(picture: np.ndarray) -> Image:
    """Bytes of sRGB values in [0, 1]."""
    return clipped(np.round(picture * 255))


def clipped(picture: np.ndarray) -> Image:
    """Bytes of values in [0, 255]."""
    return np.clip(picture, 0, 255).astype(np.uint8)


GLOW = plain("glow", (1.0, 0.82, 0.58), emission=2.2)
"""The shade of a lamp that is on."""
