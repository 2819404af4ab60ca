"""Rooms composed from a seed, each with a table for the robot.

`KINDS` are rooms of a home. `REPEATED` rooms consist mostly of identical copies: floor tiles,
curtains, racks, tables, chairs.

Base frame: origin at the centre of the robot's foot on the table top, x to the front, z up. A room
is composed with one corner at the origin and shifted at the end.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from evercal.typing import Array
from rooms import materials as m
from rooms.clutter import SmallObjects
from rooms.furniture import FurnitureBuilder
from rooms.items import Item
from rooms.shapes import Mesh, about_x, box, cylinder, lathe, sheet
from rooms.wall_objects import WallObjects

RESERVED = 9000
"""Seeds from this one on are reserved for final evaluation."""

FLOOR: tuple[tuple[float, float, float], ...] = (
    (0.56, 0.40, 0.26), (0.68, 0.53, 0.36), (0.42, 0.29, 0.2), (0.74, 0.62, 0.46),
)  # fmt: skip
WALLS: tuple[tuple[float, float, float], ...] = (
    (0.86, 0.84, 0.79), (0.78, 0.82, 0.80), (0.84, 0.79, 0.70), (0.74, 0.79, 0.84),
    (0.83, 0.77, 0.76),
)  # fmt: skip

WALL_YAW_RAD = (0.0, np.pi / 2, np.pi, -np.pi / 2)
"""Yaw with which an item at wall 0 (high y), 1 (low x), 2 (low y) or 3 (high x) faces the room."""


@dataclass(eq=False)
class Room:
    """A furnished room without the robot, in the base frame."""

    kind: str
    """One of `KINDS` or `REPEATED`."""
    seed: int
    """Seed of the composition."""
    shell: list[tuple[Mesh, m.Material]]
    """Walls, floor, ceiling, windows and lamps."""
    items: list[Item]
    """Furniture and small objects."""
    low_m: Array
    """Lowest corner, shape (3,)."""
    high_m: Array
    """Highest corner, shape (3,)."""

    def boxes_m(self) -> Array:
        """Bounding boxes of all items, shape (n, 2, 3)."""
        return np.stack([item.bounds_m() for item in self.items])

    def meshes(self) -> list[tuple[Mesh, m.Material]]:
        """All meshes with their materials."""
        return self.shell + [part for item in self.items for part in item.parts]

    def is_free(self, points_m: Array, margin_m: float = 0.12) -> Array:
        """Whether points (n, 3) are inside the room and outside all items, with a margin."""
        inside = (points_m > self.low_m + margin_m) & (
            points_m < self.high_m - margin_m
        )
        boxes = self.boxes_m()
        low = boxes[:, 0] - margin_m
        high = boxes[:, 1] + margin_m
        hit = (points_m[:, None] > low) & (points_m[:, None] < high)
        return np.asarray(inside.all(-1) & ~hit.all(-1).any(-1))


class _Builder:
    """Adds items to a room without overlap."""

    def __init__(self, kind: str, seed: int):
        self.rng = np.random.default_rng([seed, sum(map(ord, kind))])
        self.size = np.array(
            [self.rng.uniform(5.0, 5.7), self.rng.uniform(4.7, 5.3), 2.55]
        )
        self.shop = FurnitureBuilder(self.rng)
        self.trinkets = SmallObjects(self.shop)
        self.hangings = WallObjects(self.shop)
        self.items: list[Item] = []
        self.blocked: list[tuple[Item | None, Array]] = []

    def add(self, item: Item, gap_m: float = 0.03, host: Item | None = None) -> bool:
        """Add an item unless it overlaps another one (except its host) or leaves the room."""
        bounds = item.bounds_m()
        if (bounds[0, :2] < -0.01).any() or (
            bounds[1, :2] > self.size[:2] + 0.01
        ).any():
            return False
        for owner, other in self.blocked:
            if owner is not None and owner is host:
                continue
            if (bounds[0] < other[1] + gap_m).all() and (
                bounds[1] > other[0] - gap_m
            ).all():
                return False
        self.items.append(item)
        self.blocked.append((item, bounds))
        return True

    def along_wall(self, item: Item, wall: int, at: float, z: float = 0.0) -> bool:
        """Add an item at a wall (see `WALL_YAW_RAD`), `at` in 0..1 along it."""
        x, y, _ = self.size
        bounds = item.bounds_m()
        half = (bounds[1, 0] - bounds[0, 0]) / 2 + 0.01
        length = x if wall % 2 == 0 else y
        along = half + at * (length - 2 * half)
        gap = 0.015 if z == 0.0 else 0.003
        position = ((along, y - gap), (gap, along), (along, gap), (x - gap, along))[
            wall
        ]
        return self.add(item.placed(*position, z, WALL_YAW_RAD[wall]))

    def try_wall(
        self, make: Callable[[], Item], walls: tuple[int, ...], z: float = 0.0
    ) -> bool:
        """Add an item at a random free position along one of the walls."""
        item = make()
        for _ in range(30):
            wall = int(self.rng.choice(walls))
            if self.along_wall(item, wall, self.rng.random(), z):
                return True
        return False

    def scatter(self, item: Item, makes: list[Callable[[], Item]], count: int) -> None:
        """Scatter small objects on the tops of an item."""
        for x0, x1, y0, y1, z in item.tops:
            for _ in range(count):
                thing = makes[self.rng.integers(len(makes))]()
                for _ in range(6):
                    x = self.rng.uniform(x0, x1)
                    y = self.rng.uniform(y0, y1)
                    yaw = self.rng.uniform(0, 2 * np.pi)
                    if self.add(thing.placed(x, y, z + 0.001, yaw), 0.004, item):
                        break


def room(kind: str, seed: int) -> Room:
    """Compose a room. The same kind and seed give the same room.

    Raises:
        ValueError: The kind is unknown or the seed is reserved.
    """
    kinds = KINDS | REPEATED
    if kind not in kinds:
        raise ValueError(f"room kind is one of {', '.join(kinds)}, got {kind!r}")
    if not 0 <= seed < RESERVED:
        raise ValueError(
            f"room seeds are 0 to {RESERVED - 1}; higher ones are reserved, got {seed}"
        )
    build = _Builder(kind, seed)
    shell = _shell(build, kind)
    base = np.array([0.46 * build.size[0], build.size[1] / 2, 0.0])
    base[2] = _robot_table(build, base, repeated=kind in REPEATED)
    kinds[kind](build)
    if kind in REPEATED:
        _few_landmarks(build)
    else:
        _fill_up(build)
    for item in build.items[1:]:
        if item.tops:
            build.scatter(item, _small_things(build.trinkets, kind), 5)
    shift = -base
    items = [item.placed(*shift) for item in build.items]
    shell = [(mesh.shifted(*shift), material) for mesh, material in shell]
    return Room(kind, seed, shell, items, shift, build.size + shift)


def _small_things(t: SmallObjects, kind: str) -> list[Callable[[], Item]]:
    both = [t.mug, t.books, t.vase, t.plant, t.jar]
    if kind == "kitchen":
        return [*both, t.bowl, t.plate, t.bottle, t.carton, t.pot, t.kettle, t.jar]
    return [*both, t.lamp, t.toy_ball, t.blocks, t.radio, t.bowl, t.bottle]


def _robot_table(build: _Builder, base: Array, repeated: bool) -> float:
    """Add the robot's table with small objects around the work area, and return its height."""
    height = 0.74
    table = build.shop.table(1.5, 0.95, height).placed(
        base[0] + 0.3, base[1] + 0.475, 0.0
    )
    build.add(table)
    # The foot of the arm and the centre of the work area stay free.
    foot = np.array(
        [[base[0] - 0.2, base[1] - 0.2, height], [base[0] + 0.2, base[1] + 0.2, 2.0]]
    )
    build.blocked.append((None, foot))
    t = build.trinkets
    if repeated:
        x, y = (float(value) for value in base[:2])
        build.add(t.chessboard(0.025).placed(x + 0.45, y, height + 0.001), 0.01, table)
        jar = t.jar()
        for side in (-0.4, 0.4):
            for offset in np.linspace(-0.3, 0.9, 7):
                build.add(jar.placed(x + offset, y + side, height + 0.001), 0.01, table)
    makes = [
        t.mug,
        t.blocks,
        t.carton,
        t.bowl,
        t.jar,
        t.books,
        t.bottle,
        t.plant,
        t.toy_ball,
    ]
    order = build.rng.permutation(len(makes))
    for k in range(3 if repeated else 11):
        thing = makes[order[k % len(makes)]]()
        for _ in range(25):
            x = base[0] + build.rng.uniform(-0.35, 0.98)
            y = base[1] + build.rng.uniform(-0.42, 0.42)
            near = np.hypot(x - base[0] - 0.45, y - base[1]) < 0.16
            yaw = build.rng.uniform(0, 6)
            placed = thing.placed(float(x), float(y), height + 0.001, yaw)
            if not near and build.add(placed, 0.01, table):
                break
    return height


def _bedroom(build: _Builder) -> None:
    shop = build.shop
    build.along_wall(shop.bed(), 0, 0.14)
    build.along_wall(shop.drawers(), 1, 0.3)
    build.try_wall(shop.wardrobe, (1, 2))
    build.try_wall(shop.bookcase, (1, 2))
    build.try_wall(shop.armchair, (2,))


def _kitchen(build: _Builder) -> None:
    shop = build.shop
    build.along_wall(shop.counter(), 1, 0.6)
    for at in (0.25, 0.62):
        build.along_wall(build.hangings.cupboard(), 1, at, 1.45)
    build.along_wall(shop.fridge(), 1, 0.02)
    build.try_wall(lambda: shop.table(1.1, 0.7), (0, 2))
    build.try_wall(lambda: shop.counter(1.8), (0, 2))
    for _ in range(2):
        build.try_wall(shop.chair, (0, 2))


def _living(build: _Builder) -> None:
    shop = build.shop
    build.along_wall(shop.sofa(), 1, 0.6)
    build.along_wall(shop.round_table(), 1, 0.12)
    build.try_wall(shop.bookcase, (0, 2))
    build.try_wall(shop.bookcase, (0, 2))
    build.try_wall(shop.armchair, (0, 2))
    build.try_wall(shop.floor_lamp, (0, 1, 2))


KINDS = {"bedroom": _bedroom, "kitchen": _kitchen, "living": _living}


def _workshop(build: _Builder) -> None:
    shop = build.shop
    t = build.trinkets
    crates = [
        [(mesh.scaled(1.5), mat) for mesh, mat in t.carton().parts] for _ in range(2)
    ]
    things = [Item("carton", crates[0]), t.jar(), Item("carton", crates[1]), t.bottle()]
    _line_up(build, _stocked(shop.rack(), things), 1)
    _in_rows(build, _stocked(shop.table(1.0, 0.6), things[:3]), 4, 2)
    board = t.chessboard(0.07)
    parts = [
        (mesh.rotated(about_x(np.pi / 2)), material) for mesh, material in board.parts
    ]
    build.try_wall(lambda: Item(board.kind, parts), (0, 2), 1.5)


def _canteen(build: _Builder) -> None:
    shop = build.shop
    t = build.trinkets
    _line_up(build, build.hangings.cupboard(), 1, 1.45)
    table = shop.table(0.9, 0.65)
    chair = shop.chair()
    laid = _stocked(table, [t.plate(), t.mug(), t.bottle(), t.plate()])
    for chair_y, yaw in ((0.25, 0.0), (-0.9, np.pi)):
        laid.parts += chair.placed(0, chair_y, 0, yaw).parts
    _in_rows(build, laid, 4, 3)


def _hall(build: _Builder) -> None:
    _line_up(build, build.hangings.striped_curtain(), 1)
    _in_rows(build, build.shop.chair().placed(0, 0, 0, WALL_YAW_RAD[3]), 7, 6)


REPEATED = {"workshop": _workshop, "canteen": _canteen, "hall": _hall}

TILES = {
    "workshop": ((0.55, 0.56, 0.56), (0.55, 0.56, 0.56), 0.6),
    "canteen": ((0.72, 0.62, 0.5), (0.72, 0.62, 0.5), 0.4),
    "hall": ((0.84, 0.82, 0.77), (0.16, 0.17, 0.2), 0.5),
}
"""Two colours of floor tiles and the size of two tiles in metres, by kind."""


def _stocked(item: Item, things: Sequence[Item]) -> Item:
    """The item with the same things in a row on each of its tops, as one object."""
    parts = list(item.parts)
    for x0, x1, y0, y1, z in item.tops:
        for x, thing in zip(
            np.linspace(x0, x1, len(things) + 2)[1:-1], things, strict=True
        ):
            parts += thing.placed(x, (y0 + y1) / 2, z + 0.001).parts
    return Item(item.kind, parts)


def _line_up(build: _Builder, item: Item, wall: int, z: float = 0.0) -> None:
    """Cover a wall with copies of an item, at equal distances."""
    width = float(np.ptp(item.bounds_m()[:, 0]))
    # `add` keeps 3 cm between items.
    count = int(build.size[wall % 2] // (width + 0.06))
    for at in np.linspace(0, 1, count):
        build.along_wall(item, wall, float(at), z)


def _in_rows(build: _Builder, item: Item, columns: int, rows: int) -> None:
    """Stand copies of an item in a grid on the floor, wherever there is space."""
    low, high = item.bounds_m()[:, :2]
    first = 0.35 - low
    last = build.size[:2] - 0.35 - high
    for x in np.linspace(first[0], last[0], columns):
        for y in np.linspace(first[1], last[1], rows):
            build.add(item.placed(float(x), float(y), 0.0))


def _few_landmarks(build: _Builder) -> None:
    """Add a few things that occur once: a door, a clock, pictures and a wall shelf."""
    hangings = build.hangings
    build.try_wall(hangings.door, (3, 2))
    build.try_wall(hangings.clock, (0, 1, 2), 1.85)
    build.try_wall(hangings.wall_shelf, (0, 2), 1.4)
    for _ in range(4):
        build.try_wall(hangings.picture, (0, 1, 2, 3), build.rng.uniform(1.25, 1.6))


def _fill_up(build: _Builder) -> None:
    """Add what every room has: a door, furniture, wall objects and plants."""
    shop = build.shop
    t = build.trinkets
    rng = build.rng
    build.try_wall(build.hangings.door, (3, 2))
    chair = shop.chair
    drawers = shop.drawers
    for make in (drawers, chair, shop.floor_lamp, shop.round_table, chair, drawers):
        build.try_wall(make, (0, 2, 3))
    build.try_wall(build.hangings.clock, (0, 1, 2), rng.uniform(1.75, 1.95))
    for _ in range(3):
        build.try_wall(build.hangings.wall_shelf, (0, 1, 2), rng.uniform(1.3, 1.6))
    for _ in range(9):
        build.try_wall(build.hangings.picture, (0, 1, 1, 2, 3), rng.uniform(1.25, 1.6))
    for make in (t.plant, t.basket, t.toy_ball, t.basket, t.plant):
        thing = make()
        if thing.kind == "plant":  # larger than on tables
            parts = [(mesh.scaled(2.6), material) for mesh, material in thing.parts]
            thing = Item(thing.kind, parts)
        for _ in range(20):
            spot = rng.uniform((0.25, 0.25), build.size[:2] - 0.25)
            by_wall = np.minimum(spot, build.size[:2] - spot).min() < 0.9
            if by_wall and build.add(thing.placed(float(spot[0]), float(spot[1]), 0.0)):
                break


def _shell(build: _Builder, kind: str) -> list[tuple[Mesh, m.Material]]:
    """Make walls, floor, ceiling, skirting, windows with curtains, a ceiling lamp, a carpet."""
    x, y, z = (float(side) for side in build.size)
    rng = build.rng
    shop = build.shop
    tone = WALLS[rng.integers(len(WALLS))]
    paint = m.plaster("plaster", tone, rng)
    accent = m.wallpaper("wallpaper", WALLS[rng.integers(len(WALLS))], rng)
    if kind == "kitchen":
        floor = m.tiles("floor", (0.66, 0.62, 0.56), rng, 4, 1.3)
        accent = m.tiles("splash", WALLS[rng.integers(len(WALLS))], rng, 5, 0.75)
    elif kind in REPEATED:
        floor = m.equal_tiles("floor", *TILES[kind], rng)
    else:
        floor = m.boards("floor", FLOOR[rng.integers(len(FLOOR))], rng)
    ceiling = m.plaster("ceiling", (0.9, 0.9, 0.88), rng)
    slabs = [
        (_panel((0, 0, 0), (x, 0, 0), (0, y, 0)), floor),
        (_panel((0, y, z), (x, 0, 0), (0, -y, 0)), ceiling),
        (_panel((0, y, 0), (x, 0, 0), (0, 0, z)), paint),
        (_panel((0, 0, 0), (0, y, 0), (0, 0, z)), accent),
        (_panel((x, 0, 0), (-x, 0, 0), (0, 0, z)), paint),
        (_panel((x, y, 0), (0, -y, 0), (0, 0, z)), paint),
    ]
    for py in (0.008, y - 0.008):
        slabs.append((box(x, 0.016, 0.08, 0.006).shifted(x / 2, py, 0), shop.white))
    for px in (0.008, x - 0.008):
        slabs.append((box(0.016, y, 0.08, 0.006).shifted(px, y / 2, 0), shop.white))
    for wall, low, high in ((0, 0.45, 0.75), (2, 0.2, 0.5), (3, 0.3, 0.7)):
        slabs += _window(build, wall, rng.uniform(low, high))
    # A broad ceiling lamp keeps shadows soft and noise low.
    lamp = m.plain("lamp", (1.0, 0.95, 0.87), emission=5.0)
    slabs.append(
        (cylinder(0.38, 0.05, 0.01, 48).shifted(0.55 * x, y / 2, z - 0.07), lamp)
    )
    rim = lathe([(0.38, 0), (0.4, 0), (0.4, 0.06), (0.38, 0.06)], 48, 1)
    slabs.append((rim.shifted(0.55 * x, y / 2, z - 0.06), shop.steel))
    if kind in REPEATED:  # a carpet would hide the tiles
        return slabs
    rug = m.carpet("carpet", tuple(rng.uniform(0.2, 0.6, 3).tolist()), rng)
    w = 0.62 * x
    d = 0.55 * y
    mat = box(w, d, 0.012, 0.005, bottom=False).shifted(0.5 * x, y / 2, 0.0)
    uv = (mat.vertices_m[:, :2] - (0.5 * x - w / 2, y / 2 - d / 2)) / (w, d)
    slabs.append((Mesh(mat.vertices_m, mat.faces, mat.normals, uv), rug))
    return slabs


def _panel(corner: tuple, u: tuple, v: tuple) -> Mesh:
    """A wall that faces inwards, with texture coordinates in metres."""
    flat = sheet(corner, u, v)
    return replace(flat, uv=flat.uv * (np.linalg.norm(u), np.linalg.norm(v)))


def _window(build: _Builder, wall: int, at: float) -> list[tuple[Mesh, m.Material]]:
    """Make a window with bars and a sill, and add curtains on both sides."""
    shop = build.shop
    rng = build.rng
    w = rng.uniform(1.1, 1.5)
    h = 1.25
    low = 0.9
    sky = m.plain("sky", (0.86, 0.93, 1.0), emission=4.2)
    x, y, _ = build.size
    length = x if wall % 2 == 0 else y
    along = w / 2 + 0.6 + at * (length - w - 1.2)
    position = ((along, y, 0.0), (0.0, along, 0.0), (along, 0.0, 0.0), (x, along, 0.0))[
        wall
    ]
    yaw = WALL_YAW_RAD[wall]
    parts = [(sheet((-w / 2, -0.012, low), (w, 0, 0), (0, 0, h)), sky)]
    for px in (-w / 2, 0.0, w / 2):
        parts.append(
            (
                box(0.06, 0.07, h + 0.06, 0.012).shifted(px, -0.03, low - 0.03),
                shop.white,
            )
        )
    for pz in (low - 0.03, low + 0.62 * h, low + h):
        parts.append((box(w, 0.06, 0.05, 0.012).shifted(0, -0.03, pz), shop.white))
    sill = box(w + 0.2, 0.2, 0.035, 0.014, steps=3).shifted(0, -0.1, low - 0.06)
    parts.append((sill, shop.white))
    frame = Item("window", parts).placed(*position, yaw)
    build.blocked.append((None, frame.bounds_m()))
    for side in (-1, 1):
        offset = np.array([np.cos(yaw), np.sin(yaw), 0.0]) * side * (w / 2 + 0.22)
        cx, cy, _ = (np.array(position) + offset).tolist()
        build.add(build.hangings.curtains(0.42).placed(cx, cy, 0.0, yaw), -0.25)
    return frame.parts
