"""Where a visitor looks from, so that everything that matters lies beside the panel."""

import numpy as np

from evercal.typing import Array, ArrayPair, Size

FOV_RAD = np.deg2rad(50.0)
"""Vertical angle of view."""
_PHONE_PX = 576
"""Width up to which viser lays the panel over the lower part of the picture."""
_COVERED = 1.2
"""Height that the panel covers of a phone's picture, in halves of that height."""
_WIDEST = 1.1
"""Width of the used part of a picture by its height: the panel may come over the rest."""
_DOWN = 0.62
"""Slope by which the visitor looks down."""
_MARGIN = 0.92
"""Share of the picture that is used."""


def overview(points_m: Array, ahead: Array, size_px: Size) -> ArrayPair:
    """Position and target of a view that shows points (n, 3) in a picture.

    The visitor looks to `ahead` (3,), whose height does not count.
    """
    width, height = np.maximum(size_px, 1)  # a hidden window may have none
    level = ahead[:2] + np.array([1e-9, 0.0])  # to x from straight above
    x, y = level / np.hypot(*level)
    forward = np.array([x, y, -_DOWN]) / np.hypot(1, _DOWN)
    right = np.array([y, -x, 0.0])
    axes = np.stack([right, np.cross(forward, right), forward])
    local = points_m @ axes.T
    depths = local[:, 2:]
    slopes = np.tan(FOV_RAD / 2) * np.array([min(width / height, _WIDEST), 1.0])
    low = _MARGIN * slopes
    high = low.copy()
    if width <= _PHONE_PX:
        high[1] -= _COVERED * slopes[1]
    # From (place, depth), -low <= (point - place) / (its depth - depth) <= high.
    least = (local[:, :2] - high * depths).max(axis=0)
    most = (local[:, :2] + low * depths).min(axis=0)
    depth = ((most - least) / (low + high)).min()
    place = (least + most + (high - low) * depth) / 2
    position = np.append(place, depth) @ axes
    return position, position + (np.median(depths) - depth) * forward
