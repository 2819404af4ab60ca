"""A start that is robust to outliers: the best of many closed-form solutions.

Each solves A X = X B for the motions A of the parent and B of the camera among three poses, and one
among all poses. F. Park and B. Martin, Robot sensor calibration: solving AX = XB on the Euclidean
group, 1994. The axes are weighted by the sine of the angle, because the logarithm of a rotation by
180 degrees has no sign. A fixed seed gives sorted poses the same start every time.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np

from evercal.calibration.pose_pairs.fit import Agreement, agreement
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.pose_equation import Extras, PoseEquation, Unknowns
from evercal.geometry import nearest_rotation, spread
from evercal.robot.mount import MountName
from evercal.typing import Array, IntArray

_SAMPLES = 150
"""Number of samples; even with 50 % outliers about 20 samples contain inliers only."""
_MAX_SCORED = 60
"""Maximum number of poses that score a sample."""
_MIN_DISTANCE = 1e-9
"""Minimum distance from the mean, metres and radians, so that exact poses have a score."""
_REFINEMENTS = 3
"""Number of times that the mean of the better half is computed."""


class _Hypotheses(NamedTuple):
    """`parent_from_camera` by each of h samples."""

    rotations: Array
    """(h, 3, 3)."""
    translations: Array
    """(h, 3) metres."""
    scales: Array
    """(h,) metres per unit of the camera's translations."""


class Start(NamedTuple):
    """The best closed-form solution."""

    at: Unknowns
    scale: float
    """Metres per unit of the camera's translations."""


def consensus_start(equation: PoseEquation, scale_known: bool = True) -> Start:
    """Return the hypothesis that agrees best with the better half of three or more poses."""
    n = len(equation)
    scored = equation[spread(n, _MAX_SCORED)]
    a, b, c = _triples(n).T
    first = np.stack([a, a, b], 1)
    second = np.stack([b, c, c], 1)
    samples = _solve_motions(equation, first, second, scale_known)
    i, j = np.triu_indices(len(scored), 1)
    whole = _solve_motions(
        scored,
        i[None],
        j[None],
        scale_known,
    )
    pairs = zip(samples, whole, strict=True)
    rotations, shifts, scales = map(np.concatenate, pairs)
    # (h, n) board poses in the fixed frame by each hypothesis.
    fixed_from_camera = scored.robot_rotation @ rotations[:, None]
    board_rotations = fixed_from_camera @ scored.camera_rotation
    boards = (fixed_from_camera @ scored.camera_translation[..., None])[..., 0]
    boards = boards * scales[:, None, None] + scored.robot_translation
    boards += (scored.robot_rotation @ shifts[:, None, :, None])[..., 0]
    cost, mean_rotations, mean_shifts = _spread(board_rotations, boards)
    cost[~(scales > 0)] = np.inf
    best = int(np.argmin(cost))
    at = Unknowns(
        rotations=np.stack([rotations[best], mean_rotations[best]]),
        translations=np.stack([shifts[best], mean_shifts[best]]),
        extras=np.zeros(len(equation.extras.names)),
    )
    return Start(at, float(scales[best]))


def quick_fit(
    pairs: PosePairs, mount: MountName, scale_known: bool
) -> tuple[Agreement, float]:
    """Return a robust estimate of X and Z alone, and the scale."""
    blank = Extras.nothing(len(pairs))
    start = consensus_start(pairs.equation(mount, blank), scale_known)
    equation = pairs.scaled(start.scale).equation(mount, blank)
    return agreement(equation, start.at), start.scale


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
) -> _Hypotheses:
    """Solve A X = X B for h sets of m motions between the poses `first` and `second`, (h, m)."""
    robot = equation.robot_rotation
    camera = equation.camera_rotation
    inverse = robot[first].transpose(0, 1, 3, 2)
    rotation_a = inverse @ robot[second]
    rotation_b = camera[first] @ camera[second].transpose(0, 1, 3, 2)
    shift = equation.robot_translation[second] - equation.robot_translation[first]
    translation_a = (inverse @ shift[..., None])[..., 0]
    board = equation.camera_translation
    translation_b = board[first] - (rotation_b @ board[second][..., None])[..., 0]
    axes_a = _sine_axes(rotation_a)
    axes_b = _sine_axes(rotation_b)
    rotations = nearest_rotation(axes_a.transpose(0, 2, 1) @ axes_b)
    system = rotation_a - np.eye(3)
    right_side = -translation_a
    rotated = translation_b @ rotations.transpose(0, 2, 1)
    scales = np.ones(len(system))
    if scale_known:
        solution = _least_squares(system, right_side + rotated)
    else:
        unit = np.sqrt((translation_b**2).mean((1, 2), keepdims=True)) + 1e-300
        system = np.concatenate([system, -(rotated / unit)[..., None]], -1)
        solution = _least_squares(system, right_side)
        scales = solution[:, 3] / unit[:, 0, 0]
    return _Hypotheses(
        rotations,
        solution[:, :3],
        scales,
    )


def _least_squares(system: Array, right_side: Array) -> Array:
    """Solve h systems (h, m, 3, k) for (h, k) unknowns, with a small ridge."""
    h = len(system)
    k = system.shape[-1]
    system = system.reshape(h, -1, k)
    transposed = system.transpose(0, 2, 1)
    normal = transposed @ system
    ridge = 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-12
    projected = transposed @ right_side.reshape(h, -1, 1)
    return np.linalg.solve(normal + ridge * np.eye(k), projected)[..., 0]


def _sine_axes(rotations: Array) -> Array:
    skew = rotations - np.swapaxes(
        rotations,
        -1,
        -2,
    )
    return np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1)


def _spread(
    rotations: Array,
    translations: Array,
) -> tuple[Array, Array, Array]:
    """Return the (h,) logarithmic spread of the better half of n boards, and their mean."""
    h, n = translations.shape[:2]
    half = min(n, (n + 4) // 2)
    rows = np.arange(h)[:, None]
    mean_rotation = nearest_rotation(np.median(rotations, 1))
    mean_translation = np.median(translations, 1)
    spread = np.zeros(h)
    for _ in range(_REFINEMENTS):
        metres2 = ((translations - mean_translation[:, None]) ** 2).sum(-1)
        metres2 += _MIN_DISTANCE**2
        chord2 = ((rotations - mean_rotation[:, None]) ** 2).sum((-1, -2))
        radians2 = chord2 / 2 + _MIN_DISTANCE**2
        # Each distance is divided by its median so that the two can be added.
        ratio = metres2 / np.median(metres2, 1, keepdims=True)
        ratio += radians2 / np.median(radians2, 1, keepdims=True)
        nearest = np.argsort(ratio, 1)[:, :half]
        mean_rotation = nearest_rotation(rotations[rows, nearest].mean(1))
        mean_translation = translations[rows, nearest].mean(1)
        spread = np.log(metres2[rows, nearest].mean(1))
        spread += np.log(radians2[rows, nearest].mean(1))
    return spread, mean_rotation, mean_translation
