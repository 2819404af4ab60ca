"""Small objects for tables, shelves and the floor. Each stands on z = 0, centred at x = y = 0."""

from dataclasses import replace

import numpy as np

from rooms import materials as m, prints
from rooms.furniture import CLOTHS, PAINTS, FurnitureBuilder, pick
from rooms.items import Item
from rooms.materials import Material
from rooms.shapes import (
    FORWARD,
    Mesh,
    about_y,
    ball,
    box,
    cushion,
    cylinder,
    lampshade,
    lathe,
    leaf,
    positions,
    sheet,
    tube,
)

FRUIT = {
    "orange": (0.85, 0.45, 0.1),
    "apple": (0.68, 0.12, 0.1),
    "lime": (0.45, 0.62, 0.15),
}
"""Colours of fruit, by kind."""
GLASS = ((0.08, 0.2, 0.1), (0.2, 0.1, 0.05), (0.3, 0.42, 0.5))
"""Colours of bottles."""
LEAVES = ((0.25, 0.42, 0.18), (0.33, 0.48, 0.22), (0.2, 0.34, 0.2))
"""Colours of plants."""


class SmallObjects:
    """Makes small objects from new materials and those of the room's furniture."""

    def __init__(self, shop: FurnitureBuilder):
        self.shop = shop
        self.rng = shop.rng
        self.glazes = [
            m.lacquer(f"glaze{i}", pick(self.rng, (*CLOTHS, *PAINTS)), self.rng)
            for i in range(3)
        ]
        self._spines: Material | None = None

    def glaze(self) -> Material:
        """One of three colours of ceramics."""
        return self.glazes[self.rng.integers(len(self.glazes))]

    def mug(self) -> Item:
        """A mug with a handle."""
        r = 0.04
        h = self.rng.uniform(0.085, 0.11)
        body = lathe(
            [(0, 0), (0.8 * r, 0), (r, 0.012), (r, h), (r - 0.004, h), (r - 0.005, 0.01),
             (0, 0.008)], 24, 2,
        )  # fmt: skip
        t = np.linspace(-np.pi / 2, np.pi / 2, 9)
        x = r - 0.002 + 0.028 * np.cos(t)
        ear = tube(positions(x, 0.0, h / 2 + 0.03 * np.sin(t)), 0.006)
        return Item("mug", [(body, self.glaze()), (ear, self.glazes[0])])

    def bowl(self) -> Item:
        """A bowl with up to five fruits."""
        r = self.rng.uniform(0.09, 0.14)
        body = lathe(
            [(0, 0), (0.4 * r, 0), (0.45 * r, 0.008), (0.85 * r, 0.05), (r, 0.085),
             (r - 0.005, 0.086), (0.8 * r, 0.052), (0, 0.014)], 32, 3,
        )  # fmt: skip
        bowl = Item("bowl", [(body, self.glaze())])
        colour = FRUIT[str(self.rng.choice(tuple(FRUIT)))]
        fruit = m.stone(self.shop.name("fruit"), colour, self.rng)
        radius = 0.0  # the first one is in the middle
        for i in range(self.rng.integers(0, 6)):
            x = radius * np.cos(2.2 * i)
            y = radius * np.sin(2.2 * i)
            bowl.add(ball(0.037, 0.95, 16), fruit, x, y, 0.03 + 0.012 * i)
            radius = 0.045
        return bowl

    def plate(self) -> Item:
        """A pile of plates."""
        plate = lathe(
            [(0, 0), (0.07, 0), (0.08, 0.006), (0.12, 0.018), (0.12, 0.02), (0.08, 0.01),
             (0, 0.006)], 32, 2,
        )  # fmt: skip
        count = self.rng.integers(1, 6)
        pile = Mesh.merged([plate.shifted(0, 0, 0.009 * i) for i in range(count)])
        return Item("plates", [(pile, self.glaze())])

    def bottle(self) -> Item:
        """A glass bottle with a printed label."""
        r = self.rng.uniform(0.032, 0.042)
        h = self.rng.uniform(0.24, 0.32)
        body = lathe(
            [(0, 0), (0.9 * r, 0), (r, 0.01), (r, 0.55 * h), (0.85 * r, 0.65 * h),
             (0.36 * r, 0.78 * h), (0.34 * r, h), (0.4 * r, h), (0, h)], 24, 2,
        )  # fmt: skip
        glass = m.plain(self.shop.name("glass"), pick(self.rng, GLASS), "coated", 0.05)
        band = cylinder(r + 0.0006, 0.3 * h, 0.001).shifted(0, 0, 0.16 * h)
        return Item("bottle", [(body, glass), self._labelled(band)])

    def jar(self) -> Item:
        """A tin or jar with a lid and a label."""
        r = self.rng.uniform(0.035, 0.055)
        h = self.rng.uniform(0.09, 0.16)
        jar = Item("jar", [self._labelled(cylinder(r, h))])
        jar.add(cylinder(r * 0.98, 0.02, 0.005), self.shop.steel, 0, 0, h)
        return jar

    def vase(self) -> Item:
        """A vase of random profile with up to five flowers."""
        rng = self.rng
        h = rng.uniform(0.18, 0.34)
        foot, belly, neck, flare = rng.uniform(0.4, 1.0, 4) * 0.085
        rim = 0.2 * flare
        body = lathe(
            [(0, 0), (foot, 0), (belly + 0.02, 0.3 * h), (neck, 0.6 * h), (0.025, 0.85 * h),
             (0.03 + rim, h), (0.02 + rim, h), (0.018, 0.8 * h), (0, 0.7 * h)], 30, 4,
        )  # fmt: skip
        vase = Item("vase", [(body, self.glaze())])
        green = m.plain("stalk", (0.25, 0.38, 0.16))
        petal = m.plain(self.shop.name("petal"), pick(rng, CLOTHS))
        for _ in range(rng.integers(0, 6)):
            x, y = rng.uniform(-0.09, 0.09, 2)
            z = h + rng.uniform(0.08, 0.2)
            stalk = [(0, 0, 0.7 * h), (0.3 * x, 0.3 * y, h), (x, y, z)]
            vase.add(tube(stalk, 0.002, 5), green)
            vase.add(ball(0.02, 0.8, 10), petal, x, y, z - 0.01)
        return vase

    def books(self) -> Item:
        """A pile of books."""
        if self._spines is None:
            self._spines = prints.spines(self.shop.name("spines"), self.rng)
        z = 0.0
        pile = []
        for _ in range(self.rng.integers(2, 6)):
            thick = self.rng.uniform(0.018, 0.045)
            upright = self.shop.book(thick, 0.16, self.rng.uniform(0.19, 0.25))
            lying = upright.rotated(about_y(np.pi / 2), (0, 0, thick / 2))
            yaw = self.rng.normal(0, 0.15)
            pile.append(lying.shifted(-0.11, 0, z).placed((0, 0, 0), yaw))
            z += thick
        return Item("books", [(Mesh.merged(pile), self._spines)])

    def carton(self) -> Item:
        """A box of groceries."""
        size = self.rng.uniform((0.06, 0.05, 0.12), (0.18, 0.11, 0.24))
        return Item("carton", [self._labelled(box(*size, bevel_m=0.003, steps=1))])

    def plant(self) -> Item:
        """Leaves in a pot."""
        rng = self.rng
        scale = rng.uniform(0.7, 1.3)
        pot = lathe(
            [(0, 0), (0.06, 0), (0.085, 0.12), (0.09, 0.14), (0.08, 0.14), (0.075, 0.12),
             (0, 0.12)], 28, 2,
        )  # fmt: skip
        green = m.stone(self.shop.name("leaf"), pick(rng, LEAVES), rng)
        leaves = []
        for i in range(rng.integers(9, 20)):
            shape = rng.uniform((0.16, 0.04, 0.8), (0.34, 0.08, 2.2)).tolist()
            blade = leaf(*shape).rotated(about_y(rng.uniform(-0.7, 0.2)))
            leaves.append(blade.placed((0, 0, 0.12), 2.4 * i + rng.normal(0, 0.2)))
        plant = Item("plant", [(pot, self.glaze()), (Mesh.merged(leaves), green)])
        return plant.scaled(scale)

    def lamp(self) -> Item:
        """A table lamp that is on."""
        foot = lathe(
            [(0, 0), (0.07, 0), (0.07, 0.012), (0.02, 0.03), (0.045, 0.1), (0.03, 0.17),
             (0.01, 0.2), (0.01, 0.26), (0, 0.26)], 28, 3,
        )  # fmt: skip
        shade = lathe(lampshade((0.12, 0.23), (0.105, 0.32), (0.075, 0.41)), 28, 1)
        return Item("lamp", [(foot, self.glaze()), (shade, m.GLOW)])

    def pot(self) -> Item:
        """A cooking pot with a lid and two handles."""
        dark = self.shop.dark
        r = self.rng.uniform(0.09, 0.12)
        h = self.rng.uniform(0.1, 0.16)
        body = lathe(
            [(0, 0), (r - 0.01, 0), (r, 0.012), (r, h), (r + 0.004, h + 0.004),
             (r * 0.6, h + 0.02), (0, h + 0.026)], 32, 2,
        )  # fmt: skip
        pot = Item("pot", [(body, self.shop.steel)])
        pot.add(ball(0.016), dark, 0, 0, h + 0.024)
        t = np.linspace(-np.pi / 2, np.pi / 2, 7)
        for sign in (1, -1):
            x = sign * (r + 0.03 * np.cos(t))
            ear = positions(x, 0.035 * np.sin(t), 0.8 * h)
            pot.add(tube(ear, 0.006), dark)
        return pot

    def kettle(self) -> Item:
        """A round kettle with a spout and an arched handle."""
        body = lathe(
            [(0, 0), (0.085, 0), (0.095, 0.02), (0.09, 0.09), (0.06, 0.14), (0.035, 0.155),
             (0.012, 0.165), (0.015, 0.18), (0, 0.185)], 32, 3,
        )  # fmt: skip
        spout = tube([(0.07, 0, 0.07), (0.11, 0, 0.1), (0.14, 0, 0.15)], 0.014)
        t = np.linspace(0.25, np.pi - 0.25, 10)
        arch = positions(0.085 * np.cos(t), 0.0, 0.12 + 0.11 * np.sin(t))
        kettle = Item("kettle", [(body, self.glaze()), (spout, self.shop.steel)])
        kettle.add(tube(arch, 0.009), self.shop.dark)
        return kettle

    def toy_ball(self) -> Item:
        """A patterned ball."""
        cloth = m.fabric(self.shop.name("ball"), pick(self.rng, CLOTHS), self.rng)
        sphere = ball(self.rng.uniform(0.05, 0.11), segments=32)
        return Item("ball", [(sphere, cloth)])

    def blocks(self) -> Item:
        """A tower of three toy blocks."""
        tower = Item("blocks")
        z = 0.0
        for side in (0.05, 0.045, 0.04):
            block = box(side, side, side, 0.006)
            block = block.placed((0, 0, z), self.rng.uniform(0, 1.5))
            tower.add(block, self.glaze())
            z += side
        return tower

    def chessboard(self, square_m: float) -> Item:
        """A printed board of 9 x 7 squares with a margin of one square, lying on its back."""
        w = 11 * square_m
        d = 9 * square_m
        print_ = sheet((-w / 2, -d / 2, 0.005), (w, 0, 0), (0, d, 0))
        board = box(w + 0.004, d + 0.004, 0.0048, 0.001)
        parts = [
            (board, self.shop.white),
            (print_, prints.chessboard("chessboard", 9, 7)),
        ]
        return Item("chessboard", parts)

    def basket(self) -> Item:
        """A woven basket with cloth in it."""
        body = lathe(
            [(0, 0), (0.13, 0), (0.17, 0.1), (0.18, 0.22), (0.185, 0.23), (0.17, 0.22),
             (0.15, 0.1), (0, 0.08)], 32, 2,
        )  # fmt: skip
        cane = m.fabric(self.shop.name("cane"), (0.66, 0.5, 0.31), self.rng)
        basket = Item("basket", [(body, cane)])
        basket.add(cushion(0.26, 0.26, 0.16), self.shop.cloths[1], 0, 0, 0.12)
        return basket

    def radio(self) -> Item:
        """A small radio: bevelled case, grille, two knobs."""
        radio = Item("radio", [(box(0.24, 0.1, 0.14, 0.02, steps=4), self.shop.wood())])
        cloth = m.fabric(self.shop.name("grille"), (0.3, 0.28, 0.25), self.rng)
        radio.add(box(0.13, 0.012, 0.1, 0.004), cloth, -0.035, -0.05, 0.02)
        knob = cylinder(0.018, 0.02).rotated(FORWARD)
        for z in (0.045, 0.095):
            radio.add(knob, self.shop.steel, 0.08, -0.046, z)
        return radio

    def _labelled(self, mesh: Mesh) -> tuple[Mesh, Material]:
        """The mesh with a printed label that covers its height and repeats around it."""
        height = np.ptp(mesh.vertices_m[:, 2])
        colour = pick(self.rng, (*CLOTHS, *PAINTS))
        material = prints.label(self.shop.name("label"), colour, self.rng)
        return replace(mesh, uv=(mesh.uv - mesh.uv.min(0)) / height), material
