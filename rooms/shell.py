"""The shell of a room: walls, floor, ceiling, skirting, windows with curtains, a lamp, a carpet."""

from dataclasses import replace

import numpy as np

from rooms import materials as m
from rooms.builder import WALL_YAW_RAD, Builder
from rooms.items import Item, Parts
from rooms.materials import Colour
from rooms.shapes import box, cylinder, lathe, sheet

FLOOR: tuple[Colour, ...] = (
    (0.56, 0.40, 0.26), (0.68, 0.53, 0.36), (0.42, 0.29, 0.2), (0.74, 0.62, 0.46),
)  # fmt: skip
"""Colours of wooden floors."""
WALLS: tuple[Colour, ...] = (
    (0.86, 0.84, 0.79), (0.78, 0.82, 0.80), (0.84, 0.79, 0.70), (0.74, 0.79, 0.84),
    (0.83, 0.77, 0.76),
)  # fmt: skip
"""Colours of walls."""
TILES = {
    "workshop": ((0.55, 0.56, 0.56), (0.55, 0.56, 0.56), 0.6),
    "canteen": ((0.72, 0.62, 0.5), (0.72, 0.62, 0.5), 0.4),
    "hall": ((0.84, 0.82, 0.77), (0.16, 0.17, 0.2), 0.5),
}
"""Two colours of floor tiles and the size of two tiles in metres, by kind of repeated room."""


def build_shell(build: Builder) -> Parts:
    """Make the shell and hang the curtains. Rooms with equal tiles have no carpet."""
    x, y, z = build.size
    rng = build.rng
    shop = build.shop
    paint = m.plaster("plaster", _tone(build), rng)
    accent = m.wallpaper("wallpaper", _tone(build), rng)
    if build.kind == "kitchen":
        floor = m.tiles("floor", (0.66, 0.62, 0.56), rng, 4, 1.3)
        accent = m.tiles("splash", _tone(build), rng, 5, 0.75)
    elif build.kind in TILES:
        floor = m.equal_tiles("floor", *TILES[build.kind], rng)
    else:
        floor = m.boards("floor", FLOOR[rng.integers(len(FLOOR))], rng)
    ceiling = m.plaster("ceiling", (0.9, 0.9, 0.88), rng)
    shell = Item("shell")
    for corner, u, v, material in (
        ((0, 0, 0), (x, 0, 0), (0, y, 0), floor),
        ((0, y, z), (x, 0, 0), (0, -y, 0), ceiling),
        ((0, y, 0), (x, 0, 0), (0, 0, z), paint),
        ((0, 0, 0), (0, y, 0), (0, 0, z), accent),
        ((x, 0, 0), (-x, 0, 0), (0, 0, z), paint),
        ((x, y, 0), (0, -y, 0), (0, 0, z), paint),
    ):
        wall = sheet(corner, u, v)
        # Texture coordinates in metres.
        wall = replace(wall, uv=wall.uv * (np.linalg.norm(u), np.linalg.norm(v)))
        shell.add(wall, material)
    for py in (0.008, y - 0.008):
        shell.add(box(x, 0.016, 0.08, 0.006), shop.white, x / 2, py, 0)
    for px in (0.008, x - 0.008):
        shell.add(box(0.016, y, 0.08, 0.006), shop.white, px, y / 2, 0)
    for wall, low, high in ((0, 0.45, 0.75), (2, 0.2, 0.5), (3, 0.3, 0.7)):
        shell.parts += _window(build, wall, rng.uniform(low, high))
    # A broad ceiling lamp keeps shadows soft and noise low.
    lamp = m.plain("lamp", (1.0, 0.95, 0.87), emission=5.0)
    shell.add(cylinder(0.38, 0.05, 0.01, 48), lamp, 0.55 * x, y / 2, z - 0.07)
    rim = lathe([(0.38, 0), (0.4, 0), (0.4, 0.06), (0.38, 0.06)], 48, 1)
    shell.add(rim, shop.steel, 0.55 * x, y / 2, z - 0.06)
    if build.kind not in TILES:  # where a carpet would hide the tiles
        _lay_carpet(build, shell)
    return shell.parts


def _tone(build: Builder) -> Colour:
    return WALLS[build.rng.integers(len(WALLS))]


def _lay_carpet(build: Builder, shell: Item) -> None:
    x, y, _ = build.size
    colour = tuple(build.rng.uniform(0.2, 0.6, 3).tolist())
    rug = m.carpet("carpet", colour, build.rng)
    w = 0.62 * x
    d = 0.55 * y
    mat = box(w, d, 0.012, 0.005, bottom=False).shifted(0.5 * x, y / 2, 0.0)
    corner = (0.5 * x - w / 2, y / 2 - d / 2)
    shell.add(replace(mat, uv=(mat.vertices_m[:, :2] - corner) / (w, d)), rug)


def _window(build: Builder, wall: int, share: float) -> Parts:
    """Make a window with bars and a sill, and add curtains on both sides."""
    white = build.shop.white
    w = build.rng.uniform(1.1, 1.5)
    h = 1.25
    low = 0.9
    sky = m.plain("sky", (0.86, 0.93, 1.0), emission=4.2)
    along = w / 2 + 0.6 + share * (build.size[wall % 2] - w - 1.2)
    position = build.at_wall(wall, along)
    yaw = WALL_YAW_RAD[wall]
    window = Item("window")
    window.add(sheet((-w / 2, -0.012, low), (w, 0, 0), (0, 0, h)), sky)
    for x in (-w / 2, 0.0, w / 2):
        window.add(box(0.06, 0.07, h + 0.06, 0.012), white, x, -0.03, low - 0.03)
    for z in (low - 0.03, low + 0.62 * h, low + h):
        window.add(box(w, 0.06, 0.05, 0.012), white, 0, -0.03, z)
    sill = box(w + 0.2, 0.2, 0.035, 0.014, steps=3)
    window.add(sill, white, 0, -0.1, low - 0.06)
    x, y = position
    window = window.placed(x, y, 0.0, yaw)
    build.blocked.append((None, window.bounds_m()))
    for side in (-1, 1):
        offset = np.array([np.cos(yaw), np.sin(yaw)]) * side * (w / 2 + 0.22)
        curtains = build.hangings.curtains(0.42)
        x, y = position + offset
        build.add(curtains.placed(x, y, 0.0, yaw), -0.25)
    return window.parts
