"""Rejected rows that agree among themselves: the board, the base or the camera moved."""

from collections.abc import Sequence

import numpy as np

from evercal.calibration.pose_pairs.fit import HandEyeFit
from evercal.calibration.pose_pairs.pose_equation import PoseEquation
from evercal.geometry import length_mm_deg, norms
from evercal.typing import IntArray

_LEAST_ROWS = 3
"""Minimum number of rejected rows that agree."""
_AGREEING = 0.3
"""Largest scatter of rows that agree, relative to their distance from the others."""


def second_group(
    equation: PoseEquation,
    fit: HandEyeFit,
    rows: IntArray,
    names: Sequence[str],
) -> list[str]:
    """Return a warning where rejected rows agree on another pose of the board or of the camera.

    `rows` (n,) are the rows of the equation in the order of `names`.
    """
    rejected = np.flatnonzero(~fit.inliers)
    if len(rejected) < _LEAST_ROWS:
        return []
    noise = np.sqrt((fit.residual[fit.inliers] ** 2).mean(0)) + 1e-9
    away = fit.residual[rejected].reshape(-1, 2, 3)
    parent_from_fixed = equation.robot_rotation[rejected].transpose(0, 2, 1)
    best = _AGREEING
    warnings = []
    for what, residual in (
        ("the board or the base of the robot", away),
        ("the camera, or what the gripper holds,", away @ parent_from_fixed.mT),
    ):
        each = residual.reshape(-1, 6)
        middle = np.median(each, 0)
        apart = norms((each - middle) / noise)
        scatter = float(np.median(apart) / np.linalg.norm(middle / noise))
        if scatter < best:
            best = scatter
            mm, deg = length_mm_deg(middle)
            order = np.sort(rows[rejected])
            warnings = [
                f"{len(rejected)} rejected rows, {names[order[0]]} to {names[order[-1]]}, agree"
                f" among themselves: {what} moved by {mm:.1f} mm and {deg:.2f} deg; they are a"
                " second group and no outliers. Calibrate them apart, or record again"
            ]
    return warnings
