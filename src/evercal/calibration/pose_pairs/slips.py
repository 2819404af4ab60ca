"""Errors that depend on time: a camera, a board or an object that slipped during a recording.

After every row, a step of `parent_from_camera` or of `fixed_from_board` is tested: by how much do
the residuals fall if one of them changes there? Interleaved halves of such a recording agree, so
no other check notices it.
"""

from typing import NamedTuple

import numpy as np
from scipy.stats import f

from evercal.calibration.pose_pairs.fit import HandEyeFit
from evercal.calibration.pose_pairs.noise_levels import Noise, clipped_inverse
from evercal.calibration.pose_pairs.pose_equation import PoseEquation
from evercal.geometry import norms
from evercal.typing import Array, BoolArray, IntArray

_MIN_POSES = 2
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
    """Length of its translation."""
    radians: float
    """Angle of its rotation."""
    spread: Array
    """(p, p) to add to the covariance of the unknowns: they differ before and after the step."""
    evidence: float
    """Logarithm of the likelihood ratio to no step, less the number of its parameters."""


_FIRST_UNKNOWN = {"camera": 0, "board": 6}
"""Index of the first of the six unknowns of each pose that may slip."""


class _Step(NamedTuple):
    """A fit with a step of the camera or of the board, or without."""

    cost: float
    """Sum of squared residuals."""
    what: str = ""
    """Key of `_FIRST_UNKNOWN`; empty without a step."""
    place: int = 0
    """Number of poses before the step."""
    change: Array = np.zeros(0)
    """Change of the unknowns; the last six are the step."""
    covariance: Array = np.zeros((0, 0))
    """Its covariance."""


def find_slip(
    equation: PoseEquation,
    fit: HandEyeFit,
    rows: IntArray,
) -> Slip | None:
    """Return the step that explains the residuals best, if noise would not be explained as well.

    Args:
        equation: The n poses.
        fit: Their fit without a step.
        rows: (n,) indices of the pose pairs, which are in the order of time.
    """
    order = np.argsort(rows)
    steps = _steps(
        equation,
        fit,
        order,
        np.ones(len(order), bool),
    )
    steps += _steps(
        equation,
        fit,
        order,
        fit.inliers[order],
    )
    best = {}
    for step in sorted(steps, key=lambda step: step.cost):
        best.setdefault(step.what, step)
    camera = best["camera"]
    board = best["board"]
    step = min(camera, board, key=lambda step: step.cost)
    # All other unknowns have priors.
    freedom = 6 * len(order) - 18
    ratio = (best[""].cost / step.cost - 1) * freedom / 6
    if freedom < 6 or 2 * len(order) * f.sf(ratio, 6, freedom) > _FALSE_ALARM:
        return None
    what = "camera or board"
    if abs(freedom * np.log(camera.cost / board.cost)) > _CLEARLY:
        what = step.what
    metres, radians = norms(step.change[-6:].reshape(2, 3))
    second = np.outer(step.change, step.change) + step.covariance
    before = np.eye(equation.unknowns, len(step.change))
    after = before.copy()
    first = _FIRST_UNKNOWN[step.what]
    after[first : first + 6, -6:] = np.eye(6)
    spread = (before @ second @ before.T + after @ second @ after.T) / 2
    row = int(rows[order[step.place]])
    return Slip(
        row,
        what,
        float(metres),
        float(radians),
        spread,
        float(freedom / 2 * np.log(best[""].cost / step.cost) - 6),
    )


def _steps(
    equation: PoseEquation, fit: HandEyeFit, order: IntArray, use: BoolArray
) -> list[_Step]:
    """Fit each step, and none; the poses `use` estimate it, but all judge it."""
    system = equation[order].system(fit.at)
    covariance = Noise(system, fit.levels).independent
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    residual = (whiten @ system.residual[..., None])[..., 0]
    jacobian = whiten @ system.jacobian
    used = jacobian.transpose(0, 2, 1) * use[:, None, None]
    normal = (used @ jacobian).sum(0) + system.prior
    gradient = (used @ residual[..., None]).sum((0, 2)) + system.prior @ system.change
    refined = residual - jacobian @ (clipped_inverse(normal) @ gradient)
    steps = [_Step(_cost(residual)), _Step(_cost(refined))]
    for what, first in _FIRST_UNKNOWN.items():
        unknowns = slice(first, first + 6)
        by_step = jacobian[:, :, unknowns]
        # Sums over the poses from each on.
        shared = np.cumsum((used @ by_step)[::-1], 0)[::-1]
        pulls = (used[:, unknowns] @ residual[..., None])[::-1, :, 0]
        pulls = np.cumsum(pulls, 0)[::-1]
        for k in range(_MIN_POSES, len(order) - _MIN_POSES + 1):
            block = shared[k]
            whole = np.block([[normal, block], [block.T, block[unknowns]]])
            covariance = clipped_inverse(whole)
            change = -covariance @ np.r_[gradient, pulls[k]]
            moved = residual + jacobian @ change[:-6]
            moved[k:] += by_step[k:] @ change[-6:]
            steps.append(
                _Step(
                    _cost(moved),
                    what,
                    k,
                    change,
                    covariance,
                )
            )
    return steps


def _cost(residual: Array) -> float:
    """Sum of squared distances (n, 6); gross ones count `_GROSS`."""
    return float(np.minimum((residual**2).sum(1), _GROSS).sum())
