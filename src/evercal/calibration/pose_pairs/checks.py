"""Checks of a hand-eye fit: held-out poses, repeatability, and what the poses leave open."""

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.pose_pairs.fit import HandEyeFit, refine
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
