"""A start that is robust to outliers: the best of many closed-form solutions.

Each solves A X = X B for the motions A of the parent and B of the camera among three poses, and one
among all poses. F. Park and B. Martin, Robot sensor calibration: solving AX = XB on the Euclidean
group, 1994. The axes are weighted by the sine of the angle, because the logarithm of a rotation by
180 degrees has no sign. A fixed seed gives sorted poses the same start every time.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np

from evercal.calibration.pose_pairs.pose_equation import PoseEquation, Unknowns
from evercal.typing import Array, IntArray

_SAMPLES = 150
"""Number of samples; even with 50 % outliers about 20 samples contain inliers only."""
_SCORED = 60
"""Maximum number of poses that score a sample."""
_FLOOR = 1e-9


class Start(NamedTuple):
    """The best closed-form solution."""

    at: Unknowns
    scale: float
    """Metres per unit of the camera's translations."""


def consensus_start(equation: PoseEquation, scale_known: bool = True) -> Start:
    """Return the hypothesis that agrees best with the better half of three or more poses."""
    n = len(equation)
    scored = equation[np.unique(np.linspace(0, n - 1, _SCORED).round().astype(int))]
    i, j = np.triu_indices(len(scored), 1)
    triples = _triples(n)
    sampled = _solve_motions(
        equation, triples[:, [0, 0, 1]], triples[:, [1, 2, 2]], scale_known
    )
    whole = _solve_motions(scored, i[None], j[None], scale_known)
    rotations, shifts, scales = (
        np.concatenate(both) for both in zip(sampled, whole, strict=True)
    )
    # (h, n) board poses in the fixed frame by each hypothesis.
    fixed_from_camera = scored.robot_rotation @ rotations[:, None]
    turned = fixed_from_camera @ scored.camera_rotation
    placed = (fixed_from_camera @ scored.camera_translation[..., None])[..., 0]
    placed = placed * scales[:, None, None] + scored.robot_translation
    placed += (scored.robot_rotation @ shifts[:, None, :, None])[..., 0]
    cost, mean_rotations, mean_shifts = _spread(turned, placed)
    cost[~(scales > 0)] = np.inf
    best = int(np.argmin(cost))
    at = Unknowns(
        np.stack([rotations[best], mean_rotations[best]]),
        np.stack([shifts[best], mean_shifts[best]]),
        np.zeros(len(equation.extras.names)),
    )
    return Start(at, float(scales[best]))


def _triples(n: int) -> IntArray:
    if n * (n - 1) * (n - 2) // 6 <= _SAMPLES:
        return np.array(list(combinations(range(n), 3)))
    rng = np.random.default_rng(0)
    return np.argsort(rng.random((_SAMPLES, n)), 1)[:, :3]


def _solve_motions(
    equation: PoseEquation,
    first: IntArray,
    second: IntArray,
    scale_known: bool,
) -> tuple[Array, Array, Array]:
    """Solve A X = X B for h sets of m motions between the poses `first` and `second`, (h, m).

    Returns:
        Rotations (h, 3, 3), translations (h, 3) and scales (h,) of `parent_from_camera`.
    """
    robot = equation.robot_rotation
    camera = equation.camera_rotation
    inverse = robot[first].transpose(0, 1, 3, 2)
    rotation_a = inverse @ robot[second]
    rotation_b = camera[first] @ camera[second].transpose(0, 1, 3, 2)
    shift = equation.robot_translation[second] - equation.robot_translation[first]
    translation_a = (inverse @ shift[..., None])[..., 0]
    board = equation.camera_translation
    translation_b = board[first] - (rotation_b @ board[second][..., None])[..., 0]
    rotations = _nearest(
        _sine_axes(rotation_a).transpose(0, 2, 1) @ _sine_axes(rotation_b)
    )
    system = rotation_a - np.eye(3)
    right_side = -translation_a
    rotated = translation_b @ rotations.transpose(0, 2, 1)
    unit = np.sqrt((translation_b**2).mean((1, 2), keepdims=True)) + 1e-300
    if scale_known:
        right_side = right_side + rotated
    else:
        system = np.concatenate([system, -(rotated / unit)[..., None]], -1)
    h = len(system)
    unknowns = system.shape[-1]
    system = system.reshape(h, -1, unknowns)
    right_side = right_side.reshape(h, -1, 1)
    normal = system.transpose(0, 2, 1) @ system
    ridge = 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-12
    projected = system.transpose(0, 2, 1) @ right_side
    solution = np.linalg.solve(normal + ridge * np.eye(unknowns), projected)[..., 0]
    scales = np.ones(h) if scale_known else solution[:, 3] / unit[:, 0, 0]
    return rotations, solution[:, :3], scales


def _sine_axes(rotations: Array) -> Array:
    skew = rotations - np.swapaxes(rotations, -1, -2)
    return np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1)


def _spread(rotations: Array, translations: Array) -> tuple[Array, Array, Array]:
    """Return the (h,) logarithmic spread of the better half of n boards, and their mean."""
    h, n = translations.shape[:2]
    half = min(n, (n + 4) // 2)
    rows = np.arange(h)[:, None]
    mean_rotation = _nearest(np.median(rotations, 1))
    mean_translation = np.median(translations, 1)
    spread = np.zeros((2, h))
    for _ in range(3):
        metres2 = ((translations - mean_translation[:, None]) ** 2).sum(-1) + _FLOOR**2
        radians2 = ((rotations - mean_rotation[:, None]) ** 2).sum(
            (-1, -2)
        ) / 2 + _FLOOR**2
        # Each distance is divided by its median so that the two can be added.
        ratio = metres2 / np.median(metres2, 1, keepdims=True)
        ratio += radians2 / np.median(radians2, 1, keepdims=True)
        nearest = np.argsort(ratio, 1)[:, :half]
        mean_rotation = _nearest(rotations[rows, nearest].mean(1))
        mean_translation = translations[rows, nearest].mean(1)
        spread = np.stack([d[rows, nearest].mean(1) for d in (metres2, radians2)])
    return np.log(spread[0]) + np.log(spread[1]), mean_rotation, mean_translation


def _nearest(matrices: Array) -> Array:
    left, _, right = np.linalg.svd(matrices)
    left[..., -1] *= np.linalg.det(left @ right)[..., None]
    return left @ right
