"""Errors that depend on time: a camera, a board or an object that slipped during a recording.

After every row, a step of `parent_from_camera` or of `fixed_from_board` is tested: by how much do
the residuals fall if one of them changes there? Interleaved halves of such a recording agree, so
no other check notices it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f

from evercal.calibration.pose_pairs.fit import Array, HandEyeFit, Mask, normal_inverse
from evercal.calibration.pose_pairs.pose_equation import PoseEquation

_FEWEST = 2
"""Minimum number of poses before and after a slip; a single one is an outlier."""
_GROSS = 30.0
"""Largest squared distance of a pose; an outlier counts as much, wherever it is."""
_FALSE_ALARM = 1e-4
"""Probability of a step in a recording with independent errors. Slow errors of an arm look alike
and mean the same: the poses of another hour would give another answer."""


class Slip(NamedTuple):
    """A step of the camera or of the board."""

    row: int
    """First row after the step, an index of the pose pairs."""
    of_camera: bool
    """Whether `parent_from_camera` changed, else `fixed_from_board`."""
    metres: float
    radians: float
    spread: Array
    """(p, p) to add to the covariance of the unknowns: they differ before and after the step."""


def find_slip(equation: PoseEquation, fit: HandEyeFit, rows: NDArray[np.int64]) -> Slip | None:
    """Return the step that explains the residuals best, if noise would not be explained as well.

    Args:
        equation: The n poses.
        fit: Their fit without a step.
        rows: (n,) indices of the pose pairs, which are in the order of time.
    """
    order = np.argsort(rows)
    every = np.ones(len(order), dtype=bool)
    steps = [_best_step(equation, fit, order, use) for use in (every, fit.inliers[order])]
    explained, k, first, change, covariance = max(steps, key=lambda found: found[0])
    freedom = 6 * len(order) - equation.unknowns - 6
    if freedom < 6:
        return None
    ratio = explained / (1 - explained) * freedom / 6
    if 2 * len(order) * f.sf(ratio, 6, freedom) > _FALSE_ALARM:
        return None
    metres, radians = np.linalg.norm(change[-6:].reshape(2, 3), axis=1)
    second = np.outer(change, change) + covariance
    before = np.eye(equation.unknowns, len(change))
    after = before.copy()
    after[first : first + 6, -6:] = np.eye(6)
    spread = (before @ second @ before.T + after @ second @ after.T) / 2
    return Slip(int(rows[order[k]]), first == 0, float(metres), float(radians), spread)


def _best_step(
    equation: PoseEquation, fit: HandEyeFit, order: NDArray[np.int64], use: Mask
) -> tuple[float, int, int, Array, Array]:
    """Return the share of squared residuals that the best step explains, its place and kind.

    Also return the change (p + 6,) of the unknowns and the step itself, with its covariance.

    Only the poses `use` estimate the step, but all of them judge it.
    """
    system = equation[order].system(fit.at)
    whiten = np.linalg.inv(np.linalg.cholesky(fit.weights[order]))
    residual = (whiten @ system.residual[..., None])[..., 0]
    jacobian = whiten @ system.jacobian
    used = jacobian.transpose(0, 2, 1) * use[:, None, None]
    normal = (used @ jacobian).sum(0) + system.prior
    gradient = (used @ residual[..., None]).sum((0, 2)) + system.prior @ system.change
    before = np.minimum((residual**2).sum(1), _GROSS).sum()
    best = 0.0, 0, 0, np.zeros(0), np.zeros((0, 0))
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
            after = np.minimum((moved**2).sum(1), _GROSS).sum()
            if after < (1 - best[0]) * before:
                best = 1 - after / before, k, first, change, covariance
    return best
