"""Test a stated size of the squares, or scale, against the motions of the robot."""

from dataclasses import replace

import numpy as np

from evercal.calibration.pose_pairs.fit import KINDS, HandEyeFit, agreement, robust_fit
from evercal.calibration.pose_pairs.measured import BoardCorners
from evercal.calibration.pose_pairs.pose_equation import PoseEquation

SIZE_SIGMA = 0.002
"""Relative standard deviation of a stated square size, and of a depth error of all images."""
_SIZE_SIGMAS = 3.0
"""Significance of a wrong size, standard deviations."""
_LARGE_SIZE, _MUCH_BETTER = 0.1, 3.0
"""An error above the first is believed only if the residuals fall by the second factor."""


def with_tested_size(
    equation: PoseEquation, fit: HandEyeFit, corners: BoardCorners | None, of_board: bool = True
) -> tuple[PoseEquation, HandEyeFit, list[str]]:
    """Free the size of the squares, or of a map, if the robot's motions contradict it."""
    # A wrong size looks like noise, so the noise is estimated again with the free size.
    free = replace(equation, extras=equation.extras.without_prior("size"))
    freed = robust_fit(free, agreement(free, fit.at))
    k = equation.extras.names.index("size")
    off, sigma = float(freed.at.extras[k]), float(freed.sigma[12 + k])
    sigma *= float(np.sqrt(1 + _alike(freed)))
    if abs(off) < max(_SIZE_SIGMAS * sigma, SIZE_SIGMA):
        return equation, fit, []
    what, larger = "board" if of_board else "map", "larger" if off > 0 else "smaller"
    if abs(off) > _LARGE_SIZE and _misfit(fit) < _MUCH_BETTER * _misfit(freed):
        warning = (
            f"a {100 * abs(off):.0f} % {larger} {what} improves the fit but does not explain the"
            f" residuals: check its size, the robot poses and the intrinsics"
        )
        return equation, fit, [warning]
    evidence = f"by the robot's motions ({abs(off) / sigma:.0f} standard deviations)"
    if not of_board:
        warning = (
            f"the lengths of the map are {100 * abs(off):.2f} +- {100 * sigma:.2f} % too"
            f" {'short' if off > 0 else 'long'}, {evidence}: the estimated scale is used"
        )
        return free, freed, [warning]
    size = f"a square or tag of 24 mm would measure {24 * (1 + off):.2f} mm"
    if corners is not None and corners.size_m is not None:
        stated = 1000 * corners.size_m
        size = f"its side measures {stated * (1 + off):.2f} mm, not {stated:.2f} mm"
    warning = (
        f"the board is {100 * abs(off):.2f} +- {100 * sigma:.2f} % {larger} than stated,"
        f" {evidence}: {size}; check its size and the focal length. The calibration uses the"
        f" estimated size"
    )
    return free, freed, [warning]


def _alike(fit: HandEyeFit) -> float:
    """Return by how much errors that are alike in similar poses enlarge the variance of the size.

    Together as large as the noise, they move the size as much as all poses with independent noise.
    """
    noise = sum(
        np.trace(fit.contributions[kind][:3, :3]) for kind in KINDS if kind in fit.contributions
    )
    return float(noise / np.trace(fit.covariance[:3, :3]) * fit.inliers.sum())


def widened(equation: PoseEquation, fit: HandEyeFit) -> HandEyeFit:
    """Add what errors of an arm that are alike in similar poses do through an unknown size."""
    k = 12 + equation.extras.names.index("size")
    # Divided before the product, which overflows where the size is open.
    column = fit.covariance[:, k] / np.sqrt(max(fit.covariance[k, k], 1e-300))
    added = _alike(fit) * np.outer(column, column)
    return replace(fit, covariance=fit.covariance + added)


def _misfit(fit: HandEyeFit) -> float:
    return float(np.sqrt((fit.residual[fit.inliers, :3] ** 2).mean()))
