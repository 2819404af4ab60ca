"""Furnishing: items are added to a room where they overlap nothing.

A room is composed with one corner at the origin.
"""

from collections.abc import Callable

import numpy as np

from rooms.clutter import SmallObjects
from rooms.furniture import FurnitureBuilder
from rooms.items import Item, overlaps
from rooms.wall_objects import WallObjects

WALL_YAW_RAD = (0.0, np.pi / 2, np.pi, -np.pi / 2)
"""Yaw with which an item at wall 0 (high y), 1 (low x), 2 (low y) or 3 (high x) faces the room."""


class Builder:
    """Adds items to a room without overlap."""

    def __init__(self, kind: str, seed: int):
        self.kind = kind
        self.rng = np.random.default_rng([seed, sum(map(ord, kind))])
        width = self.rng.uniform(5.0, 5.7)
        self.size = np.array([width, self.rng.uniform(4.7, 5.3), 2.55])
        self.shop = FurnitureBuilder(self.rng)
        self.trinkets = SmallObjects(self.shop)
        self.hangings = WallObjects(self.shop)
        self.items: list[Item] = []
        self.blocked: list[tuple[Item | None, np.ndarray]] = []
        """Bounding boxes of items, and of space that stays free."""

    def add(self, item: Item, gap_m: float = 0.03, host: Item | None = None) -> bool:
        """Add an item unless it overlaps another one (except its host) or leaves the room."""
        low, high = bounds = item.bounds_m()
        if (low[:2] < -0.01).any() or (high[:2] > self.size[:2] + 0.01).any():
            return False
        boxes = [b for owner, b in self.blocked if owner is None or owner is not host]
        if boxes and overlaps(bounds, boxes, gap_m):
            return False
        self.items.append(item)
        self.blocked.append((item, bounds))
        return True

    def at_wall(self, wall: int, along: float, gap_m: float = 0.0) -> np.ndarray:
        """Position (x, y) that is `along` metres along a wall and `gap_m` away from it."""
        spot = np.full(2, gap_m)
        if wall in (0, 3):
            spot = self.size[:2] - gap_m
        spot[wall % 2] = along
        return spot

    def along_wall(self, item: Item, wall: int, share: float, z: float = 0.0) -> bool:
        """Add an item at a wall (see `WALL_YAW_RAD`), `share` in 0..1 along it."""
        bounds = item.bounds_m()
        half = (bounds[1, 0] - bounds[0, 0]) / 2 + 0.01
        along = half + share * (self.size[wall % 2] - 2 * half)
        gap = 0.015 if z == 0.0 else 0.003
        spot = self.at_wall(wall, along, gap)
        return self.add(item.placed(spot[0], spot[1], z, WALL_YAW_RAD[wall]))

    def try_wall(
        self, make: Callable[[], Item], walls: tuple[int, ...], z: float = 0.0
    ) -> None:
        """Add an item at a random free position along one of the walls, if 30 tries find one."""
        item = make()
        for _ in range(30):
            wall = self.rng.choice(walls)
            if self.along_wall(item, wall, self.rng.random(), z):
                break

    def scatter(self, item: Item, makes: list[Callable[[], Item]], count: int) -> None:
        """Scatter small objects on the tops of an item."""
        for x0, x1, y0, y1, z in item.tops:
            for _ in range(count):
                thing = makes[self.rng.integers(len(makes))]()
                for _ in range(6):
                    x, y = self.rng.uniform((x0, y0), (x1, y1))
                    yaw = self.rng.uniform(0, 2 * np.pi)
                    if self.add(thing.placed(x, y, z + 0.001, yaw), 0.004, item):
                        break
