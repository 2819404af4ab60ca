"""Wall objects: cupboards, shelves, pictures, clocks, curtains, doors; back at y = 0."""

import numpy as np

from rooms import materials as m, prints
from rooms.furniture import FurnitureBuilder
from rooms.items import Item
from rooms.shapes import (
    FORWARD,
    Mesh,
    ball,
    box,
    drape,
    lathe,
    mirrored,
    positions,
    sheet,
    tube,
)


class WallObjects:
    """Makes wall objects from the materials of the room's furniture."""

    def __init__(self, shop: FurnitureBuilder):
        self.shop = shop
        self.rng = shop.rng

    def cupboard(self, w: float = 1.2) -> Item:
        """A wall cupboard with two doors and knobs."""
        paint = self.shop.paint
        cupboard = Item("cupboard")
        cupboard.add(box(w, 0.32, 0.65, 0.006), paint, 0, -0.16, 0)
        door = box(w / 2 - 0.01, 0.02, 0.63, 0.008)
        knob = ball(0.014).rotated(FORWARD)
        for side in (-1, 1):
            cupboard.add(door, paint, side * w / 4, -0.33, 0.01)
            cupboard.add(knob, self.shop.steel, side * 0.06, -0.335, 0.08)
        return cupboard

    def wall_shelf(self) -> Item:
        """A board on two curved brackets."""
        w = self.rng.uniform(0.7, 1.2)
        shelf = Item("wall shelf")
        board = box(w, 0.24, 0.028, 0.01, steps=3)
        shelf.add(board, self.shop.wood(), 0, -0.12, 0)
        t = np.linspace(0, np.pi / 2, 8)
        y = -0.01 - 0.17 * (1 - np.cos(t))
        z = -0.17 + 0.17 * np.sin(t)
        for x in mirrored(w / 3):
            shelf.add(tube(positions(x, y, z), 0.008), self.shop.dark)
        shelf.add_top(w / 2 - 0.04, 0.21, 0.03, 0.028)
        return shelf

    def picture(self) -> Item:
        """A framed picture."""
        shop = self.shop
        w = self.rng.uniform(0.35, 0.85)
        h = self.rng.uniform(0.3, 0.65)
        frame = shop.dark if self.rng.random() < 0.4 else shop.wood()
        picture = Item("picture")
        for z in (0, h - 0.03):
            picture.add(box(w, 0.022, 0.03, 0.008), frame, 0, -0.012, z)
        for x in mirrored(w / 2 - 0.015):
            picture.add(box(0.03, 0.022, h, 0.008), frame, x, -0.012, 0)
        corner = (-w / 2 + 0.02, -0.008, 0.02)
        canvas = sheet(corner, (w - 0.04, 0, 0), (0, 0, h - 0.04))
        picture.add(canvas, prints.painting(shop.name("painting"), self.rng))
        return picture

    def clock(self) -> Item:
        """A round wall clock."""
        r = self.rng.uniform(0.13, 0.18)
        profile = [
            (r, 0), (r + 0.02, 0), (r + 0.02, 0.025), (r + 0.005, 0.035), (r - 0.005, 0.02)
        ]  # fmt: skip
        rim = lathe(profile, 36, 2).rotated(FORWARD)
        angle = np.linspace(0, 2 * np.pi, 37)[:-1]
        number = np.arange(36)
        circle = positions(r * np.cos(angle), r * np.sin(angle), 0.0)
        points = np.concatenate([circle, np.zeros((1, 3))])
        fan = positions(36, number, (number + 1) % 36)
        uv = 0.5 + points[:, :2] / (2 * r)
        face = Mesh(points, fan, np.tile([0.0, 0, 1], (37, 1)), uv).rotated(FORWARD)
        clock = Item("clock")
        clock.add(rim, self.shop.dark, 0, 0, r)
        clock.add(face, prints.clock_face("clock"), 0, -0.012, r)
        return clock

    def curtains(self, w: float = 0.5) -> Item:
        """A curtain on a rod at a height of 2.2 m."""
        curtain = drape(w, 2.05, 0.035, 6, int(self.rng.integers(99)))
        end = w / 2 + 0.1
        rod = tube(positions((-end, 0, end), -0.08, 2.19), 0.012)
        curtains = Item("curtain")
        curtains.add(curtain, self.shop.cloths[1], 0, -0.08, 0.12)
        curtains.add(rod, self.shop.dark)
        return curtains

    def striped_curtain(self) -> Item:
        """A striped curtain with equal folds; hung side by side, it covers a wall."""
        w = 0.5
        stripes = m.striped("stripes", (0.5, 0.1, 0.12), (0.85, 0.8, 0.66), 1.4 * w / 2)
        curtain = Item("striped curtain")
        curtain.add(drape(w, 2.2, 0.035, 6, None), stripes, 0, -0.06, 0.05)
        curtain.add(box(w, 0.04, 0.04, 0.008), self.shop.dark, 0, -0.06, 2.25)
        return curtain

    def door(self) -> Item:
        """A panelled door with a lever and a frame."""
        shop = self.shop
        door = Item("door")
        door.add(box(0.86, 0.035, 2.0, 0.008), shop.wood(), 0, -0.02, 0)
        for z, h in ((0.15, 0.75), (1.05, 0.8)):
            panel = box(0.3, 0.03, h, 0.014, steps=3)
            for x in mirrored(0.2):
                door.add(panel, shop.woods[0], x, -0.032, z)
        for x in mirrored(0.48):
            door.add(box(0.09, 0.05, 2.08, 0.012), shop.white, x, -0.025, 0)
        door.add(box(1.05, 0.05, 0.09, 0.012), shop.white, 0, -0.025, 2.0)
        lever = positions((0.36, 0.36, 0.33, 0.24), (-0.03, -0.08, -0.09, -0.09), 1.0)
        door.add(tube(lever, 0.011), shop.steel)
        return door
