"""Checks of an answer on data that it does not rest on: poses left out, and two halves."""

import numpy as np

from evercal.calibration.pose_pairs.hand_eye import HandEyeFit, refine
from evercal.calibration.pose_pairs.pose_equation import PoseEquation
from evercal.geometry import pose_distance_mm_deg

FOLDS = 5
_HALVED = 12
"""Poses from which two halves can be solved."""


def held_out_error(equation: PoseEquation, fit: HandEyeFit, noise: np.ndarray) -> dict[str, float]:
    """How far poses that were left out lie from what the others predict.

    Every fifth pose is left out in turn, and where the board lies by it is compared with where the
    other poses put it. The noise of the pose itself is part of the error.

    Args:
        equation: the poses that `fit` was made from.
        fit: the answer.
        noise: (n, 6, 6) covariance that residuals are weighted by, `fit_weights`.

    Returns:
        `held_out_mm`, `held_out_deg` (medians) and `held_out_rms_mm`, `held_out_rms_deg` (root mean
        squares); empty with fewer than six poses.
    """
    rows = np.flatnonzero(fit.inliers)
    if len(rows) <= FOLDS:
        return {}
    lengths = []
    for fold in range(FOLDS):
        use = np.zeros(len(equation), dtype=bool)
        use[rows] = np.arange(len(rows)) % FOLDS != fold
        at = refine(equation, fit.at, noise, use)
        left_out = rows[np.arange(len(rows)) % FOLDS == fold]
        residual = equation[left_out].residuals(at).reshape(-1, 2, 3)
        lengths.append(np.linalg.norm(residual, axis=2))
    error = np.concatenate(lengths) * (1000.0, 180 / np.pi)
    rms, median = np.sqrt((error**2).mean(0)), np.median(error, 0)
    return {
        "held_out_mm": float(median[0]),
        "held_out_deg": float(median[1]),
        "held_out_rms_mm": float(rms[0]),
        "held_out_rms_deg": float(rms[1]),
    }


def repeatability(equation: PoseEquation, fit: HandEyeFit, noise: np.ndarray) -> dict[str, float]:
    """By how much the answers of two halves of the poses differ.

    Args:
        equation: the poses that `fit` was made from, sorted, so that the halves cover the same.
        fit: the answer.
        noise: (n, 6, 6) covariance that residuals are weighted by, `fit_weights`.

    Returns:
        `repeatability_mm` and `repeatability_deg`; empty with fewer than twelve poses.
    """
    rows = np.flatnonzero(fit.inliers)
    if len(rows) < _HALVED:
        return {}
    answers = []
    for half in range(2):
        use = np.zeros(len(equation), dtype=bool)
        use[rows[half::2]] = True
        answers.append(refine(equation, fit.at, noise, use).parent_from_camera)
    millimetres, degrees = pose_distance_mm_deg(*answers)
    return {"repeatability_mm": millimetres, "repeatability_deg": degrees}
