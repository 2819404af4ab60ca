"""Wall objects: cupboards, shelves, pictures, clocks, curtains, doors; back at y = 0."""

import numpy as np

from rooms import materials as m
from rooms.furniture import FurnitureBuilder, Item
from rooms.shapes import Mesh, about_x, ball, box, drape, lathe, sheet, tube


class WallObjects:
    """Makes wall objects from the materials of the room's furniture."""

    def __init__(self, shop: FurnitureBuilder):
        self.shop = shop
        self.rng = shop.rng

    def cupboard(self, w: float = 1.2) -> Item:
        """A wall cupboard with two doors and knobs."""
        shop = self.shop
        parts = [(box(w, 0.32, 0.65, 0.006).shifted(0, -0.16, 0), shop.paint)]
        for x, knob in ((-w / 4, -0.06), (w / 4, 0.06)):
            parts.append(
                (
                    box(w / 2 - 0.01, 0.02, 0.63, 0.008).shifted(x, -0.33, 0.01),
                    shop.paint,
                )
            )
            handle = ball(0.014).rotated(about_x(np.pi / 2), (knob, -0.335, 0.08))
            parts.append((handle, shop.steel))
        return Item("cupboard", parts)

    def wall_shelf(self) -> Item:
        """A board on two curved brackets."""
        shop = self.shop
        w = self.rng.uniform(0.7, 1.2)
        parts = [(box(w, 0.24, 0.028, 0.01, steps=3).shifted(0, -0.12, 0), shop.wood())]
        for x in (-w / 3, w / 3):
            t = np.linspace(0, np.pi / 2, 8)
            arc = np.stack(
                [
                    np.full(8, x),
                    -0.01 - 0.17 * (1 - np.cos(t)),
                    -0.17 + 0.17 * np.sin(t),
                ],
                -1,
            )
            parts.append((tube(arc, 0.008), shop.dark))
        return Item(
            "wall shelf", parts, [(-w / 2 + 0.04, w / 2 - 0.04, -0.21, -0.03, 0.028)]
        )

    def picture(self) -> Item:
        """A framed picture."""
        shop = self.shop
        w = self.rng.uniform(0.35, 0.85)
        h = self.rng.uniform(0.3, 0.65)
        frame = shop.dark if self.rng.random() < 0.4 else shop.wood()
        parts = [
            (box(w, 0.022, 0.03, 0.008).shifted(0, -0.012, z), frame)
            for z in (0, h - 0.03)
        ]
        for x in (-w / 2 + 0.015, w / 2 - 0.015):
            parts.append((box(0.03, 0.022, h, 0.008).shifted(x, -0.012, 0), frame))
        canvas = sheet(
            (-w / 2 + 0.02, -0.008, 0.02), (w - 0.04, 0, 0), (0, 0, h - 0.04)
        )
        parts.append((canvas, m.painting(shop.name("painting"), self.rng)))
        return Item("picture", parts)

    def clock(self) -> Item:
        """A round wall clock."""
        shop = self.shop
        r = self.rng.uniform(0.13, 0.18)
        rim = lathe(
            [
                (r, 0),
                (r + 0.02, 0),
                (r + 0.02, 0.025),
                (r + 0.005, 0.035),
                (r - 0.005, 0.02),
            ],
            36,
            2,
        )
        up = about_x(np.pi / 2)
        angle = np.linspace(0, 2 * np.pi, 37)[:-1]
        points = np.stack([r * np.cos(angle), r * np.sin(angle), np.zeros(36)], -1)
        fan = np.stack([np.full(36, 36), np.arange(36), (np.arange(36) + 1) % 36], -1)
        uv = np.concatenate([0.5 + points[:, :2] / (2 * r), [[0.5, 0.5]]])
        points = np.concatenate([points, [[0, 0, 0]]])
        face = Mesh(points, fan, np.tile([0.0, 0, 1], (37, 1)), uv).rotated(
            up, (0, -0.012, r)
        )
        rim = rim.rotated(up, (0, 0, r))
        return Item("clock", [(rim, shop.dark), (face, m.clock_face("clock"))])

    def curtains(self, w: float = 0.5) -> Item:
        """A curtain on a rod at a height of 2.2 m."""
        shop = self.shop
        curtain = drape(w, 2.05, 0.035, 6, int(self.rng.integers(99))).shifted(
            0, -0.08, 0.12
        )
        rod = tube([(x, -0.08, 2.19) for x in (-w / 2 - 0.1, 0, w / 2 + 0.1)], 0.012)
        return Item("curtain", [(curtain, shop.cloths[1]), (rod, shop.dark)])

    def striped_curtain(self) -> Item:
        """A striped curtain with equal folds; hung side by side, it covers a wall."""
        w = 0.5
        folds = 6
        cloth = m.striped("stripes", (0.5, 0.1, 0.12), (0.85, 0.8, 0.66), 1.4 * w / 2)
        curtain = drape(w, 2.2, 0.035, folds, None).shifted(0, -0.06, 0.05)
        rail = box(w, 0.04, 0.04, 0.008).shifted(0, -0.06, 2.25)
        return Item("striped curtain", [(curtain, cloth), (rail, self.shop.dark)])

    def door(self) -> Item:
        """A panelled door with a lever and a frame."""
        shop = self.shop
        parts = [(box(0.86, 0.035, 2.0, 0.008).shifted(0, -0.02, 0), shop.wood())]
        for x, z, h in (
            (-0.2, 0.15, 0.75),
            (0.2, 0.15, 0.75),
            (-0.2, 1.05, 0.8),
            (0.2, 1.05, 0.8),
        ):
            parts.append(
                (box(0.3, 0.03, h, 0.014, steps=3).shifted(x, -0.032, z), shop.woods[0])
            )
        for x in (-0.48, 0.48):
            parts.append(
                (box(0.09, 0.05, 2.08, 0.012).shifted(x, -0.025, 0), shop.white)
            )
        parts.append((box(1.05, 0.05, 0.09, 0.012).shifted(0, -0.025, 2.0), shop.white))
        lever = [
            (0.36, -0.03, 1.0),
            (0.36, -0.08, 1.0),
            (0.33, -0.09, 1.0),
            (0.24, -0.09, 1.0),
        ]
        parts.append((tube(lever, 0.011), shop.steel))
        return Item("door", parts)
