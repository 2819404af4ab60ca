"""Things that the arm holds, and people who walk behind it, for recordings of `rooms.held`."""

from dataclasses import replace

import cv2
import numpy as np
from numpy.random import Generator

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.printing import board_image
from evercal.simulation.textures import dead_leaves
from evercal.typing import Image
from rooms.items import Parts
from rooms.materials import Material, fabric, plain
from rooms.prints import label, spines
from rooms.shapes import ball, lathe, sheet

SIZES_M = {
    "box": (0.16, 0.055, 0.24),
    "bottle": (0.06, 0.06, 0.24),
    "book": (0.16, 0.03, 0.23),
    "tool": (0.16, 0.05, 0.2),
    "board": (0.176, 0.006, 0.24),
}
"""Width, thickness between the fingers, and length of a thing at its full size, metres."""
SQUARES = Board("charuco", 0.032, 5, 7, 0.024, "4X4_50")
"""The ChArUco board at its full size."""


def thing_parts(thing: str, fault: str, scale: float, seed: int) -> Parts:
    """Meshes of a thing, a key of `SIZES_M`, in its frame; for `fault` see `rooms.held.FAULTS`."""
    rng = np.random.default_rng([seed, 22])
    makers = {
        "box": _box,
        "bottle": _bottle,
        "book": _book,
        "tool": _tool,
        "board": _board,
    }
    parts = makers[thing](rng)
    changes = {}
    if fault == "smooth":
        changes = {"texture": plain("dull", (0.72, 0.6, 0.45)).texture}
    elif fault == "repeats":
        badge = label("", tuple(rng.uniform(0.3, 0.8, 3)), rng).texture
        changes = {"texture": np.tile(badge[::4, ::4], (5, 5, 1))}
    elif fault == "shiny":
        changes = {"kind": "metal", "roughness": 0.06}
    held = []
    for number, (mesh, material) in enumerate(parts):
        name = f"thing{number}"
        mesh = replace(mesh.scaled(scale), uv=mesh.uv, name=name)
        held.append((mesh, replace(material, name=name, **changes)))
    return held


def _box(rng: Generator) -> Parts:
    side = (600, 150, 12)
    end = (150, 400, 8)
    pages = _pages(rng, (600, 400, None), (600, 400, 40), side, side, end, end)
    return _carton(SIZES_M["box"], pages)


def _book(rng: Generator) -> Parts:
    spine = spines("", rng).texture[:, :64]
    edge = np.full((256, 64, 3), (225, 218, 200), np.uint8)
    edge[:, ::3] -= np.uint8(14)
    covers = _pages(rng, (600, 400, None), (600, 400, 12))
    return _carton(SIZES_M["book"], [*covers, spine, edge, edge, edge])


def _board(rng: Generator) -> Parts:
    page = np.full((480, 352), 250, np.uint8)
    page[16:464, 16:336] = board_image(SQUARES, 64)
    white = np.full((1, 1, 3), 235, np.uint8)
    page = np.repeat(page[..., None], 3, 2)
    return _carton(SIZES_M["board"], [page, white, white, white, white, white])


def _bottle(rng: Generator) -> Parts:
    """Glass with a printed label around it; its neck is in the gripper."""
    r = 0.03
    length = SIZES_M["bottle"][2]
    radii = (0, 0.8, 1, 1, 0.85, 0.45, 0.42, 0)
    heights = (0.0, 0, 0.03, 0.62, 0.72, 0.82, 1, 1)
    body = lathe(np.c_[r * np.array(radii), length * np.array(heights)], 48, 1)
    band = lathe([(r * 1.01, 0.08 * length), (r * 1.01, 0.6 * length)], 48, 1)
    band = replace(band, uv=band.uv / np.ptp(band.uv, axis=0))
    tint, print_ = _pages(rng, (300, 256, 3), (420, 620, None))
    glass = Material("", tint // 4 + np.uint8(40), 0.2, "coated", 0.1)
    paper = Material("", print_, kind="coated", roughness=0.35)
    turned = np.diag([1.0, -1.0, -1.0])  # its bottom is away from the gripper
    middle = (0, 0, -length / 2)
    return [
        (body.shifted(*middle).rotated(turned), glass),
        (band.shifted(*middle).rotated(turned), paper),
    ]


def _tool(rng: Generator) -> Parts:
    """A cordless drill: motor, handle in the gripper, battery."""
    tool = []
    for size, place in (
        ((0.05, 0.045, 0.11), (-0.02, 0, -0.045)),
        ((0.16, 0.05, 0.06), (0.0, 0, 0.07)),
        ((0.1, 0.05, 0.05), (-0.02, 0, 0.015)),
    ):
        x, y, z = (max(64, round(2500 * side)) for side in size)
        front = (z, x, None)
        side = (z, y, None)
        end = (y, x, 8)
        pages = _pages(rng, front, front, side, side, end, end)
        for mesh, material in _carton(size, pages):
            tool.append((mesh.shifted(*place), material))
    return tool


def _carton(size_m: tuple[float, float, float], pictures: list[Image]) -> Parts:
    """A box with pictures on its front and back (y), sides (x), and ends (z)."""
    parts = []
    half = np.array(size_m) / 2
    faces = ((1, 1), (1, -1), (0, 1), (0, -1), (2, 1), (2, -1))
    for picture, (axis, sign) in zip(pictures, faces, strict=True):
        normal = np.zeros(3)
        v = np.zeros(3)
        normal[axis] = sign
        v[1 if axis == 2 else 2] = -1.0  # upright where the gripper is above
        u = np.cross(v, normal)
        mesh = sheet((normal - u - v) * half, 2 * u * half, 2 * v * half)
        parts.append((mesh, Material("", picture, kind="coated", roughness=0.3)))
    return parts


def _pages(rng: Generator, *formats: tuple[int, int, int | None]) -> list[Image]:
    """Printed pages of (rows, columns, leaves): a picture with a label on it."""
    pages = []
    for rows, columns, leaves in formats:
        page = dead_leaves(rows, columns, rng, leaves)
        side = min(rows, columns) * 3 // 5
        badge = label("", tuple(rng.uniform(0.1, 0.9, 3)), rng).texture
        top = rng.integers(0, rows - side)
        left = rng.integers(0, columns - side)
        badge = cv2.resize(badge, (side, side), interpolation=cv2.INTER_AREA)
        page[top : top + side, left : left + side] = badge
        pages.append(page)
    return pages


def people(seed: int) -> list[Parts]:
    """Two persons: a patterned body with a head, feet at the origin."""
    rng = np.random.default_rng([seed, 24])
    persons = []
    for k in range(2):
        body = lathe(
            [(0, 0), (0.16, 0), (0.2, 0.9), (0.24, 1.35), (0.08, 1.5), (0, 1.5)], 24, 1
        )
        cloth = fabric(f"person{k}", tuple(rng.uniform(0.1, 0.8, 3)), rng)
        head = replace(ball(0.12).shifted(0, 0, 1.48), name=f"head{k}")
        skin = plain(head.name, (0.75, 0.55, 0.42))
        persons.append([(replace(body, name=cloth.name), cloth), (head, skin)])
    return persons
