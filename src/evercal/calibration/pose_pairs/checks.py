"""Checks of a hand-eye fit: held-out poses, repeatability, open directions, a stated size."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.pose_pairs.fit import KINDS, HandEyeFit, agreement, refine, robust_fit
from evercal.calibration.pose_pairs.pairs import BoardCorners
from evercal.calibration.pose_pairs.pose_equation import PoseEquation, Unknowns
from evercal.geometry import pose_distance_mm_deg

Array = NDArray[np.floating]

FOLDS = 5
_MIN_HALVED = 12
_MAIN_SHARE, _ELONGATED = 0.5, 4.0
"""Share of the variance that names a cause, and ratio of deviations that names a direction."""
_SMALL_MM = 0.1
"""Standard deviation below which nothing is left open."""
_REMEDIES = {
    "intrinsics": (
        "the intrinsics, which trade against distance: tilt the board by 30 to 45 deg, vary the"
        " distance by half, fill the corners of the image, or give a known lens with --camera"
    ),
    "shared depth": (
        "a depth error that all images share: add poses that turn by 30 to 60 deg about two axes,"
        " so that the same depth points in different directions"
    ),
    "size": (
        "the size of the squares, which trades against distance: measure it over the whole board,"
        " and move the gripper by 20 cm or more between poses"
    ),
}


def held_out_error(equation: PoseEquation, fit: HandEyeFit) -> dict[str, float]:
    """Median and root mean square errors of poses predicted from the others, in five folds.

    They include the noise of the held-out pose. Empty for fewer than six poses.
    """
    rows = np.flatnonzero(fit.inliers)
    if len(rows) <= FOLDS:
        return {}
    lengths = []
    for fold in range(FOLDS):
        held_out = np.arange(len(rows)) % FOLDS == fold
        at = _refined(equation, fit, rows[~held_out])
        residual = equation[rows[held_out]].system(at).residual.reshape(-1, 2, 3)
        lengths.append(np.linalg.norm(residual, axis=2))
    error = np.concatenate(lengths) * (1000.0, 180 / np.pi)
    rms, median = np.sqrt((error**2).mean(0)), np.median(error, 0)
    names = ("held_out_mm", "held_out_deg", "held_out_rms_mm", "held_out_rms_deg")
    return dict(zip(names, (*median.tolist(), *rms.tolist()), strict=True))


def repeatability(equation: PoseEquation, fit: HandEyeFit) -> dict[str, float]:
    """Compare the calibrations from two halves of the sorted poses; empty for fewer than twelve."""
    rows = np.flatnonzero(fit.inliers)
    if len(rows) < _MIN_HALVED:
        return {}
    halves = (_refined(equation, fit, rows[half::2]).parent_from_camera for half in range(2))
    millimetres, degrees = pose_distance_mm_deg(*halves)
    return {"repeatability_mm": millimetres, "repeatability_deg": degrees}


def _refined(equation: PoseEquation, fit: HandEyeFit, rows: NDArray[np.int64]) -> Unknowns:
    use = np.zeros(len(equation), dtype=bool)
    use[rows] = True
    return refine(equation, fit.at, fit.weights, use)


def left_open(fit: HandEyeFit, parent: str) -> list[str]:
    """Return what the poses determine badly, and which poses to add; one sentence each."""
    position = fit.factor * fit.covariance[:3, :3]
    total, sentences = float(np.trace(position)), []
    if 1000 * np.sqrt(total / 3) < _SMALL_MM:
        return []
    for group, remedy in _REMEDIES.items():
        share = fit.contributions.get(group)
        if share is not None and np.trace(share[:3, :3]) > _MAIN_SHARE * np.trace(
            fit.covariance[:3, :3]
        ):
            sentences.append(f"Most of the uncertainty is due to {remedy}.")
    values, axes = np.linalg.eigh(position)
    sigma = 1000 * np.sqrt(np.maximum(values, 0))
    if sigma[2] > _ELONGATED * max(sigma[1], 1e-9):
        axis = " ".join(f"{value:+.2f}" for value in axes[:, 2])
        sentences.append(
            f"Along one direction ({axis} in the {parent} frame) the position is known only to"
            f" {sigma[2]:.2f} mm, along the others to {sigma[1]:.2f} mm: add poses that turn the"
            f" gripper by 30 deg or more about axes perpendicular to it."
        )
    return sentences


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
