"""A start that outliers do not bend: many answers from three poses each, the most agreed one kept.

Nothing here depends on the order of the poses as long as the caller sorts them; samples are drawn
from a fixed seed.
"""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.pose_pairs.closed_form import motions, park, shah
from evercal.calibration.pose_pairs.pose_equation import PoseEquation, Unknowns, se3
from evercal.geometry import SE3

Array = NDArray[np.floating]

SAMPLES = 150
"""Sets of three poses; even with half of the poses wrong some 20 of them are sound."""
_SCORED = 60
"""Poses that a sample is scored on, at most."""
_FLOOR = 1e-9


def consensus_start(equation: PoseEquation) -> Unknowns:
    """The answer that the better half of the poses agrees on most.

    Args:
        equation: three poses or more; rotations about two axes.
    """
    n = len(equation)
    scored = equation[np.unique(np.linspace(0, n - 1, _SCORED).round().astype(int))]
    rotations, translations, scales = _sampled(equation, _triples(n))
    for found, scale in _from_all(scored):
        rotations = np.concatenate([rotations, found.rotation_matrix()[None]])
        translations = np.concatenate([translations, found.translation_m[None]])
        scales = np.append(scales, scale)
    cost, turn, middle = _spread(*_boards(scored, rotations, translations, scales))
    cost[~(scales > 0)] = np.inf
    best = int(np.argmin(cost))
    return Unknowns(
        np.stack([rotations[best], turn[best]]),
        np.stack([translations[best], middle[best]]),
        float(scales[best]),
    )


def _triples(n: int) -> NDArray[np.int64]:
    """(h, 3) distinct poses."""
    if n * (n - 1) * (n - 2) // 6 <= SAMPLES:
        return np.array(list(combinations(range(n), 3)))
    rng = np.random.default_rng(0)
    return np.argsort(rng.random((SAMPLES, n)), 1)[:, :3]


def _from_all(equation: PoseEquation) -> list[tuple[SE3, float]]:
    """Park's and Shah's answers from everything, the best start where there are no outliers."""
    robot = se3(equation.robot_rotation, equation.robot_translation)
    camera = se3(equation.camera_rotation, equation.camera_translation)
    world = shah(robot, camera, equation.scale_known)
    return [park(*motions(robot, camera), equation.scale_known), (world[0], world[2])]


def _sampled(equation: PoseEquation, triples: NDArray[np.int64]) -> tuple[Array, Array, Array]:
    """Park's answer for every triple: (h, 3, 3) rotations, (h, 3) translations, (h,) scales."""
    h = len(triples)
    first, second = triples[:, [0, 0, 1]], triples[:, [1, 2, 2]]
    robot, camera = equation.robot_rotation, equation.camera_rotation
    # (h, 3) motions of robot and camera between the poses of a triple.
    back = robot[first].transpose(0, 1, 3, 2)
    turn_a, turn_b = back @ robot[second], camera[first] @ camera[second].transpose(0, 1, 3, 2)
    shift = equation.robot_translation[second] - equation.robot_translation[first]
    move_a = (back @ shift[..., None])[..., 0]
    seen = equation.camera_translation
    move_b = seen[first] - (turn_b @ seen[second][..., None])[..., 0]
    rotations = _nearest(_sine_axes(turn_a).transpose(0, 2, 1) @ _sine_axes(turn_b))
    system, right_side = turn_a - np.eye(3), -move_a
    moved = move_b @ rotations.transpose(0, 2, 1)
    if equation.scale_known:
        right_side = right_side + moved
    else:
        system = np.concatenate([system, -moved[..., None]], -1)
    unknowns = system.shape[-1]
    system, right_side = system.reshape(h, 9, unknowns), right_side.reshape(h, 9, 1)
    gram = system.transpose(0, 2, 1) @ system
    ridge = 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] + 1e-12
    projected = system.transpose(0, 2, 1) @ right_side
    found = np.linalg.solve(gram + ridge * np.eye(unknowns), projected)[..., 0]
    scales = np.ones(h) if equation.scale_known else found[:, 3]
    return rotations, found[:, :3], scales


def _sine_axes(rotations: Array) -> Array:
    """(..., 3) axes times the sine of the angle."""
    skew = rotations - np.swapaxes(rotations, -1, -2)
    return np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1)


def _boards(
    equation: PoseEquation, rotations: Array, translations: Array, scales: Array
) -> tuple[Array, Array]:
    """Where each answer and each pose put the board: (h, n, 3, 3) and (h, n, 3)."""
    turned = equation.robot_rotation @ rotations[:, None]
    placed = turned @ equation.camera_rotation
    reach = (turned @ equation.camera_translation[..., None])[..., 0] * scales[:, None, None]
    base = (equation.robot_rotation @ translations[:, None, :, None])[..., 0]
    return placed, reach + base + equation.robot_translation


def _spread(rotations: Array, translations: Array) -> tuple[Array, Array, Array]:
    """(h,) how far the better half of the boards is spread, and the board in its middle."""
    h, n = translations.shape[:2]
    half = min(n, (n + 4) // 2)
    rows = np.arange(h)[:, None]
    middle, turn = np.median(translations, 1), _nearest(np.median(rotations, 1))
    kept = _closest(rotations, translations, turn, middle)[:, :half]
    for _ in range(2):
        middle = translations[rows, kept].mean(1)
        turn = _nearest(rotations[rows, kept].mean(1))
        kept = _closest(rotations, translations, turn, middle)[:, :half]
    metres2 = ((translations[rows, kept] - middle[:, None]) ** 2).sum(-1).mean(1)
    radians2 = ((rotations[rows, kept] - turn[:, None]) ** 2).sum((-1, -2)).mean(1)
    return np.log(metres2 + _FLOOR**2) + np.log(radians2 + _FLOOR**2), turn, middle


def _closest(
    rotations: Array, translations: Array, turn: Array, middle: Array
) -> NDArray[np.int64]:
    """(h, n) the boards from the one closest to the middle to the farthest."""
    metres2 = ((translations - middle[:, None]) ** 2).sum(-1)
    radians2 = ((rotations - turn[:, None]) ** 2).sum((-1, -2)) / 2
    # Both kinds in the unit of their own median, so that they may be added.
    both = metres2 / (np.median(metres2, 1, keepdims=True) + _FLOOR**2)
    return np.argsort(both + radians2 / (np.median(radians2, 1, keepdims=True) + _FLOOR**2), 1)


def _nearest(matrices: Array) -> Array:
    """(h, 3, 3) rotations nearest to matrices."""
    left, _, right = np.linalg.svd(matrices)
    left[..., -1] *= np.linalg.det(left @ right)[..., None]
    return left @ right
