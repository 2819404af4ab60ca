"""Repeated texture: the steps by which a pose may have slipped.

Landmarks that look alike lie one or several periods of a pattern apart. If many pairs share one
displacement, the pose displaced by it matches these landmarks as well, and other landmarks decide.
"""

import numpy as np

from evercal.geometry import SE3
from evercal.typing import Array

MOST_LANDMARKS, MOST_STEPS = 400, 8
"""Landmarks that are compared, and steps that are returned, at most."""
MOST_COMPARED = 100
"""Frequent displacements that are compared, at most."""
FREQUENT = 0.4
"""Steps are at least this frequent, relative to the most frequent one."""
ALIKE = 0.85
"""Smallest correlation of the patches of two landmarks that look alike."""
TOLERANCE = 0.006
"""Largest difference of shared displacements, as a share of the distance from the camera."""
LEAST_STEP = 0.015
"""Smallest step, as a share of the distance from the camera: patches overlap below."""
LEAST_PAIRS, LEAST_SHARE = 15, 0.05
"""Pairs that share a displacement, and their number as a share of the landmarks."""


def pattern_steps(points_m: Array, templates: Array, position_m: Array) -> Array:
    """Displacements (k, 3) that many pairs of similar landmarks share, the shortest first.

    Landmarks (n, 3) agree with a pose at a position (3,); their templates (n, p) have zero mean and
    unit deviation. With every step its opposite is returned.
    """
    if not len(points_m):
        return np.zeros((0, 3))
    some = np.linspace(0, len(points_m) - 1, min(MOST_LANDMARKS, len(points_m))).astype(
        int
    )
    points = points_m[some]
    patches = templates[some]
    away = float(np.median(np.linalg.norm(points - position_m, axis=1)))
    first, second = np.nonzero(patches @ patches.T > ALIKE * patches.shape[1])
    moves = points[second] - points[first]
    moves = moves[np.linalg.norm(moves, axis=1) > LEAST_STEP * away]
    if not len(moves):
        return np.zeros((0, 3))
    least = max(LEAST_PAIRS, LEAST_SHARE * len(some))
    return _shared(moves, TOLERANCE * away, least)


def _shared(moves: Array, tolerance: float, least: float) -> Array:
    """(k, 3) displacements within the tolerance of at least so many of `moves` (n, 3)."""
    cells = np.round(moves / tolerance).astype(np.int64)
    _, where, of, counts = np.unique(
        cells @ [1, 1 << 20, 1 << 40],
        return_index=True,
        return_inverse=True,
        return_counts=True,
    )
    cells = cells[where]
    sums = np.stack([np.bincount(of, column) for column in moves.T], 1)
    found: list[tuple[float, Array]] = []
    for cell in np.argsort(-counts, kind="stable")[:MOST_COMPARED]:
        # A displacement near the border of a cell has neighbours in the next one.
        near = (np.abs(cells - cells[cell]) <= 1).all(1)
        pairs = float(counts[near].sum())
        step = sums[near].sum(0) / pairs
        if pairs >= least and all(
            np.linalg.norm(step - s) > 3 * tolerance for _, s in found
        ):
            found.append((pairs, step))
    # Multiples of a period are nearly as frequent; a pose that slipped by one takes several steps.
    often = [step for pairs, step in found if pairs >= FREQUENT * found[0][0]]
    often.sort(key=lambda step: float(np.linalg.norm(step)))
    return np.array(often[:MOST_STEPS]).reshape(-1, 3)


def displaced(pose: SE3, step_m: Array) -> SE3:
    """The pose of a camera that is displaced by (3,) metres in the map's frame."""
    return SE3(pose.rotation_wxyz, pose.translation_m + step_m)
