"""A room after a change: some small objects moved or removed, other lamps on.

Walls, windows, furniture and wall objects stay, so the base frame and most of the view are
unchanged.
"""

from dataclasses import replace

import numpy as np
from numpy.random import Generator

from rooms.items import Item, overlaps
from rooms.materials import Material
from rooms.room import Room

SMALL = (
    "ball", "basket", "blocks", "books", "bottle", "bowl", "carton", "jar", "kettle", "lamp",
    "mug", "plant", "plates", "pot", "radio", "vase",
)  # fmt: skip
"""Kinds of objects that people pick up; all others are furniture or wall objects."""
CHANGED_SHARE = 1 / 3
"""Fraction of small objects that change; every second one moves, the others are removed."""
MOVED_M = 0.15
"""Smallest distance that an object moves."""

_GAP_M = np.array([0.004, 0.004, 0.0])
"""Gap between neighbouring objects; an object may touch the surface below it."""
_FOOT_M = np.array([[-0.2, -0.2, 0.0], [0.2, 0.2, 1.26]])
"""Box that stays free for the foot of the arm, base frame."""
_WORK_M = np.array([0.45, 0.0])
"""Centre of the work area on the robot's table, base frame; 0.16 m around it stay free."""


def changed_room(before: Room, seed: int) -> Room:
    """Change a room. The same room and seed give the same change.

    Unchanged objects keep their order; lamps that are off or dimmed have new materials.
    """
    return relit(rearranged(before, seed), seed)


def rearranged(before: Room, seed: int) -> Room:
    """Move or remove a share of the small objects."""
    rng = np.random.default_rng([seed, 12, before.seed])
    small = [i for i, item in enumerate(before.items) if item.kind in SMALL]
    touched = rng.choice(small, round(CHANGED_SHARE * len(small)), replace=False)
    remaining: dict[int, Item | None] = dict(enumerate(before.items))
    for number, i in enumerate(touched.tolist()):
        item = before.items[i]
        remaining[i] = None
        if number % 2 == 0:
            rest = list(filter(None, remaining.values()))
            remaining[i] = moved_item(item, before, rest, rng)
    return replace(before, items=list(filter(None, remaining.values())))


def relit(before: Room, seed: int) -> Room:
    """Switch and dim lamps."""
    items = list(before.items)
    lamps = []
    for i, item in enumerate(items):
        if any(material.emission > 0 for _, material in item.parts):
            lamps.append(i)
    rng = np.random.default_rng([seed, 13, before.seed])
    ceiling, *factors = _factors(1 + len(lamps), rng)
    for factor, i in zip(factors, lamps, strict=True):
        parts = [(mesh, _dimmed(material, factor)) for mesh, material in items[i].parts]
        items[i] = replace(items[i], parts=parts)
    shell = [
        (mesh, material if material.name == "sky" else _dimmed(material, ceiling))
        for mesh, material in before.shell
    ]
    return replace(before, items=items, shell=shell)


def _factors(lamps: int, rng: Generator) -> list[float]:
    """Brightness factor of each lamp; 0 is off.

    At least one lamp goes off, and one of several stays on. Lamps that stay on share one factor
    (0.44 to 2.3), because surfaces whose materials have the same name are rendered as one.
    """
    off = rng.permutation(lamps) < rng.integers(1, max(2, lamps))
    strength = float(2 ** rng.uniform(-1.2, 1.2))
    return [0.0 if dark else strength for dark in off]


def _dimmed(material: Material, factor: float) -> Material:
    """The material with `factor` times its emission; other materials are returned unchanged."""
    if material.emission == 0:
        return material
    name = material.name if factor > 0 else f"{material.name} off"
    return replace(material, name=name, emission=factor * material.emission)


def moved_item(item: Item, room: Room, rest: list[Item], rng: Generator) -> Item | None:
    """The item at a free position on the floor or on furniture; None after 60 failed attempts."""
    low, high = item.bounds_m()
    middle = (low + high)[:2] / 2
    x, y = -middle
    at_origin = item.placed(x, y, -low[2])
    on_floor = low[2] < room.low_m[2] + 0.01
    tops = [(other, top) for other in rest for top in other.tops]
    area = np.array([(x1 - x0) * (y1 - y0) for _, (x0, x1, y0, y1, _) in tops])
    for _ in range(60):
        host = None
        z = float(room.low_m[2])
        if on_floor:
            spot = rng.uniform(room.low_m[:2] + 0.25, room.high_m[:2] - 0.25)
            # Along the walls, as in furnishing: people walk in the middle of the room.
            if np.minimum(spot - room.low_m[:2], room.high_m[:2] - spot).min() >= 0.9:
                continue
        else:
            host, (x0, x1, y0, y1, z) = tops[rng.choice(len(tops), p=area / area.sum())]
            spot = rng.uniform((x0, y0), (x1, y1))
            z += 0.001
        yaw = rng.uniform(0, 2 * np.pi)
        moved = at_origin.placed(spot[0], spot[1], z, yaw)
        blocks_work = host is rest[0] and np.hypot(*(spot - _WORK_M)) < 0.16
        far = np.hypot(*(spot - middle)) >= MOVED_M
        if far and not blocks_work and _fits(moved, room, rest, host):
            return moved
    return None


def _fits(item: Item, room: Room, rest: list[Item], host: Item | None) -> bool:
    """Whether the item is inside the room and overlaps no other item and no part of its host."""
    low, high = bounds = item.bounds_m()
    if (low[:2] < room.low_m[:2]).any() or (high[:2] > room.high_m[:2]).any():
        return False
    others = [other for other in rest if other is not host]
    if host is not None:
        others += [Item("part", [part]) for part in host.parts]
    boxes = [_FOOT_M, *(other.bounds_m() for other in others)]
    return not overlaps(bounds, boxes, _GAP_M)
