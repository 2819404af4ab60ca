"""The atlas: one frame for the network in which scenes do not overlap.

Every scene keeps its own base frame; `atlas_from_base` only shifts it into the scene's cell.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from evercal.classes import frozen
from evercal.errors import InputError
from evercal.geometry.se3 import SE3
from evercal.typing import Array, Triple

MIN_CELL_M = 5.0
"""Minimum side of a scene's cell, and distance of the positions of cells, metres."""


@frozen
class Cell:
    """The square of the atlas that belongs to one scene."""

    centre_m: Triple
    """Atlas coordinates of the scene's mean camera position."""
    side_m: float
    """Side of the square in x and y."""
    origin_m: Triple
    """Mean camera position in the scene's own base frame."""

    @property
    def atlas_from_base(self) -> SE3:
        """Translation from the scene's base frame into the atlas."""
        shift = np.subtract(self.centre_m, self.origin_m)
        return SE3.from_translation(shift)

    def distance_m(self, position_m: Array) -> float:
        """Largest difference in x or y between an atlas position (3,) and the centre."""
        return float(np.abs(position_m[:2] - self.centre_m[:2]).max())


@dataclass
class Atlas:
    """Cells in the order of their scenes.

    The open layout assigns the first free position of a square spiral that is large enough, so
    scenes need not be known in advance. The paper's is GLACE's grid for n expected scenes: with
    ceil(sqrt(n)) columns, the cell of scene i lies at 5 m (-row, -column, 0).
    """

    expected: int = 0
    """Scenes of the paper's layout; 0 for the open one."""
    cells: list[Cell] = field(default_factory=list)

    def place(self, positions_m: Array) -> Cell:
        """Assign a cell to a new scene with (n, 3) camera positions in its base frame."""
        origin = positions_m.mean(axis=0)
        if self.expected:
            side = MIN_CELL_M
            centre = self._next_of_grid()
        else:
            extent = float(np.ptp(positions_m, axis=0).max())
            side = max(MIN_CELL_M, 2.0 * extent)
            centre = next(filter(partial(self._is_free, side), spiral()))
        cell = Cell(tuple(centre.tolist()), side, tuple(origin.tolist()))
        self.cells.append(cell)
        return cell

    def _next_of_grid(self) -> Array:
        if len(self.cells) < self.expected:
            return paper_grid(self.expected)[len(self.cells)]
        raise InputError(
            f"atlas: the paper layout is full with {self.expected} scenes; expect more"
            " scenes, or use the open layout"
        )

    def _is_free(self, side: float, centre: Array) -> bool:
        return all(
            cell.distance_m(centre) >= (side + cell.side_m) / 2 for cell in self.cells
        )


def camera_clusters(positions_m: Array, count: int, seed: int) -> Array:
    """Return (k, 3) k-means of camera positions (n, 3); k is at most the distinct positions."""
    from scipy.cluster.vq import kmeans2

    if count == 1:
        return positions_m.mean(0, keepdims=True)
    count = min(count, len(np.unique(positions_m, axis=0)))
    means, _ = kmeans2(positions_m, count, minit="++", rng=np.random.default_rng(seed))
    return means


def combined_centres(
    positions_m: Sequence[Array], count: int, seed: int
) -> tuple[Triple, ...]:
    """Compute the cluster centres of all scenes in the paper's layout.

    As in GLACE, k-means runs on the camera positions of all scenes together. These are (n, 3) in
    each scene's base frame; `count` is K of the paper.
    """
    atlas = Atlas(len(positions_m))
    in_atlas = [
        atlas.place(scene).atlas_from_base.apply(scene) for scene in positions_m
    ]
    means = camera_clusters(np.concatenate(in_atlas), count, seed)
    return tuple(map(tuple, means.tolist()))


def spiral() -> Iterator[Array]:
    """Yield the points of an endless square spiral around the origin, 5 m apart."""
    position = np.zeros(3)
    step = np.array([MIN_CELL_M, 0.0, 0.0])
    leg = 1
    while True:
        for _ in range(2):
            for _ in range(leg):
                yield position.copy()
                position += step
            step[:2] = (-step[1], step[0])
        leg += 1


def paper_grid(count: int) -> Array:
    """Return the (count, 3) cell centres of GLACE's combined scenes, metres."""
    columns = math.ceil(math.sqrt(count))
    i = np.arange(count)
    row = i // columns
    column = i % columns
    return MIN_CELL_M * np.stack([-row, -column, 0 * i], -1)
