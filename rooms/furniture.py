"""Furniture. Each item is centred at x = 0, with its back at y = 0 and its front towards -y."""

from dataclasses import replace

import numpy as np
from numpy.random import Generator

from rooms import materials as m, prints
from rooms.items import Item
from rooms.materials import Colour, Material
from rooms.shapes import (
    FORWARD,
    Mesh,
    about_x,
    ball,
    box,
    cushion,
    cylinder,
    lampshade,
    lathe,
    mirrored,
    positions,
    sheet,
    tube,
)

WOODS: tuple[Colour, ...] = (
    (0.62, 0.43, 0.27), (0.45, 0.29, 0.18), (0.76, 0.60, 0.42), (0.33, 0.21, 0.15),
    (0.70, 0.52, 0.33),
)  # fmt: skip
"""Colours of furniture of wood."""
PAINTS: tuple[Colour, ...] = (
    (0.87, 0.86, 0.82), (0.30, 0.40, 0.42), (0.55, 0.62, 0.55), (0.80, 0.74, 0.62),
    (0.24, 0.28, 0.38), (0.72, 0.38, 0.30),
)  # fmt: skip
"""Colours of painted furniture."""
CLOTHS: tuple[Colour, ...] = (
    (0.62, 0.22, 0.20), (0.24, 0.34, 0.50), (0.78, 0.72, 0.60), (0.36, 0.46, 0.34),
    (0.55, 0.52, 0.50), (0.80, 0.58, 0.24), (0.46, 0.34, 0.48),
)  # fmt: skip
"""Colours of covers, curtains and quilts."""
HOB_RINGS = (
    (0.09, -0.13, 0.1),
    (0.075, 0.13, 0.1),
    (0.075, -0.13, -0.11),
    (0.1, 0.13, -0.11),
)
"""Radius, x and y of the rings of a hob, metres."""


def pick(rng: Generator, colours: tuple[Colour, ...]) -> Colour:
    """One of the colours with a small random variation."""
    colour = np.array(colours[rng.integers(len(colours))]) * rng.uniform(0.9, 1.1)
    return tuple(np.clip(colour + rng.uniform(-0.03, 0.03, 3), 0.02, 0.95).tolist())


class FurnitureBuilder:
    """Makes furniture from materials that all items of a room share."""

    def __init__(self, rng: Generator):
        self.rng = rng
        self._count = 0
        self.woods = [m.wood(f"wood{i}", pick(rng, WOODS), rng) for i in range(2)]
        self.paint = m.lacquer("paint", pick(rng, PAINTS), rng)
        self.cloths = [m.fabric(f"cloth{i}", pick(rng, CLOTHS), rng) for i in range(3)]
        self.linen = m.fabric("linen", (0.83, 0.81, 0.77), rng)
        self.steel = m.brushed("steel", (0.78, 0.78, 0.77), rng)
        grey_or_beige = ((0.3, 0.3, 0.31), (0.66, 0.63, 0.58))
        self.stone = m.stone("stone", pick(rng, grey_or_beige), rng)
        self.dark = m.plain("dark", (0.06, 0.06, 0.065), "coated", 0.15)
        self.white = m.plain("white", (0.86, 0.86, 0.84), "coated", 0.12)

    def name(self, what: str) -> str:
        """A unique material name."""
        self._count += 1
        return f"{what}{self._count}"

    def wood(self) -> Material:
        """One of the room's woods."""
        return self.woods[self.rng.integers(len(self.woods))]

    def bed(self) -> Item:
        """A bed with a head board, mattress, quilt and pillows."""
        wood = self.wood()
        d = 2.05
        bed = Item("bed")
        bed.add(box(1.5, d, 0.22, 0.02), wood, 0, -1.025, 0.1)
        bed.add(box(1.6, 0.07, 1.0, 0.03, steps=3), wood, 0, -0.04, 0)
        bed.add(box(1.44, d - 0.12, 0.22, 0.07, steps=4), self.linen, 0, -1.045, 0.3)
        bed.add(box(1.54, 1.3, 0.14, 0.06, steps=4), self.cloths[0], 0, -1.42, 0.42)
        pillow = cushion(0.62, 0.42, 0.17).rotated(about_x(0.35))
        for x in mirrored(0.36):
            bed.add(pillow, self.cloths[1], x, -0.36, 0.52)
        small = cushion(0.4, 0.4, 0.16).rotated(about_x(0.9))
        bed.add(small, self.cloths[2], 0.05, -0.55, 0.62)
        return bed

    def wardrobe(self) -> Item:
        """A wardrobe with three doors and handles."""
        w = 1.5
        d = 0.6
        h = 2.05
        wood = self.wood()
        wardrobe = Item("wardrobe")
        wardrobe.add(box(w, d - 0.02, h, 0.012), wood, 0, -d / 2 + 0.01, 0)
        door = box(w / 3 - 0.012, 0.022, h - 0.12, 0.008)
        front = -d - 0.03
        for x in (-w / 3, 0.0, w / 3):
            wardrobe.add(door, wood, x, -d, 0.06)
            side = x + 0.17
            bar = [(side, front, 0.95), (side, -d - 0.045, 1.05), (side, front, 1.15)]
            wardrobe.add(tube(bar, 0.009), self.steel)
        wardrobe.add_top(0.65, 0.5, 0.1, h)
        return wardrobe

    def drawers(self) -> Item:
        """A chest of drawers with round knobs."""
        w = 0.5 + 0.5 * self.rng.random()
        d = 0.45
        h = self.rng.uniform(0.5, 0.9)
        body = self.paint
        if self.rng.random() < 0.5:
            body = self.wood()
        drawers = Item("drawers")
        drawers.add(box(w, d, h, 0.012), body, 0, -d / 2, 0)
        rows = max(2, round(h / 0.22))
        front = box(w - 0.05, 0.024, (h - 0.12) / rows, 0.008)
        knob = ball(0.016).rotated(FORWARD)
        for i in range(rows):
            z = 0.05 + i * (h - 0.08) / rows
            drawers.add(front, self.paint, 0, -d, z)
            for x in mirrored(w / 4):
                drawers.add(knob, self.steel, x, -d - 0.005, z + 0.5 * h / rows)
        drawers.add_top(w / 2 - 0.05, d - 0.06, 0.06, h)
        return drawers

    def sofa(self) -> Item:
        """A sofa with cushions and pillows."""
        w = 1.9
        d = 0.88
        cloth = self.cloths[0]
        sofa = Item("sofa")
        sofa.add(box(w, d, 0.3, 0.03), cloth, 0, -d / 2, 0.08)
        for x in mirrored(w / 2 - 0.1):
            sofa.add(box(0.2, d, 0.58, 0.08, steps=5), cloth, x, -d / 2, 0.06)
        sofa.add(box(w, 0.22, 0.82, 0.09, steps=5), cloth, 0, -0.11, 0.06)
        back = box(0.72, 0.17, 0.42, 0.07, steps=4).rotated(about_x(0.2))
        for x in mirrored(0.38):
            sofa.add(box(0.74, 0.64, 0.17, 0.06, steps=4), cloth, x, -0.53, 0.36)
            sofa.add(back, cloth, x, -0.24, 0.48)
        pillow = cushion(0.42, 0.42, 0.17).rotated(about_x(1.15))
        for x, number in ((-0.6, 1), (0.2, 2), (0.62, 1)):
            sofa.add(pillow, self.cloths[number], x, -0.42, 0.74)
        return sofa

    def armchair(self) -> Item:
        """An armchair of rounded boxes."""
        cloth = self.cloths[2]
        chair = Item("armchair")
        chair.add(box(0.74, 0.7, 0.3, 0.1, steps=5), cloth, 0, -0.37, 0.14)
        chair.add(box(0.74, 0.18, 0.8, 0.085, steps=5), cloth, 0, -0.1, 0.14)
        chair.add(box(0.5, 0.52, 0.16, 0.06, steps=4), self.cloths[1], 0, -0.42, 0.4)
        for x in mirrored(0.3):
            chair.add(box(0.16, 0.7, 0.5, 0.075, steps=5), cloth, x, -0.37, 0.14)
            for y in (-0.1, -0.64):
                chair.add(cylinder(0.02, 0.15), self.wood(), x, y, 0)
        return chair

    def chair(self) -> Item:
        """A chair with four round legs and a curved back."""
        wood = self.wood()
        chair = Item("chair")
        chair.add(box(0.43, 0.42, 0.035, 0.014, steps=3), wood, 0, -0.25, 0.44)
        leg = lathe(
            [(0, 0), (0.012, 0), (0.02, 0.2), (0.017, 0.3), (0.021, 0.44), (0, 0.44)], 12
        )  # fmt: skip
        for x in mirrored(0.17):
            for y in (-0.08, -0.42):
                chair.add(leg, wood, x, y, 0)
            post = [(x, -0.07, 0.46), (x * 1.03, -0.05, 0.65), (x * 1.05, 0.0, 0.9)]
            chair.add(tube(post, 0.014), wood)
        t = np.linspace(-1, 1, 9)
        for z in (0.62, 0.74, 0.86):
            bent = positions(0.18 * t, -0.05 + 0.05 * (1 - t * t) + 0.03, z)
            chair.add(tube(bent, 0.016), wood)
        return chair

    def table(self, w: float = 1.2, d: float = 0.75, h: float = 0.74) -> Item:
        """A table with rounded edges and tapered legs."""
        wood = self.wood()
        table = Item("table")
        table.add(box(w, d, 0.035, 0.015, steps=3), wood, 0, -d / 2, h - 0.035)
        table.add(box(w - 0.14, d - 0.14, 0.08, 0.004), wood, 0, -d / 2, h - 0.115)
        top = h - 0.03
        profile = [(0, 0), (0.016, 0), (0.03, h - 0.12), (0.03, top), (0, top)]
        for x in mirrored(w / 2 - 0.07):
            for y in (-0.07, -d + 0.07):
                table.add(lathe(profile, 14, 1), wood, x, y, 0)
        table.add_top(w / 2 - 0.06, d - 0.06, 0.06, h)
        return table

    def round_table(self) -> Item:
        """A round side table on one foot."""
        r = self.rng.uniform(0.28, 0.42)
        h = self.rng.uniform(0.42, 0.58)
        foot = lathe(
            [(0, 0), (0.2, 0), (0.2, 0.015), (0.05, 0.05), (0.03, 0.2), (0.045, h - 0.1),
             (0.09, h - 0.03), (0, h - 0.03)], 28,
        )  # fmt: skip
        wood = self.wood()
        table = Item("side table")
        table.add(cylinder(r, 0.03, 0.012, 40), wood, 0, -r, h - 0.03)
        table.add(foot, wood, 0, -r, 0)
        k = 0.6 * r
        table.add_top(k, r + k, r - k, h)
        return table

    def bookcase(self) -> Item:
        """A bookcase full of books with titles."""
        w = self.rng.uniform(0.8, 1.2)
        d = 0.3
        h = 1.9
        wood = self.wood()
        case = Item("bookcase")
        case.add(box(w, 0.012, h, 0.002), wood, 0, -0.006, 0)
        for x in mirrored(w / 2 - 0.0125):
            case.add(box(0.025, d, h, 0.005), wood, x, -d / 2, 0)
        spines = prints.spines(self.name("spines"), self.rng)
        rows = 5
        gap = (h - 0.03) / rows
        for i in range(rows + 1):
            case.add(box(w - 0.05, d - 0.01, 0.022, 0.004), wood, 0, -d / 2, i * gap)
        x0, x1 = mirrored(w / 2 - 0.04)
        for i in range(rows):
            z = i * gap + 0.022
            end = x1 - self.rng.uniform(0.0, 0.45) * (x1 - x0)
            books = []
            x = x0
            while x < end:
                thick = self.rng.uniform(0.018, 0.05)
                book = self.book(thick, 0.19, self.rng.uniform(0.18, 0.3))
                books.append(book.shifted(x + thick / 2, -0.15, z))
                x += thick + 0.001
            case.add(Mesh.merged(books), spines)
            if x1 - x > 0.14:
                case.tops.append((x + 0.02, x1, -0.25, -0.05, z))
        return case

    def rack(self) -> Item:
        """An open steel rack with four boards."""
        w = 1.1
        d = 0.4
        rack = Item("rack")
        for x in mirrored(w / 2 - 0.02):
            for y in (-0.02, -d + 0.02):
                rack.add(box(0.03, 0.03, 1.8, 0.004), self.steel, x, y, 0)
        for z in (0.12, 0.55, 0.98, 1.41):
            rack.add(box(w, d, 0.025, 0.005), self.woods[0], 0, -d / 2, z)
            rack.add_top(w / 2 - 0.05, d - 0.06, 0.06, z + 0.025)
        return rack

    def book(self, thick: float, deep: float, tall: float) -> Mesh:
        """An upright book with its spine towards -y and a random cell of the `spines` texture."""
        mesh = box(thick, deep, tall, 0.003, steps=1)
        cell = self.rng.integers(prints.BOOKS)
        spine = mesh.normals[:, 1] < -0.5
        x, _, z = mesh.vertices_m.T
        # Covers have the colour of the untitled edge of their spine.
        u = np.where(spine, 0.5 + 0.9 * x / thick, 0.06)
        v = np.where(spine, 0.02 + 0.96 * z / tall, 0.97)
        return replace(mesh, uv=positions((cell + u) / prints.BOOKS, v))

    def counter(self, w: float = 2.4) -> Item:
        """Kitchen base units with a worktop, a sink with a tap, a hob and an oven."""
        d = 0.62
        h = 0.9
        steel = self.steel
        counter = Item("counter")
        counter.add(box(w, d - 0.08, 0.1, 0.003), self.woods[1], 0, -d / 2 + 0.04, 0)
        body = box(w, d - 0.04, h - 0.14, 0.004)
        counter.add(body, self.paint, 0, -d / 2 + 0.02, 0.1)
        worktop = box(w, d + 0.02, 0.04, 0.012, steps=3)
        counter.add(worktop, self.stone, 0, -d / 2 - 0.01, h - 0.04)
        units = round(w / 0.6)
        width = w / units
        for i in range(units - 1):
            x = -w / 2 + (i + 0.5) * w / units
            door = box(width - 0.012, 0.022, h - 0.17, 0.007)
            counter.add(door, self.paint, x, -d + 0.03, 0.11)
            counter.add(_handle(x, 0.1, -d - 0.01, 0.75, 0.007), steel)
        oven = -w / 2 + (units - 0.5) * w / units
        counter.add(box(0.56, 0.03, 0.6, 0.01), self.dark, oven, -d + 0.02, 0.14)
        counter.add(_handle(oven, 0.22, -d - 0.03, 0.66, 0.01), steel)
        knob = cylinder(0.018, 0.025).rotated(FORWARD)
        offsets = (-0.2, -0.1, 0.1, 0.2)
        knobs = [knob.shifted(oven + x, -d + 0.01, 0.8) for x in offsets]
        counter.add(Mesh.merged(knobs), steel)
        sink = -w / 2 + 0.7
        counter.add(box(0.56, 0.42, 0.012, 0.005), steel, sink, -d / 2, h)
        counter.add(box(0.46, 0.32, 0.01, 0.004), self.dark, sink, -d / 2, h + 0.005)
        t = np.linspace(0, np.pi, 12)
        y = -0.17 - 0.08 * (1 - np.cos(t))
        arc = positions(sink, y, h + 0.24 + 0.09 * np.sin(t))
        pipe = [(sink, -0.17, h), (sink, -0.17, h + 0.12), *arc]
        counter.add(tube(pipe, 0.013), steel)
        hob = w / 2 - 0.32
        counter.add(box(0.56, 0.48, 0.008, 0.003), self.dark, hob, -d / 2, h)
        rings = [
            cylinder(r, 0.006, 0.002, 32).shifted(hob + x, -d / 2 + y, h + 0.005)
            for r, x, y in HOB_RINGS
        ]
        counter.add(Mesh.merged(rings), steel)
        counter.tops = [
            (sink + 0.32, hob - 0.32, -d + 0.08, -0.06, h),
            (hob - 0.2, hob + 0.2, -0.3, -0.15, h + 0.012),
        ]
        return counter

    def fridge(self) -> Item:
        """A fridge with two rounded doors and notes on them."""
        paint = m.lacquer(self.name("fridge"), pick(self.rng, PAINTS), self.rng)
        fridge = Item("fridge")
        fridge.add(box(0.62, 0.6, 1.8, 0.02), paint, 0, -0.3, 0)
        for z, h in ((0.05, 1.1), (1.17, 0.6)):
            fridge.add(box(0.61, 0.06, h, 0.028, steps=4), paint, 0, -0.62, z)
            heights = (z + 0.1, z + h / 2, z + h - 0.1)
            bar = positions(-0.25, (-0.67, -0.69, -0.67), heights)
            fridge.add(tube(bar, 0.012), self.steel)
        for _ in range(4):
            x = self.rng.uniform(-0.15, 0.2)
            z = self.rng.uniform(0.7, 1.55)
            note = sheet((x, -0.652, z), (0.1, 0, 0), (0, 0, 0.13))
            paper = prints.label(self.name("note"), pick(self.rng, CLOTHS), self.rng)
            fridge.add(note, paper)
        fridge.add_top(0.25, 0.5, 0.1, 1.8)
        return fridge

    def floor_lamp(self) -> Item:
        """A floor lamp that is on."""
        foot = lathe(
            [(0, 0), (0.15, 0), (0.15, 0.015), (0.02, 0.035), (0.012, 0.1), (0.012, 1.4),
             (0, 1.4)], 24, 2,
        )  # fmt: skip
        shade = lathe(lampshade((0.19, 1.3), (0.17, 1.45), (0.13, 1.62)), 28, 1)
        lamp = Item("floor lamp")
        lamp.add(foot, self.dark, 0, -0.2, 0)
        lamp.add(shade, m.GLOW, 0, -0.2, 0)
        return lamp


def _handle(x: float, half_width: float, y: float, z: float, radius: float) -> Mesh:
    """A horizontal bar that bends 1 cm outwards in the middle."""
    across = (x - half_width, x, x + half_width)
    return tube(positions(across, (y, y - 0.01, y), z), radius)
