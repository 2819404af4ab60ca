"""`PairMotions`: motions of a camera beside those of a frame that carries it.

The rotation of a camera between two images equals that of the frame up to one fixed rotation, and
its translation does up to one fixed position. Both have a closed form.
"""

from typing import NamedTuple

import numpy as np

from evercal.geometry.se3 import SE3, cross_matrix, nearest_rotation, norms
from evercal.typing import Array, ArrayPair, IntArray

_ANGLE = 0.15
"""Difference of angles at which a pair loses half its weight, radians."""
_ALIGNMENTS = 4
"""Number of weighted alignments of rotations."""
_SHORT_M = 0.02
"""Motion below which the direction of a translation says little."""


class PairMotions(NamedTuple):
    """Motions of a camera between p pairs of images, from the images alone."""

    ends: IntArray
    """(p, 2) numbers of the images."""
    turns: Array
    """(p, 3) rotation vectors of first_from_second."""
    directions: Array
    """(p, 3) unit vectors from the first camera to the second one, in the first."""

    def residuals(self, between: SE3, prior: float) -> ArrayPair:
        """(h, p, 3) differences of rotations and of directions, for (h, p) motions of the frame.

        `prior` is the weight of the position of the camera in it, 1/m^2.
        """
        stated = between.rotation.as_rotvec()
        rotation = np.eye(3)
        turned = np.zeros_like(stated)
        for _ in range(_ALIGNMENTS):
            weights = 1 / (1 + (norms(turned) / _ANGLE) ** 2)
            sides = stated.swapaxes(1, 2) * weights[:, None]
            rotation = nearest_rotation(sides @ self.turns)
            turned = stated @ rotation - self.turns
        directions = self.directions @ rotation.swapaxes(1, 2)
        moved = _moved(between, directions, prior)
        unit = moved / (norms(moved)[..., None] + _SHORT_M)
        return turned, unit - directions * norms(unit)[..., None]


def _moved(between: SE3, directions: Array, prior: float) -> Array:
    """(h, p, 3) translations of the camera at the position that fits the directions best."""
    lever = between.rotation_matrix() - np.eye(3)
    moved = between.translation_m
    across = cross_matrix(directions)
    slopes = across @ lever
    aside = across @ moved[..., None]
    position = np.zeros((len(moved), 1, 3, 1))
    for _ in range(2):
        off = norms((aside + slopes @ position)[..., 0])
        length = norms(moved + (lever @ position)[..., 0]) + _SHORT_M
        weights = 1 / (length**2 + (off / _ANGLE) ** 2)
        sides = slopes.swapaxes(2, 3) * weights[..., None, None]
        squares = (sides @ slopes).sum(1) + prior * np.eye(3)
        fitted = np.linalg.solve(squares, (sides @ aside).sum(1))
        position = -fitted[:, None]
    return moved + (lever @ position)[..., 0]
