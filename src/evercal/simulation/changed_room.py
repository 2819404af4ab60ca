"""The same room on another day: some small things moved or gone, other lamps on.

Walls, windows, furniture and what hangs on the walls stay as they were, so that the base frame and
most of what a camera sees still hold.
"""

from dataclasses import replace

import numpy as np

from evercal.simulation.furnished.furniture import Item
from evercal.simulation.furnished.materials import Material
from evercal.simulation.furnished.rooms import Room

SMALL = frozenset(
    (
        "ball", "basket", "blocks", "books", "bottle", "bowl", "carton", "jar", "kettle", "lamp",
        "mug", "plant", "plates", "pot", "radio", "vase",
    )
)  # fmt: skip
"""Kinds of things that people pick up; everything else in a room is furniture or hangs."""
CHANGED_SHARE = 1 / 3
"""Of the small things; every second one of them moves, the others go."""
MOVED_M = 0.15
"""A thing that moves goes at least this far."""

_GAP_M = np.array([0.004, 0.004, 0.0])
"""Between things side by side; a thing may touch what it stands on."""
_FOOT_M = np.array([[-0.2, -0.2, 0.0], [0.2, 0.2, 1.26]])
"""Stays free for the arm's foot, base frame."""
_WORK_M = np.array([0.45, 0.0])
"""Middle of the work area on the robot's table, base frame; 0.16 m round it stay free."""


def changed_room(before: Room, seed: int) -> Room:
    """The room after a change; the same room and seed give the same change.

    Args:
        before: is left as it is.
        seed: of the change.

    Returns:
        A room of the same kind and seed in the same base frame. Things that nobody touched keep
        their order; lamps that are off or dimmed have new materials.
    """
    items = _rearranged(before, np.random.default_rng([seed, 12, before.seed]))
    lamps = [i for i, item in enumerate(items) if any(mat.emission > 0 for _, mat in item.parts)]
    ceiling, *factors = _factors(1 + len(lamps), np.random.default_rng([seed, 13, before.seed]))
    for factor, i in zip(factors, lamps, strict=True):
        parts = [(mesh, _dimmed(material, factor)) for mesh, material in items[i].parts]
        items[i] = replace(items[i], parts=parts)
    shell = [
        (mesh, material if material.name == "sky" else _dimmed(material, ceiling))
        for mesh, material in before.shell
    ]
    return replace(before, items=items, shell=shell)


def _factors(lamps: int, rng: np.random.Generator) -> list[float]:
    """For each lamp its light in parts of what it was; 0 is off.

    At least one goes off, and one stays on if there are several. All that stay on are dimmed or
    turned up alike (0.44 to 2.3), as surfaces whose materials have one name are drawn as one.
    """
    off = rng.permutation(lamps) < rng.integers(1, max(2, lamps))
    strength = float(2 ** rng.uniform(-1.2, 1.2))
    return [0.0 if dark else strength for dark in off]


def _dimmed(material: Material, factor: float) -> Material:
    """With `factor` times the light; 0 is off, and nothing happens to what is no lamp."""
    if material.emission == 0:
        return material
    name = material.name if factor > 0 else f"{material.name} off"
    return replace(material, name=name, emission=factor * material.emission)


def _rearranged(before: Room, rng: np.random.Generator) -> list[Item]:
    """The items with a share of the small ones at other places or left out."""
    small = [i for i, item in enumerate(before.items) if item.kind in SMALL]
    touched = rng.choice(small, round(CHANGED_SHARE * len(small)), replace=False)
    left: dict[int, Item] = dict(enumerate(before.items))
    for number, i in enumerate(touched.tolist()):
        thing = left.pop(i)
        moved = _elsewhere(thing, before, list(left.values()), rng) if number % 2 == 0 else None
        if moved is not None:
            left[i] = moved
    return [left[i] for i in sorted(left)]


def _elsewhere(thing: Item, place: Room, rest: list[Item], rng: np.random.Generator) -> Item | None:
    """At a free place: on the floor for what stood there, else on a top; None if none is found."""
    low, high = thing.bounds_m()
    middle = (low + high)[:2] / 2
    at_origin = thing.placed(-float(middle[0]), -float(middle[1]), -float(low[2]))
    on_floor = low[2] < place.low_m[2] + 0.01
    tops = [(item, top) for item in rest for top in item.tops]
    area = np.array([(x1 - x0) * (y1 - y0) for _, (x0, x1, y0, y1, _) in tops])
    for _ in range(60):
        host, z = None, float(place.low_m[2])
        if on_floor:
            inner = place.low_m[:2] + 0.25, place.high_m[:2] - 0.25
            spot = rng.uniform(*inner)
            # As when the room was furnished: along the walls, not where people walk.
            if np.minimum(spot - place.low_m[:2], place.high_m[:2] - spot).min() >= 0.9:
                continue
        else:
            host, (x0, x1, y0, y1, z) = tops[rng.choice(len(tops), p=area / area.sum())]
            spot = rng.uniform((x0, y0), (x1, y1))
            z += 0.001
        turn = float(rng.uniform(0, 2 * np.pi))
        moved = at_origin.placed(float(spot[0]), float(spot[1]), z, turn)
        in_the_way = host is rest[0] and np.hypot(*(spot - _WORK_M)) < 0.16
        far = np.hypot(*(spot - middle)) >= MOVED_M
        if far and not in_the_way and _fits(moved, place, rest, host):
            return moved
    return None


def _fits(thing: Item, place: Room, rest: list[Item], host: Item | None) -> bool:
    """Whether it is in the room and in no other thing; of its host, the parts count one by one."""
    bounds = thing.bounds_m()
    if (bounds[0, :2] < place.low_m[:2]).any() or (bounds[1, :2] > place.high_m[:2]).any():
        return False
    boxes = [_FOOT_M, *(item.bounds_m() for item in rest if item is not host)]
    if host is not None:
        boxes += [Item("part", [part]).bounds_m() for part in host.parts]
    low, high = np.stack(boxes).swapaxes(0, 1)
    hit = (bounds[0] < high + _GAP_M) & (bounds[1] > low - _GAP_M)
    return not hit.all(-1).any()
