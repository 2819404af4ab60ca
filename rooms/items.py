"""Items: named groups of meshes, with surfaces for small objects."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from rooms.materials import Material
from rooms.shapes import Mesh

Parts = list[tuple[Mesh, Material]]
"""Meshes with their materials."""


def overlaps(
    bounds_m: np.ndarray, boxes_m: Sequence[np.ndarray], gap_m: ArrayLike
) -> bool:
    """Whether a bounding box (2, 3) is within a gap of one of others."""
    low, high = np.stack(boxes_m, 1)
    near = (bounds_m[0] < high + gap_m) & (bounds_m[1] > low - gap_m)
    return bool(near.all(-1).any())


@dataclass(eq=False)
class Item:
    """An object in a room."""

    kind: str
    """Name of the kind of object."""
    parts: Parts = field(default_factory=list)
    """Meshes in the frame of the item, metres."""
    tops: list[tuple[float, float, float, float, float]] = field(default_factory=list)
    """Surfaces for small objects: x_min, x_max, y_min, y_max, z; metres, frame of the item."""

    def add(self, mesh: Mesh, material: Material, *position_m: float) -> None:
        """Add a mesh at a position (x, y, z), or where it is without one."""
        if position_m:
            mesh = mesh.shifted(*position_m)
        self.parts.append((mesh, material))

    def add_top(self, x: float, front: float, back: float, z: float) -> None:
        """Add a surface at height z, from -x to x and from y = -front to y = -back."""
        self.tops.append((-x, x, -front, -back, z))

    def bounds_m(self) -> np.ndarray:
        """Lowest and highest corner, shape (2, 3)."""
        points = np.concatenate([mesh.vertices_m for mesh, _ in self.parts])
        return np.stack([points.min(0), points.max(0)])

    def scaled(self, factor: float) -> "Item":
        """The item without its tops, scaled about its origin."""
        parts = [(mesh.scaled(factor), material) for mesh, material in self.parts]
        return Item(self.kind, parts)

    def placed(self, x: float, y: float, z: float, yaw_rad: float = 0.0) -> "Item":
        """The item rotated about z, then shifted. Tops are exact for multiples of 90 deg only."""
        moved = Item(self.kind)
        for mesh, material in self.parts:
            moved.add(mesh.placed((x, y, z), yaw_rad), material)
        c = np.cos(yaw_rad)
        s = np.sin(yaw_rad)
        for x0, x1, y0, y1, top in self.tops:
            corners = np.array([[x0, y0], [x1, y1]]) @ [[c, s], [-s, c]] + (x, y)
            left, low = corners.min(0).tolist()
            right, high = corners.max(0).tolist()
            moved.tops.append((left, right, low, high, top + z))
        return moved
