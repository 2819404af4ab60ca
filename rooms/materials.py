"""Materials: procedural sRGB textures that tile, and one of three kinds of reflection.

Matt surfaces are diffuse; coated ones are plastic, varnished wood or glaze; the third is metal.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.random import Generator

from evercal.simulation.textures import dead_leaves, one_over_f
from evercal.typing import Array

Colour = tuple[float, float, float]
"""sRGB in [0, 1]."""

SIZE = 512
"""Side of a tiling texture in pixels."""

_WORDS = (
    "ROBOT", "LIGHT", "RIVER", "NORTH", "ATLAS", "CAMERA", "METHODS", "KITCHEN", "ORANGE",
    "VISION", "GARDEN", "STEEL", "PHYSICS", "OCEAN", "SALT", "TEA", "FLOUR", "RICE", "COFFEE",
    "HONEY", "SUGAR", "PASTA", "OATS", "MAPS", "POEMS", "STARS", "WINTER", "TRAINS", "MOTION",
    "PAPER",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Material:
    """Texture, reflection and emission of a surface."""

    name: str
    """Surfaces with the same name are rendered as one mesh."""
    texture: Array
    """sRGB bytes, shape (h, w, 3); a plain colour has shape (1, 1, 3)."""
    tile_m: float = 1.0
    """Size of one repetition, metres."""
    kind: Literal["matt", "coated", "metal"] = "matt"
    """Kind of reflection."""
    roughness: float = 0.2
    """Microfacet roughness of coated and metal surfaces."""
    emission: float = 0.0
    """Factor from texture to radiance; 0 except for lamps."""

    def bsdf(self, mi: Any) -> dict[str, Any]:
        """Mitsuba dictionary of the reflection. Back sides are black."""
        if self.texture.shape[:2] == (1, 1):
            colour: dict[str, Any] = {
                "type": "rgb",
                "value": linear(self.texture[0, 0]).tolist(),
            }
        else:
            # Rows run downwards, v of our meshes runs upwards.
            bitmap = mi.Bitmap(np.ascontiguousarray(self.texture[::-1]))
            colour = {"type": "bitmap", "bitmap": bitmap, "wrap_mode": "repeat"}
        if self.kind == "matt":
            return {"type": "diffuse", "reflectance": colour}
        if self.kind == "coated":
            plastic = {"type": "roughplastic", "int_ior": 1.45, "alpha": self.roughness}
            return {**plastic, "diffuse_reflectance": colour}
        metal = {"type": "roughconductor", "material": "none", "alpha": self.roughness}
        return {**metal, "specular_reflectance": colour}

    def emitter(self, mi: Any) -> dict[str, Any] | None:
        """Mitsuba dictionary of the emission; None for surfaces that emit no light."""
        if self.emission <= 0:
            return None
        value = (linear(self.texture.reshape(-1, 3).mean(0)) * self.emission).tolist()
        # Small lamps get few samples, so that windows keep most of them.
        weight = 0.12 if self.name == "glow" else 1.0
        radiance = {"type": "rgb", "value": value}
        return {"type": "area", "radiance": radiance, "sampling_weight": weight}


def linear(srgb: Array) -> Array:
    """Convert sRGB bytes to linear values in [0, 1]."""
    value = np.asarray(srgb, float) / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def plain(
    name: str, rgb: Colour, kind: Literal["matt", "coated", "metal"] = "matt",
    roughness: float = 0.2, emission: float = 0.0,
) -> Material:  # fmt: skip
    """A plain colour, sRGB in [0, 1]."""
    texel = (
        np.round(np.clip(np.array(rgb), 0, 1) * 255).astype(np.uint8).reshape(1, 1, 3)
    )
    return Material(name, texel, kind=kind, roughness=roughness, emission=emission)


GLOW = plain("glow", (1.0, 0.82, 0.58), emission=2.2)
"""The shade of a lamp that is on."""


def wood(name: str, rgb: Colour, rng: Generator) -> Material:
    """Varnished wood: grain along u, fine fibres, sometimes a knot."""
    v, u = np.mgrid[0:SIZE, 0:SIZE].astype(np.float32) / SIZE
    warp = 0.05 * _stretched(rng, 1, 6) + 0.02 * _noise(1.8, rng)
    rings = np.sin(2 * np.pi * (rng.integers(5, 11) * v + 2.2 * warp * 8))
    fibre = _stretched(rng, 1, 24)
    value = 1 + 0.11 * rings + 0.09 * fibre + 0.07 * _stretched(rng, 1, 8)
    if rng.random() < 0.6:
        cu, cv = rng.uniform(0.2, 0.8, 2)
        value -= 0.35 * np.exp(-(((u - cu) * 26) ** 2 + ((v - cv) * 40) ** 2))
    tint = np.array([0.02, 0.0, -0.02]) * rings[..., None]
    return Material(
        name, _bytes(np.array(rgb) * value[..., None] + tint), 0.9, "coated", 0.25
    )


def boards(name: str, rgb: Colour, rng: Generator) -> Material:
    """A floor of staggered planks."""
    base = wood(name, rgb, rng).texture.astype(np.float32)
    picture = np.zeros_like(base)
    rows = 8
    height = SIZE // 8
    for row in range(rows):
        joint = int(rng.integers(SIZE))
        for start in (joint, joint + SIZE // 2):
            columns = np.arange(start, start + SIZE // 2) % SIZE
            lines = (np.arange(height) + rng.integers(SIZE)) % SIZE
            shade = rng.uniform(0.8, 1.12)
            block = base[np.ix_(lines, (columns + rng.integers(SIZE)) % SIZE)] * shade
            block[:2] *= 0.45
            block[:, :2] *= 0.45
            picture[row * height : (row + 1) * height, columns] = block
    return Material(name, np.clip(picture, 0, 255).astype(np.uint8), 1.1, "coated", 0.3)


def tiles(
    name: str,
    rgb: Colour,
    rng: Generator,
    count: int,
    tile_m: float,
) -> Material:
    """Glazed tiles with grout, `count` along `tile_m`, each in a slightly different shade."""
    side = SIZE // count
    marble = 0.05 * _noise(1.6, rng)
    shade = np.kron(rng.normal(1, 0.05, (count, count)), np.ones((side, side)))
    shade = np.pad(shade, ((0, SIZE - side * count),) * 2, mode="wrap")
    picture = np.array(rgb) * (shade + marble)[..., None]
    if rng.random() < 0.5:  # an ornament on some tiles
        v, u = np.mgrid[0:side, 0:side] / side - 0.5
        radius = np.hypot(u, v)
        mark = (np.abs(radius - 0.28) < 0.05) | (
            (np.abs(u) < 0.04) ^ (np.abs(v) < 0.04)
        )
        colour = rng.uniform(0.15, 0.7, 3)
        for row, column in np.argwhere(rng.random((count, count)) < 0.4):
            tile = picture[
                row * side : (row + 1) * side, column * side : (column + 1) * side
            ]
            tile[mark] = colour
    line = max(2, side // 28)
    grout = (np.arange(SIZE) % side) < line
    picture[grout[:, None] | grout[None, :]] = 0.55
    return Material(name, _bytes(picture), tile_m, "coated", 0.12)


def equal_tiles(
    name: str,
    rgb: Colour,
    other: Colour,
    tile_m: float,
    rng: Generator,
) -> Material:
    """Identical glazed tiles with grout, two along `tile_m`, in two colours like a chessboard."""
    side = SIZE // 2
    value = 1 + 0.06 * _noise(1.6, rng)[:side, :side, None]
    v, u = np.mgrid[0:side, 0:side] / side - 0.5
    value[np.abs(np.abs(u) + np.abs(v) - 0.36) < 0.02] *= 0.6  # a rhombus
    grout = np.minimum(u, v) < -0.48
    a, b = (
        np.where(grout[..., None], 0.5, np.array(colour) * value)
        for colour in (rgb, other)
    )
    picture = np.concatenate([np.concatenate([a, b], 1), np.concatenate([b, a], 1)])
    return Material(name, _bytes(picture), tile_m, "coated", 0.12)


def fabric(name: str, rgb: Colour, rng: Generator) -> Material:
    """Woven cloth with threads, shading and sometimes stripes, checks or dots."""
    v, u = np.mgrid[0:SIZE, 0:SIZE].astype(np.float32)
    weave = np.where(((u // 3) + (v // 3)) % 2, 1.06, 0.94)
    value = weave + 0.05 * _noise(0.8, rng) + 0.04 * _noise(1.8, rng)
    picture = np.array(rgb) * value[..., None]
    other = np.clip(np.array(rgb) + rng.uniform(-0.35, 0.35, 3), 0.05, 0.95)
    pattern = rng.integers(4)
    period = SIZE // int(rng.integers(2, 6))
    if pattern == 1:
        stripes = (u % period) < period * 0.3
        picture = np.where(stripes[..., None], other * value[..., None], picture)
    elif pattern == 2:
        share = 0.5 * (((u % period) < period / 2) + 0.0 + ((v % period) < period / 2))
        picture = (
            picture * (1 - share[..., None])
            + share[..., None] * other * value[..., None]
        )
    elif pattern == 3:
        cells = (
            np.hypot((u % period) / period - 0.5, (v % period) / period - 0.5) < 0.24
        )
        picture = np.where(cells[..., None], other * value[..., None], picture)
    return Material(name, _bytes(picture), rng.uniform(0.4, 0.7))


def striped(
    name: str,
    rgb: Colour,
    other: Colour,
    tile_m: float,
) -> Material:
    """Plain cloth with equal stripes along v in two colours; one pair of stripes is `tile_m`."""
    stripes = np.repeat(np.array([rgb, other]), SIZE // 2, axis=0)
    return Material(name, np.tile(_bytes(stripes), (SIZE, 1, 1)), tile_m)


def carpet(name: str, rgb: Colour, rng: Generator) -> Material:
    """A woven rug with a border and figures that are mirrored at both axes."""
    half = dead_leaves(SIZE // 2, SIZE // 2, rng, 70).astype(np.float32) / 255
    half = 0.35 * half + 0.2 * half.mean(-1, keepdims=True) + 0.45 * np.array(rgb)
    picture = np.concatenate([half, half[:, ::-1]], 1)
    picture = np.concatenate([picture, picture[::-1]], 0)
    edge = np.minimum(np.arange(SIZE), np.arange(SIZE)[::-1])
    distance = np.minimum(edge[:, None], edge)
    for margin, colour in ((0, 0.6 * np.array(rgb)), (26, 0.4 + 0.6 * np.array(rgb))):
        picture[(distance >= margin) & (distance < margin + 22)] = colour
    picture *= (1 + 0.16 * rng.standard_normal((SIZE, SIZE)))[..., None]
    return Material(name, _bytes(picture))


def plaster(name: str, rgb: Colour, rng: Generator) -> Material:
    """A painted wall: nearly plain, with faint roller marks."""
    value = 1 + 0.018 * _noise(1.0, rng) + 0.012 * _noise(2.0, rng)
    return Material(name, _bytes(np.array(rgb) * value[..., None]), 1.5)


def wallpaper(name: str, rgb: Colour, rng: Generator) -> Material:
    """Wallpaper with a repeated figure, so the same patch appears many times."""
    import cv2

    period = SIZE // 4
    other = np.clip(np.array(rgb) * rng.uniform(0.72, 0.9), 0, 1)
    cell = np.ones((period, period, 3), np.float32) * np.array(rgb, np.float32)
    for _ in range(3):
        centre = tuple(int(c) for c in rng.integers(20, period - 20, 2))
        axes = (int(rng.integers(6, 18)), int(rng.integers(3, 10)))
        cv2.ellipse(cell, centre, axes, rng.uniform(0, 180), 0, 360, other.tolist(), -1)
    picture = np.tile(cell, (4, 4, 1)) * (1 + 0.02 * _noise(1.0, rng))[..., None]
    return Material(name, _bytes(picture), 1.2)


def stone(name: str, rgb: Colour, rng: Generator) -> Material:
    """A polished worktop: speckles and shading."""
    speck = (rng.random((SIZE, SIZE)) < 0.16) * rng.normal(0, 0.18, (SIZE, SIZE))
    value = 1 + speck + 0.06 * _noise(1.4, rng)
    return Material(name, _bytes(np.array(rgb) * value[..., None]), 0.7, "coated", 0.12)


def lacquer(name: str, rgb: Colour, rng: Generator) -> Material:
    """Painted wood with brush strokes."""
    value = 1 + 0.035 * _stretched(rng, 1, 16) + 0.02 * _noise(1.6, rng)
    return Material(name, _bytes(np.array(rgb) * value[..., None]), 0.8, "coated", 0.18)


def brushed(name: str, rgb: Colour, rng: Generator) -> Material:
    """Brushed steel."""
    value = 0.95 + 0.05 * _stretched(rng, 1, 40)
    return Material(name, _bytes(np.array(rgb) * value[..., None]), 0.5, "metal", 0.28)


def painting(
    name: str, rng: Generator, height: int = 256, width: int = 320
) -> Material:
    """A painting."""
    picture = dead_leaves(height, width, rng, int(rng.integers(25, 120))).astype(
        np.float32
    )
    if rng.random() < 0.5:  # a landscape behind: sky above, ground below
        v = np.linspace(0, 1, height)[:, None, None]
        sky = np.where(
            v < rng.uniform(0.4, 0.7), rng.uniform(120, 230, 3), rng.uniform(30, 150, 3)
        )
        picture = 0.45 * picture + 0.55 * sky
    return Material(
        name, np.clip(picture, 0, 255).astype(np.uint8), kind="coated", roughness=0.3
    )


def label(name: str, rgb: Colour, rng: Generator) -> Material:
    """Printed packaging: a word, small print, a bar code."""
    import cv2

    picture = np.full((256, 256, 3), np.array(rgb) * 255, np.uint8)
    dark = tuple(int(c) for c in rng.integers(0, 90, 3))
    light = tuple(int(c) for c in rng.integers(190, 256, 3))
    cv2.rectangle(picture, (12, 40), (244, 130), light, -1)
    word = str(rng.choice(_WORDS))
    scale = 240 / max(cv2.getTextSize(word, cv2.FONT_HERSHEY_DUPLEX, 1.0, 2)[0][0], 120)
    cv2.putText(picture, word, (16, 105), cv2.FONT_HERSHEY_DUPLEX, scale * 0.9, dark, 2)
    for line in range(4):
        text = " ".join(str(w).lower() for w in rng.choice(_WORDS, 3))
        cv2.putText(
            picture, text, (16, 155 + 16 * line), cv2.FONT_HERSHEY_PLAIN, 0.9, light, 1
        )
    bars = np.repeat(rng.integers(0, 2, 32), 2) * 255
    picture[222:250, 170:234] = bars[None, :, None]
    return Material(name, picture, kind="coated", roughness=0.3)


BOOKS = 16
"""Number of spines in one `spines` texture."""


def spines(name: str, rng: Generator) -> Material:
    """Sixteen book spines side by side, with titles that run upwards."""
    import cv2

    height = 512
    width = 64
    cells = []
    for _ in range(BOOKS):
        colour = (
            np.clip(rng.uniform(0.08, 0.85) + rng.uniform(-0.25, 0.25, 3), 0.03, 0.95)
            * 255
        )
        lying = np.full((width, height, 3), colour, np.uint8)
        ink = (245, 235, 205) if colour.mean() < 120 else (25, 25, 30)
        for at in rng.integers(10, 60, 2):
            cv2.line(
                lying, (int(at), 0), (int(at), width), ink, int(rng.integers(1, 4))
            )
        words = " ".join(str(w) for w in rng.choice(_WORDS, int(rng.integers(1, 3))))
        cv2.putText(
            lying, words, (75, 42), int(rng.integers(0, 5)), 1.0, ink, 2, cv2.LINE_AA
        )
        cv2.putText(
            lying,
            str(rng.choice(_WORDS)).lower(),
            (400, 40),
            0,
            0.5,
            ink,
            1,
            cv2.LINE_AA,
        )
        cells.append(np.rot90(lying))
    picture = np.concatenate(cells, 1).astype(np.float32)
    picture *= (1 + 0.03 * rng.standard_normal(picture.shape[:2]))[..., None]
    return Material(
        name, np.clip(picture, 0, 255).astype(np.uint8), kind="coated", roughness=0.35
    )


def chessboard(name: str, columns: int, rows: int) -> Material:
    """A printed chessboard with a white margin of one square, black squares in its corners."""
    squares = np.indices((rows, columns)).sum(0) % 2 * 225.0 + 15
    picture = np.kron(np.pad(squares, 1, constant_values=240), np.ones((32, 32)))
    return Material(name, np.repeat(picture[..., None], 3, -1).astype(np.uint8))


def clock_face(name: str) -> Material:
    """Twelve strokes, numbers and two hands."""
    import cv2

    face = np.full((256, 256, 3), 238, np.uint8)
    for hour in range(12):
        angle = 2 * np.pi * hour / 12
        direction = np.array([np.sin(angle), -np.cos(angle)])
        a, b = ((128 + radius * direction).astype(int) for radius in (108, 120))
        cv2.line(face, tuple(map(int, a)), tuple(map(int, b)), (20, 20, 20), 5)
        at = (128 + 88 * direction - (12, -8)).astype(int)
        cv2.putText(face, str(hour or 12), tuple(map(int, at)), 0, 0.7, (20, 20, 20), 2)
    cv2.line(face, (128, 128), (176, 96), (15, 15, 15), 6)
    cv2.line(face, (128, 128), (104, 40), (15, 15, 15), 4)
    return Material(name, face, kind="coated", roughness=0.15)


@lru_cache(maxsize=8)
def _noise_bank(exponent: float) -> Array:
    rng = np.random.default_rng([7, round(10 * exponent)])
    return np.stack([one_over_f(SIZE, exponent, rng) for _ in range(3)])


def _noise(exponent: float, rng: Generator) -> Array:
    """Tiling noise (SIZE, SIZE): one of three stored ones, shifted and flipped for speed."""
    noise = _noise_bank(exponent)[rng.integers(3)]
    noise = np.roll(noise, rng.integers(0, SIZE, 2), (0, 1))
    return noise[:: 1 - 2 * int(rng.integers(2))]


def _stretched(rng: Generator, exponent: float, factor: int) -> Array:
    """Noise stretched along u by `factor`."""
    import cv2

    noise = _noise(exponent, rng)
    short = noise[:, : max(SIZE // factor, 4)]
    short = np.concatenate([short, short[:, ::-1]], 1)  # mirrored, so that it tiles
    drawn = cv2.resize(short, (SIZE, SIZE), interpolation=cv2.INTER_LINEAR)
    return drawn.astype(np.float32)


def _bytes(picture: Array) -> Array:
    return np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8)
