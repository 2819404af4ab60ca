"""Repeated texture: the steps by which a pose may have slipped.

Landmarks that look alike lie one or several periods of a pattern apart. If many pairs share one
displacement, the pose displaced by it matches these landmarks as well, and other landmarks decide.
"""

import numpy as np
from numpy.typing import NDArray

from evercal.geometry import SE3, norms
from evercal.geometry.normal_equations import gram
from evercal.typing import Array, IntArray

MOST_LANDMARKS = 400
"""Maximum number of landmarks that are compared."""
MOST_STEPS = 8
"""Maximum number of steps that are returned."""
MOST_COMPARED = 100
"""Maximum number of frequent displacements that are compared."""
FREQUENT = 0.4
"""Minimum frequency of a step, relative to the most frequent one."""
ALIKE = 0.85
"""Minimum correlation of the patches of two landmarks that look alike."""
TOLERANCE = 0.006
"""Maximum difference of shared displacements, as a share of the distance from the camera."""
LEAST_STEP = 0.015
"""Minimum length of a step, as a share of the distance from the camera: patches overlap below."""
LEAST_PAIRS = 15
"""Minimum number of pairs that share a displacement."""
LEAST_SHARE = 0.05
"""The same as a share of the landmarks."""


def pattern_steps(points_m: Array, templates: Array, position_m: Array) -> Array:
    """Displacements (k, 3) that many pairs of similar landmarks share, the shortest first.

    Landmarks (n, 3) agree with a pose at a position (3,); their templates (n, p) have zero mean and
    unit deviation. With every step its opposite is returned.
    """
    if not len(points_m):
        return np.zeros((0, 3))
    count = min(MOST_LANDMARKS, len(points_m))
    sampled = np.linspace(0, len(points_m) - 1, count).astype(int)
    points = points_m[sampled]
    patches = templates[sampled]
    distances = norms(points - position_m)
    distance = float(np.median(distances))
    correlation = gram(patches)
    first, second = np.nonzero(correlation > ALIKE * patches.shape[1])
    moves = points[second] - points[first]
    lengths = norms(moves)
    moves = moves[lengths > LEAST_STEP * distance]
    if not len(moves):
        return np.zeros((0, 3))
    least = max(LEAST_PAIRS, LEAST_SHARE * count)
    return _shared(moves, TOLERANCE * distance, least)


def _shared(moves: Array, tolerance: float, least: float) -> Array:
    """(k, 3) displacements within the tolerance of at least so many of `moves` (n, 3)."""
    cells, counts, sums = _binned(moves, tolerance)
    steps: list[Array] = []
    frequencies: list[float] = []
    for cell in np.argsort(-counts, kind="stable")[:MOST_COMPARED]:
        # A displacement near the border of a cell has neighbours in the next one.
        near = (np.abs(cells - cells[cell]) <= 1).all(1)
        pairs = float(counts[near].sum())
        step = sums[near].sum(0) / pairs
        if pairs < least:
            continue
        if any(np.linalg.norm(step - other) <= 3 * tolerance for other in steps):
            continue
        steps.append(step)
        frequencies.append(pairs)
    # Multiples of a period are nearly as frequent; a pose that slipped by one takes several steps.
    frequent = []
    for step, pairs in zip(steps, frequencies, strict=True):
        if pairs >= FREQUENT * frequencies[0]:
            frequent.append(step)
    frequent.sort(key=lambda step: float(np.linalg.norm(step)))
    return np.array(frequent[:MOST_STEPS]).reshape(-1, 3)


def _binned(moves: Array, size: float) -> tuple[IntArray, NDArray[np.intp], Array]:
    """Cells (k, 3) of a grid that hold displacements (n, 3), their counts (k,) and sums (k, 3)."""
    cells = np.round(moves / size).astype(np.int64)
    _, first, owner, counts = np.unique(
        cells @ [1, 1 << 20, 1 << 40],
        return_index=True,
        return_inverse=True,
        return_counts=True,
    )
    sums = np.zeros((len(counts), 3))
    for axis in range(3):
        sums[:, axis] = np.bincount(owner, moves[:, axis])
    return cells[first], counts, sums


def displaced(pose: SE3, step_m: Array) -> SE3:
    """The pose of a camera that is displaced by (3,) metres in the map's frame."""
    return SE3(pose.rotation_wxyz, pose.translation_m + step_m)
