"""Rooms composed from a seed, each with a table for the robot.

`KINDS` are rooms of a home. `REPEATED` rooms consist mostly of identical copies: floor tiles,
curtains, racks, tables, chairs.

Base frame: origin at the centre of the robot's foot on the table top, x to the front, z up. A room
is composed with one corner at the origin and shifted at the end.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from evercal.typing import BoolArray
from rooms.builder import WALL_YAW_RAD, Builder
from rooms.items import Item, Parts
from rooms.shapes import FORWARD, mirrored
from rooms.shell import build_shell

RESERVED = 9000
"""Seeds from this one on are reserved for final evaluation."""
TABLE_M = 0.74
"""Height of the robot's table, metres."""


@dataclass(eq=False)
class Room:
    """A furnished room without the robot, in the base frame."""

    kind: str
    """One of `KINDS` or `REPEATED`."""
    seed: int
    """Seed of the composition."""
    shell: Parts
    """Walls, floor, ceiling, windows and lamps."""
    items: list[Item]
    """Furniture and small objects."""
    low_m: np.ndarray
    """Lowest corner, shape (3,)."""
    high_m: np.ndarray
    """Highest corner, shape (3,)."""

    def boxes_m(self) -> np.ndarray:
        """Bounding boxes of all items, shape (n, 2, 3)."""
        return np.stack([item.bounds_m() for item in self.items])

    def meshes(self) -> Parts:
        """All meshes with their materials."""
        return sum((item.parts for item in self.items), self.shell)

    def is_free(self, points_m: np.ndarray, margin_m: float = 0.12) -> BoolArray:
        """Whether points (n, 3) are inside the room and outside all items, with a margin."""
        above = points_m > self.low_m + margin_m
        inside = above & (points_m < self.high_m - margin_m)
        low, high = self.boxes_m().swapaxes(0, 1)
        points_m = points_m[:, None]
        hit = (points_m > low - margin_m) & (points_m < high + margin_m)
        return inside.all(-1) & ~hit.all(-1).any(-1)


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
    build = Builder(kind, seed)
    shell = build_shell(build)
    base = np.array([0.46 * build.size[0], build.size[1] / 2, TABLE_M])
    _robot_table(build, *base[:2])
    kinds[kind](build)
    if kind in REPEATED:
        _few_landmarks(build)
    else:
        _fill_up(build)
    makes = _small_things(build)
    for item in build.items[1:]:
        build.scatter(item, makes, 5)
    shift = -base
    items = [item.placed(*shift) for item in build.items]
    shell = [(mesh.shifted(*shift), material) for mesh, material in shell]
    return Room(kind, seed, shell, items, shift, build.size + shift)


def _small_things(build: Builder) -> list[Callable[[], Item]]:
    t = build.trinkets
    things = [t.mug, t.books, t.vase, t.plant, t.jar]
    if build.kind == "kitchen":
        return [*things, t.bowl, t.plate, t.bottle, t.carton, t.pot, t.kettle, t.jar]
    return [*things, t.lamp, t.toy_ball, t.blocks, t.radio, t.bowl, t.bottle]


def _robot_table(build: Builder, x: float, y: float) -> None:
    """Add the robot's table with small objects around the work area; the foot is at (x, y)."""
    rng = build.rng
    t = build.trinkets
    repeated = build.kind in REPEATED
    table = build.shop.table(1.5, 0.95, TABLE_M).placed(x + 0.3, y + 0.475, 0.0)
    build.add(table)
    # The foot of the arm and the centre of the work area stay free.
    foot = np.array([[x - 0.2, y - 0.2, TABLE_M], [x + 0.2, y + 0.2, 2.0]])
    build.blocked.append((None, foot))
    top = TABLE_M + 0.001
    if repeated:
        build.add(t.chessboard(0.025).placed(x + 0.45, y, top), 0.01, table)
        jar = t.jar()
        for side in mirrored(0.4):
            for offset in np.linspace(-0.3, 0.9, 7):
                build.add(jar.placed(x + offset, y + side, top), 0.01, table)
    makes = [
        t.mug, t.blocks, t.carton, t.bowl, t.jar, t.books, t.bottle, t.plant, t.toy_ball
    ]  # fmt: skip
    order = rng.permutation(len(makes))
    if repeated:
        order = order[:3]
    else:
        order = [*order, *order[:2]]
    for number in order:
        thing = makes[number]()
        for _ in range(25):
            thing_x = x + rng.uniform(-0.35, 0.98)
            thing_y = y + rng.uniform(-0.42, 0.42)
            placed = thing.placed(thing_x, thing_y, top, rng.uniform(0, 6))
            near = np.hypot(thing_x - x - 0.45, thing_y - y) < 0.16
            if not near and build.add(placed, 0.01, table):
                break


def _bedroom(build: Builder) -> None:
    shop = build.shop
    build.along_wall(shop.bed(), 0, 0.14)
    build.along_wall(shop.drawers(), 1, 0.3)
    build.try_wall(shop.wardrobe, (1, 2))
    build.try_wall(shop.bookcase, (1, 2))
    build.try_wall(shop.armchair, (2,))


def _kitchen(build: Builder) -> None:
    shop = build.shop
    build.along_wall(shop.counter(), 1, 0.6)
    for share in (0.25, 0.62):
        build.along_wall(build.hangings.cupboard(), 1, share, 1.45)
    build.along_wall(shop.fridge(), 1, 0.02)
    build.try_wall(lambda: shop.table(1.1, 0.7), (0, 2))
    build.try_wall(lambda: shop.counter(1.8), (0, 2))
    for _ in range(2):
        build.try_wall(shop.chair, (0, 2))


def _living(build: Builder) -> None:
    shop = build.shop
    build.along_wall(shop.sofa(), 1, 0.6)
    build.along_wall(shop.round_table(), 1, 0.12)
    build.try_wall(shop.bookcase, (0, 2))
    build.try_wall(shop.bookcase, (0, 2))
    build.try_wall(shop.armchair, (0, 2))
    build.try_wall(shop.floor_lamp, (0, 1, 2))


KINDS = {"bedroom": _bedroom, "kitchen": _kitchen, "living": _living}


def _workshop(build: Builder) -> None:
    shop = build.shop
    t = build.trinkets
    crates = [t.carton().scaled(1.5) for _ in range(2)]
    things = [crates[0], t.jar(), crates[1], t.bottle()]
    _line_up(build, _stocked(shop.rack(), things), 1)
    _in_rows(build, _stocked(shop.table(1.0, 0.6), things[:3]), 4, 2)
    board = Item("chessboard")
    for mesh, material in t.chessboard(0.07).parts:
        board.add(mesh.rotated(FORWARD), material)
    build.try_wall(lambda: board, (0, 2), 1.5)


def _canteen(build: Builder) -> None:
    shop = build.shop
    t = build.trinkets
    _line_up(build, build.hangings.cupboard(), 1, 1.45)
    table = shop.table(0.9, 0.65)
    chair = shop.chair()
    laid = _stocked(table, [t.plate(), t.mug(), t.bottle(), t.plate()])
    laid.parts += chair.placed(0, 0.25, 0).parts
    laid.parts += chair.placed(0, -0.9, 0, np.pi).parts
    _in_rows(build, laid, 4, 3)


def _hall(build: Builder) -> None:
    _line_up(build, build.hangings.striped_curtain(), 1)
    _in_rows(build, build.shop.chair().placed(0, 0, 0, WALL_YAW_RAD[3]), 7, 6)


REPEATED = {"workshop": _workshop, "canteen": _canteen, "hall": _hall}


def _stocked(item: Item, things: Sequence[Item]) -> Item:
    """The item with the same things in a row on each of its tops, as one object."""
    parts = list(item.parts)
    for x0, x1, y0, y1, z in item.tops:
        places = np.linspace(x0, x1, len(things) + 2)[1:-1]
        for x, thing in zip(places, things, strict=True):
            parts += thing.placed(x, (y0 + y1) / 2, z + 0.001).parts
    return Item(item.kind, parts)


def _line_up(build: Builder, item: Item, wall: int, z: float = 0.0) -> None:
    """Cover a wall with copies of an item, at equal distances."""
    width = np.ptp(item.bounds_m()[:, 0])
    # `add` keeps 3 cm between items.
    count = int(build.size[wall % 2] // (width + 0.06))
    for share in np.linspace(0, 1, count):
        build.along_wall(item, wall, share, z)


def _in_rows(build: Builder, item: Item, columns: int, rows: int) -> None:
    """Stand copies of an item in a grid on the floor, wherever there is space."""
    low, high = item.bounds_m()[:, :2]
    first = 0.35 - low
    last = build.size[:2] - 0.35 - high
    for x in np.linspace(first[0], last[0], columns):
        for y in np.linspace(first[1], last[1], rows):
            build.add(item.placed(x, y, 0.0))


def _few_landmarks(build: Builder) -> None:
    """Add a few things that occur once: a door, a clock, pictures and a wall shelf."""
    hangings = build.hangings
    build.try_wall(hangings.door, (3, 2))
    build.try_wall(hangings.clock, (0, 1, 2), 1.85)
    build.try_wall(hangings.wall_shelf, (0, 2), 1.4)
    for _ in range(4):
        build.try_wall(hangings.picture, (0, 1, 2, 3), build.rng.uniform(1.25, 1.6))


def _fill_up(build: Builder) -> None:
    """Add what every room has: a door, furniture, wall objects and plants."""
    shop = build.shop
    hangings = build.hangings
    t = build.trinkets
    rng = build.rng
    build.try_wall(hangings.door, (3, 2))
    chair = shop.chair
    drawers = shop.drawers
    for make in (drawers, chair, shop.floor_lamp, shop.round_table, chair, drawers):
        build.try_wall(make, (0, 2, 3))
    build.try_wall(hangings.clock, (0, 1, 2), rng.uniform(1.75, 1.95))
    for _ in range(3):
        build.try_wall(hangings.wall_shelf, (0, 1, 2), rng.uniform(1.3, 1.6))
    for _ in range(9):
        build.try_wall(hangings.picture, (0, 1, 1, 2, 3), rng.uniform(1.25, 1.6))
    for make in (t.plant, t.basket, t.toy_ball, t.basket, t.plant):
        thing = make()
        if thing.kind == "plant":  # larger than on tables
            thing = thing.scaled(2.6)
        for _ in range(20):
            spot = rng.uniform(0.25, build.size[:2] - 0.25)
            by_wall = np.minimum(spot, build.size[:2] - spot).min() < 0.9
            if by_wall and build.add(thing.placed(spot[0], spot[1], 0.0)):
                break
