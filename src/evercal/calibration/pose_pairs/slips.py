"""Errors that depend on time: a camera, a board or an object that slipped during a recording.

After every row, a step of `parent_from_camera` or of `fixed_from_board` is tested: by how much do
the residuals fall if one of them changes there? Interleaved halves of such a recording agree, so
no other check notices it.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.stats import f

from evercal.calibration.pose_pairs.fit import HandEyeFit, normal_inverse
from evercal.calibration.pose_pairs.pose_equation import PoseEquation
from evercal.typing import Array, BoolArray, IntArray

_FEWEST = 2
"""Minimum number of poses before and after a slip; a single one is an outlier."""
_GROSS = 30.0
"""Largest squared distance of a pose; an outlier counts as much, wherever it is."""
_FALSE_ALARM = 1e-4
"""Probability of a step in a recording with independent errors. Slow errors of an arm look alike
and mean the same: the poses of another hour would give another answer."""
_CLEARLY = 9.2
"""Twice the logarithm of the likelihood ratio, 100, at which the camera moved or the board."""


class Slip(NamedTuple):
    """A step of the camera or of the board."""

    row: int
    """First row after the step, an index of the pose pairs."""
    what: str
    """`camera` if `parent_from_camera` changed, `board` if `fixed_from_board` did, or either."""
    metres: float
    radians: float
    spread: Array
    """(p, p) to add to the covariance of the unknowns: they differ before and after the step."""


def find_slip(equation: PoseEquation, fit: HandEyeFit, rows: IntArray) -> Slip | None:
    """Return the step that explains the residuals best, if noise would not be explained as well.

    Args:
        equation: The n poses.
        fit: Their fit without a step.
        rows: (n,) indices of the pose pairs, which are in the order of time.
    """
    order = np.argsort(rows)
    every = np.ones(len(order), dtype=bool)
    found = [
        s
        for use in (every, fit.inliers[order])
        for s in _steps(equation, fit, order, use)
    ]
    before = min(cost for cost, k, *_ in found if k == 0)
    kinds = [
        min((s for s in found if s[2] == first), key=lambda s: s[0]) for first in (0, 6)
    ]
    after, k, first, change, covariance = min(kinds, key=lambda s: s[0])
    # All other unknowns have priors.
    freedom = 6 * len(order) - 18
    ratio = (before / after - 1) * freedom / 6
    if freedom < 6 or 2 * len(order) * f.sf(ratio, 6, freedom) > _FALSE_ALARM:
        return None
    what = "camera or board"
    if abs(freedom * np.log(kinds[0][0] / kinds[1][0])) > _CLEARLY:
        what = "board" if first else "camera"
    metres, radians = np.linalg.norm(change[-6:].reshape(2, 3), axis=1)
    second = np.outer(change, change) + covariance
    before_it = np.eye(equation.unknowns, len(change))
    after_it = before_it.copy()
    after_it[first : first + 6, -6:] = np.eye(6)
    spread = (before_it @ second @ before_it.T + after_it @ second @ after_it.T) / 2
    return Slip(int(rows[order[k]]), what, float(metres), float(radians), spread)


def _steps(
    equation: PoseEquation, fit: HandEyeFit, order: IntArray, use: BoolArray
) -> Iterator[tuple[float, int, int, Array, Array]]:
    """Fit each step: squared residuals, row and kind, change of the unknowns and its covariance.

    The last six unknowns are the step; row 0 means no step. The poses `use` estimate it, but all
    judge it. Errors of an arm that grow with its position are no step: they are unknowns as large
    as the noise, over the root mean square of the positions.
    """
    system = equation[order].system(fit.at)
    whiten = np.linalg.inv(np.linalg.cholesky(fit.weights[order]))
    residual = (whiten @ system.residual[..., None])[..., 0]
    place = equation.robot_translation[order] - equation.robot_translation.mean(0)
    place /= max(float(np.sqrt((place**2).sum(1).mean())), 1e-9)
    by_place = whiten @ np.linalg.cholesky(fit.weights.mean(0))
    by_place = [by_place * place[:, k, None, None] for k in range(3)]
    jacobian = np.concatenate([whiten @ system.jacobian, *by_place], 2)
    used = jacobian.transpose(0, 2, 1) * use[:, None, None]
    normal = (used @ jacobian).sum(0) + block_diag(system.prior, np.eye(18))
    pull = np.r_[system.prior @ system.change, np.zeros(18)]
    gradient = (used @ residual[..., None]).sum((0, 2)) + pull
    for moved in (residual, residual - jacobian @ (normal_inverse(normal) @ gradient)):
        yield _cost(moved), 0, 0, gradient, normal
    for first in (0, 6):
        own = slice(first, first + 6)
        # Sums over the poses from each on.
        shared = np.cumsum((used @ jacobian[:, :, own])[::-1], 0)[::-1]
        pull = np.cumsum((used[:, own] @ residual[..., None])[::-1, :, 0], 0)[::-1]
        for k in range(_FEWEST, len(order) - _FEWEST + 1):
            both = np.block([[normal, shared[k]], [shared[k].T, shared[k, own]]])
            covariance = normal_inverse(both)
            change = -covariance @ np.r_[gradient, pull[k]]
            moved = residual + jacobian @ change[:-6]
            moved[k:] += jacobian[k:, :, own] @ change[-6:]
            yield _cost(moved), k, first, change, covariance


def _cost(residual: Array) -> float:
    return float(np.minimum((residual**2).sum(1), _GROSS).sum())
