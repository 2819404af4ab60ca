"""Furniture. Each item is centred at x = 0, with its back at y = 0 and its front towards -y."""

from dataclasses import dataclass, field

import numpy as np
from numpy.random import Generator

from rooms import materials as m
from rooms.shapes import (
    Mesh,
    about_x,
    ball,
    box,
    cushion,
    cylinder,
    lampshade,
    lathe,
    sheet,
    tube,
)

Colour = tuple[float, float, float]

WOODS: tuple[Colour, ...] = (
    (0.62, 0.43, 0.27), (0.45, 0.29, 0.18), (0.76, 0.60, 0.42), (0.33, 0.21, 0.15),
    (0.70, 0.52, 0.33),
)  # fmt: skip
PAINTS: tuple[Colour, ...] = (
    (0.87, 0.86, 0.82), (0.30, 0.40, 0.42), (0.55, 0.62, 0.55), (0.80, 0.74, 0.62),
    (0.24, 0.28, 0.38), (0.72, 0.38, 0.30),
)  # fmt: skip
CLOTHS: tuple[Colour, ...] = (
    (0.62, 0.22, 0.20), (0.24, 0.34, 0.50), (0.78, 0.72, 0.60), (0.36, 0.46, 0.34),
    (0.55, 0.52, 0.50), (0.80, 0.58, 0.24), (0.46, 0.34, 0.48),
)  # fmt: skip
HOB_RINGS = (
    (0.09, -0.13, 0.1),
    (0.075, 0.13, 0.1),
    (0.075, -0.13, -0.11),
    (0.1, 0.13, -0.11),
)
"""Radius, x and y of the rings of a hob, metres."""


@dataclass(eq=False)
class Item:
    """An object in a room."""

    kind: str
    """Name of the kind of object."""
    parts: list[tuple[Mesh, m.Material]]
    """Meshes in the frame of the item, metres."""
    tops: list[tuple[float, float, float, float, float]] = field(default_factory=list)
    """Surfaces for small objects: x_min, x_max, y_min, y_max, z; metres, frame of the item."""
    curved: bool = True
    """Whether it is round or has visible bevelled edges."""

    def bounds_m(self) -> np.ndarray:
        """Lowest and highest corner, shape (2, 3)."""
        points = np.concatenate([mesh.vertices_m for mesh, _ in self.parts])
        return np.stack([points.min(0), points.max(0)])

    def placed(self, x: float, y: float, z: float, yaw_rad: float = 0.0) -> "Item":
        """The item rotated about z, then shifted. Tops are exact for multiples of 90 deg only."""
        parts = [
            (mesh.placed((x, y, z), yaw_rad), material) for mesh, material in self.parts
        ]
        c = np.cos(yaw_rad)
        s = np.sin(yaw_rad)
        tops = []
        for x0, x1, y0, y1, top in self.tops:
            corners = np.array([[x0, y0], [x1, y1]]) @ np.array([[c, s], [-s, c]]) + (
                x,
                y,
            )
            (a, b), (d, e) = corners.min(0), corners.max(0)
            tops.append((float(a), float(d), float(b), float(e), top + z))
        return Item(self.kind, parts, tops, self.curved)


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
        self.stone = m.stone(
            "stone", pick(rng, ((0.3, 0.3, 0.31), (0.66, 0.63, 0.58))), rng
        )
        self.dark = m.plain("dark", (0.06, 0.06, 0.065), "coated", 0.15)
        self.white = m.plain("white", (0.86, 0.86, 0.84), "coated", 0.12)

    def name(self, what: str) -> str:
        """A unique material name."""
        self._count += 1
        return f"{what}{self._count}"

    def wood(self) -> m.Material:
        """One of the room's woods."""
        return self.woods[self.rng.integers(len(self.woods))]

    def cloth(self) -> m.Material:
        """One of the room's fabrics."""
        return self.cloths[self.rng.integers(len(self.cloths))]

    def bed(self) -> Item:
        """A bed with a head board, mattress, quilt and pillows."""
        w = 1.5
        d = 2.05
        wood = self.wood()
        mattress = box(w - 0.06, d - 0.12, 0.22, 0.07, steps=4).shifted(
            0, -d / 2 - 0.02, 0.3
        )
        parts = [
            (box(w, d, 0.22, 0.02).shifted(0, -d / 2, 0.1), wood),
            (box(w + 0.1, 0.07, 1.0, 0.03, steps=3).shifted(0, -0.04, 0), wood),
            (mattress, self.linen),
            (
                box(w + 0.04, 1.3, 0.14, 0.06, steps=4).shifted(0, -1.42, 0.42),
                self.cloths[0],
            ),
        ]
        for size, angle, at, cloth in (
            ((0.62, 0.42, 0.17), 0.35, (-0.36, -0.36, 0.52), 1),
            ((0.62, 0.42, 0.17), 0.35, (0.36, -0.36, 0.52), 1),
            ((0.4, 0.4, 0.16), 0.9, (0.05, -0.55, 0.62), 2),
        ):
            parts.append(
                (cushion(*size).rotated(about_x(angle), at), self.cloths[cloth])
            )
        return Item("bed", parts)

    def wardrobe(self) -> Item:
        """A wardrobe with three doors and handles."""
        w = 1.5
        d = 0.6
        h = 2.05
        paint = self.wood()
        parts = [(box(w, d - 0.02, h, 0.012).shifted(0, -d / 2 + 0.01, 0), paint)]
        for i in range(3):
            x = (i - 1) * w / 3
            parts.append(
                (box(w / 3 - 0.012, 0.022, h - 0.12, 0.008).shifted(x, -d, 0.06), paint)
            )
            side = x + 0.17
            front = -d - 0.03
            bar = [(side, front, 0.95), (side, -d - 0.045, 1.05), (side, front, 1.15)]
            parts.append((tube(bar, 0.009), self.steel))
        return Item("wardrobe", parts, [(-0.65, 0.65, -0.5, -0.1, h)])

    def drawers(self) -> Item:
        """A chest of drawers with round knobs."""
        w = 0.5 + 0.5 * self.rng.random()
        d = 0.45
        h = self.rng.uniform(0.5, 0.9)
        body, front = (
            (self.wood(), self.paint) if self.rng.random() < 0.5 else (self.paint,) * 2
        )
        parts = [(box(w, d, h, 0.012).shifted(0, -d / 2, 0), body)]
        rows = max(2, round(h / 0.22))
        for i in range(rows):
            z = 0.05 + i * (h - 0.08) / rows
            parts.append(
                (
                    box(w - 0.05, 0.024, (h - 0.12) / rows, 0.008).shifted(0, -d, z),
                    front,
                )
            )
            for x in (-w / 4, w / 4):
                knob = ball(0.016).rotated(
                    about_x(np.pi / 2), (x, -d - 0.005, z + 0.5 * h / rows)
                )
                parts.append((knob, self.steel))
        return Item(
            "drawers", parts, [(-w / 2 + 0.05, w / 2 - 0.05, -d + 0.06, -0.06, h)]
        )

    def sofa(self) -> Item:
        """A sofa with cushions and pillows."""
        w = 1.9
        d = 0.88
        cloth = self.cloths[0]
        parts = [(box(w, d, 0.3, 0.03).shifted(0, -d / 2, 0.08), cloth)]
        for x in (-w / 2 + 0.1, w / 2 - 0.1):
            parts.append(
                (box(0.2, d, 0.58, 0.08, steps=5).shifted(x, -d / 2, 0.06), cloth)
            )
        parts.append((box(w, 0.22, 0.82, 0.09, steps=5).shifted(0, -0.11, 0.06), cloth))
        for x in (-0.38, 0.38):
            seat = box(0.74, 0.64, 0.17, 0.06, steps=4).shifted(x, -0.53, 0.36)
            back = box(0.72, 0.17, 0.42, 0.07, steps=4).rotated(
                about_x(0.2), (x, -0.24, 0.48)
            )
            parts += [(seat, cloth), (back, cloth)]
        for i, x in enumerate((-0.6, 0.2, 0.62)):
            pillow = cushion(0.42, 0.42, 0.17).rotated(about_x(1.15), (x, -0.42, 0.74))
            parts.append((pillow, self.cloths[1 + i % 2]))
        return Item("sofa", parts)

    def armchair(self) -> Item:
        """An armchair of rounded boxes."""
        cloth = self.cloths[2]
        parts = [
            (box(0.74, 0.7, 0.3, 0.1, steps=5).shifted(0, -0.37, 0.14), cloth),
            (box(0.74, 0.18, 0.8, 0.085, steps=5).shifted(0, -0.1, 0.14), cloth),
            (
                box(0.5, 0.52, 0.16, 0.06, steps=4).shifted(0, -0.42, 0.4),
                self.cloths[1],
            ),
        ]
        for x in (-0.3, 0.3):
            parts.append(
                (box(0.16, 0.7, 0.5, 0.075, steps=5).shifted(x, -0.37, 0.14), cloth)
            )
            parts += [
                (cylinder(0.02, 0.15).shifted(x, y, 0), self.wood())
                for y in (-0.1, -0.64)
            ]
        return Item("armchair", parts)

    def chair(self) -> Item:
        """A chair with four round legs and a curved back."""
        wood = self.wood()
        parts = [(box(0.43, 0.42, 0.035, 0.014, steps=3).shifted(0, -0.25, 0.44), wood)]
        for x in (-0.17, 0.17):
            for y in (-0.08, -0.42):
                leg = [
                    (0, 0),
                    (0.012, 0),
                    (0.02, 0.2),
                    (0.017, 0.3),
                    (0.021, 0.44),
                    (0, 0.44),
                ]
                parts.append((lathe(leg, 12).shifted(x, y, 0), wood))
            post = [(x, -0.07, 0.46), (x * 1.03, -0.05, 0.65), (x * 1.05, 0.0, 0.9)]
            parts.append((tube(post, 0.014), wood))
        t = np.linspace(-1, 1, 9)
        for z in (0.62, 0.74, 0.86):
            bent = np.stack(
                [0.18 * t, -0.05 + 0.05 * (1 - t * t) + 0.03, np.full(9, z)], -1
            )
            parts.append((tube(bent, 0.016), wood))
        return Item("chair", parts)

    def table(self, w: float = 1.2, d: float = 0.75, h: float = 0.74) -> Item:
        """A table with rounded edges and tapered legs."""
        wood = self.wood()
        parts = [
            (box(w, d, 0.035, 0.015, steps=3).shifted(0, -d / 2, h - 0.035), wood),
            (box(w - 0.14, d - 0.14, 0.08, 0.004).shifted(0, -d / 2, h - 0.115), wood),
        ]
        for x in (-w / 2 + 0.07, w / 2 - 0.07):
            for y in (-0.07, -d + 0.07):
                leg = [
                    (0, 0),
                    (0.016, 0),
                    (0.03, h - 0.12),
                    (0.03, h - 0.03),
                    (0, h - 0.03),
                ]
                parts.append((lathe(leg, 14, 1).shifted(x, y, 0), wood))
        return Item(
            "table", parts, [(-w / 2 + 0.06, w / 2 - 0.06, -d + 0.06, -0.06, h)]
        )

    def round_table(self) -> Item:
        """A round side table on one foot."""
        r = self.rng.uniform(0.28, 0.42)
        h = self.rng.uniform(0.42, 0.58)
        top = cylinder(r, 0.03, 0.012, 40).shifted(0, -r, h - 0.03)
        foot = lathe(
            [(0, 0), (0.2, 0), (0.2, 0.015), (0.05, 0.05), (0.03, 0.2), (0.045, h - 0.1),
             (0.09, h - 0.03), (0, h - 0.03)], 28,
        ).shifted(0, -r, 0)  # fmt: skip
        wood = self.wood()
        k = 0.6 * r
        return Item(
            "side table", [(top, wood), (foot, wood)], [(-k, k, -r - k, -r + k, h)]
        )

    def bookcase(self) -> Item:
        """A bookcase full of books with titles."""
        w = self.rng.uniform(0.8, 1.2)
        d = 0.3
        h = 1.9
        wood = self.wood()
        parts = [(box(w, 0.012, h, 0.002).shifted(0, -0.006, 0), wood)]
        for x in (-w / 2 + 0.0125, w / 2 - 0.0125):
            parts.append((box(0.025, d, h, 0.005).shifted(x, -d / 2, 0), wood))
        spines = m.spines(self.name("spines"), self.rng)
        tops = []
        rows = 5
        gap = (h - 0.03) / rows
        for i in range(rows + 1):
            parts.append(
                (
                    box(w - 0.05, d - 0.01, 0.022, 0.004).shifted(0, -d / 2, i * gap),
                    wood,
                )
            )
        for i in range(rows):
            x0 = -w / 2 + 0.04
            x1 = w / 2 - 0.04
            end = x1 - self.rng.uniform(0.0, 0.45) * (x1 - x0)
            books = []
            x = x0
            while x < end:
                thick = self.rng.uniform(0.018, 0.05)
                book = self.book(thick, 0.19, self.rng.uniform(0.18, 0.3))
                books.append(book.shifted(x + thick / 2, -0.15, i * gap + 0.022))
                x += thick + 0.001
            if books:
                parts.append((Mesh.merged(books), spines))
            if x1 - x > 0.14:
                tops.append((x + 0.02, x1, -0.25, -0.05, i * gap + 0.022))
        return Item("bookcase", parts, tops)

    def rack(self) -> Item:
        """An open steel rack with four boards."""
        w = 1.1
        d = 0.4
        h = 1.8
        tops = []
        parts = [
            (box(0.03, 0.03, h, 0.004).shifted(x, y, 0), self.steel)
            for x in (-w / 2 + 0.02, w / 2 - 0.02)
            for y in (-0.02, -d + 0.02)
        ]
        for z in (0.12, 0.55, 0.98, 1.41):
            parts.append((box(w, d, 0.025, 0.005).shifted(0, -d / 2, z), self.woods[0]))
            tops.append((-w / 2 + 0.05, w / 2 - 0.05, -d + 0.06, -0.06, z + 0.025))
        return Item("rack", parts, tops)

    def book(self, thick: float, deep: float, tall: float) -> Mesh:
        """An upright book with its spine towards -y and a random cell of the `spines` texture."""
        mesh = box(thick, deep, tall, 0.003, steps=1)
        cell = self.rng.integers(m.BOOKS)
        spine = mesh.normals[:, 1] < -0.5
        # Covers have the colour of the untitled edge of their spine.
        u = (
            cell + np.where(spine, 0.5 + 0.9 * mesh.vertices_m[:, 0] / thick, 0.06)
        ) / m.BOOKS
        v = np.where(spine, 0.02 + 0.96 * mesh.vertices_m[:, 2] / tall, 0.97)
        return Mesh(mesh.vertices_m, mesh.faces, mesh.normals, np.stack([u, v], -1))

    def counter(self, w: float = 2.4) -> Item:
        """Kitchen base units with a worktop, a sink with a tap, a hob and an oven."""
        d = 0.62
        h = 0.9
        worktop = box(w, d + 0.02, 0.04, 0.012, steps=3).shifted(
            0, -d / 2 - 0.01, h - 0.04
        )
        parts = [
            (box(w, d - 0.08, 0.1, 0.003).shifted(0, -d / 2 + 0.04, 0), self.woods[1]),
            (
                box(w, d - 0.04, h - 0.14, 0.004).shifted(0, -d / 2 + 0.02, 0.1),
                self.paint,
            ),
            (worktop, self.stone),
        ]
        units = round(w / 0.6)
        for i in range(units):
            x = -w / 2 + (i + 0.5) * w / units
            if i == units - 1:  # the oven
                oven = box(0.56, 0.03, 0.6, 0.01).shifted(x, -d + 0.02, 0.14)
                handle = _handle(x, 0.22, -d - 0.03, 0.66, 0.01)
                knobs = [
                    cylinder(0.018, 0.025).rotated(
                        about_x(np.pi / 2), (x + k, -d + 0.01, 0.8)
                    )
                    for k in (-0.2, -0.1, 0.1, 0.2)
                ]
                parts += [(oven, self.dark), (handle, self.steel)]
                parts.append((Mesh.merged(knobs), self.steel))
            else:
                door = box(w / units - 0.012, 0.022, h - 0.17, 0.007).shifted(
                    x, -d + 0.03, 0.11
                )
                handle = _handle(x, 0.1, -d - 0.01, 0.75, 0.007)
                parts += [(door, self.paint), (handle, self.steel)]
        sink = -w / 2 + 0.7
        hob = w / 2 - 0.32
        parts.append(
            (box(0.56, 0.42, 0.012, 0.005).shifted(sink, -d / 2, h), self.steel)
        )
        parts.append(
            (box(0.46, 0.32, 0.01, 0.004).shifted(sink, -d / 2, h + 0.005), self.dark)
        )
        t = np.linspace(0, np.pi, 12)
        y = -0.17 - 0.08 * (1 - np.cos(t))
        z = h + 0.24 + 0.09 * np.sin(t)
        arc = np.stack([np.full(12, sink), y, z], -1)
        pipe = np.concatenate([[[sink, -0.17, h]], [[sink, -0.17, h + 0.12]], arc])
        parts.append((tube(pipe, 0.013), self.steel))
        parts.append((box(0.56, 0.48, 0.008, 0.003).shifted(hob, -d / 2, h), self.dark))
        rings = [
            cylinder(r, 0.006, 0.002, 32).shifted(hob + x, -d / 2 + y, h + 0.005)
            for r, x, y in HOB_RINGS
        ]
        parts.append((Mesh.merged(rings), self.steel))
        worktop_space = (sink + 0.32, hob - 0.32, -d + 0.08, -0.06, h)
        hob_space = (hob - 0.2, hob + 0.2, -0.3, -0.15, h + 0.012)
        return Item("counter", parts, [worktop_space, hob_space])

    def fridge(self) -> Item:
        """A fridge with two rounded doors and notes on them."""
        paint = m.lacquer(self.name("fridge"), pick(self.rng, PAINTS), self.rng)
        parts = [(box(0.62, 0.6, 1.8, 0.02).shifted(0, -0.3, 0), paint)]
        for z, h in ((0.05, 1.1), (1.17, 0.6)):
            parts.append(
                (box(0.61, 0.06, h, 0.028, steps=4).shifted(0, -0.62, z), paint)
            )
            bar = [
                (-0.25, -0.67, z + 0.1),
                (-0.25, -0.69, z + h / 2),
                (-0.25, -0.67, z + h - 0.1),
            ]
            parts.append((tube(bar, 0.012), self.steel))
        for _ in range(4):
            x = self.rng.uniform(-0.15, 0.2)
            z = self.rng.uniform(0.7, 1.55)
            note = sheet((x, -0.652, z), (0.1, 0, 0), (0, 0, 0.13))
            parts.append(
                (note, m.label(self.name("note"), pick(self.rng, CLOTHS), self.rng))
            )
        return Item("fridge", parts, [(-0.25, 0.25, -0.5, -0.1, 1.8)])

    def floor_lamp(self) -> Item:
        """A floor lamp that is on."""
        profile = [
            (0, 0),
            (0.15, 0),
            (0.15, 0.015),
            (0.02, 0.035),
            (0.012, 0.1),
            (0.012, 1.4),
        ]
        foot = lathe([*profile, (0, 1.4)], 24, 2).shifted(0, -0.2, 0)
        shade = lathe(lampshade((0.19, 1.3), (0.17, 1.45), (0.13, 1.62)), 28, 1)
        return Item(
            "floor lamp", [(foot, self.dark), (shade.shifted(0, -0.2, 0), m.GLOW)]
        )


def _handle(x: float, half_width: float, y: float, z: float, radius: float) -> Mesh:
    """A horizontal bar that bends 1 cm outwards in the middle."""
    return tube(
        [(x - half_width, y, z), (x, y - 0.01, z), (x + half_width, y, z)], radius
    )
