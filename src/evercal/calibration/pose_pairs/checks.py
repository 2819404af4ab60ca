"""Checks of a hand-eye fit: held-out poses, repeatability and plausibility."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.calibration import Mount
from evercal.calibration.pose_pairs.hand_eye import HandEyeFit, refine
from evercal.calibration.pose_pairs.noise_levels import normal_inverse
from evercal.calibration.pose_pairs.pose_equation import PoseEquation
from evercal.errors import InputError
from evercal.geometry import pose_distance_mm_deg

Array = NDArray[np.floating]

FOLDS = 5
_MIN_HALVED = 12
"""Minimum number of poses to compare two halves."""
_SCALE_SIGMAS = 6.0
"""Significance of a scale error, standard deviations."""
_SCALE_ERROR, _SCALE_WARNING = 0.02, 0.005
"""Relative errors of the scale."""
_FAR_M = 0.4


def held_out_error(equation: PoseEquation, fit: HandEyeFit, noise: Array) -> dict[str, float]:
    """Compare each pose with the prediction from the other poses, by 5-fold cross-validation.

    The error includes the noise of the held-out pose. `noise` are the `fit_weights`.

    Returns:
        `held_out_mm`, `held_out_deg` (medians) and `held_out_rms_mm`, `held_out_rms_deg` (root mean
        squares); empty for fewer than six poses.
    """
    rows = np.flatnonzero(fit.inliers)
    if len(rows) <= FOLDS:
        return {}
    lengths = []
    for fold in range(FOLDS):
        held_out = np.arange(len(rows)) % FOLDS == fold
        use = np.zeros(len(equation), dtype=bool)
        use[rows] = ~held_out
        at = refine(equation, fit.at, noise, use)
        residual = equation[rows[held_out]].residuals(at).reshape(-1, 2, 3)
        lengths.append(np.linalg.norm(residual, axis=2))
    error = np.concatenate(lengths) * (1000.0, 180 / np.pi)
    rms, median = np.sqrt((error**2).mean(0)), np.median(error, 0)
    names = ("held_out_mm", "held_out_deg", "held_out_rms_mm", "held_out_rms_deg")
    return dict(zip(names, (*median.tolist(), *rms.tolist()), strict=True))


def repeatability(equation: PoseEquation, fit: HandEyeFit, noise: Array) -> dict[str, float]:
    """Compare the calibrations from two halves of the sorted poses.

    Returns:
        `repeatability_mm` and `repeatability_deg`; empty for fewer than twelve poses.
    """
    rows = np.flatnonzero(fit.inliers)
    if len(rows) < _MIN_HALVED:
        return {}
    halves = []
    for half in range(2):
        use = np.zeros(len(equation), dtype=bool)
        use[rows[half::2]] = True
        halves.append(refine(equation, fit.at, noise, use).parent_from_camera)
    millimetres, degrees = pose_distance_mm_deg(*halves)
    return {"repeatability_mm": millimetres, "repeatability_deg": degrees}


def plausibility_warnings(
    equation: PoseEquation, fit: HandEyeFit, noise: Array, mount: Mount
) -> list[str]:
    """Return warnings about a fit that is consistent but implausible.

    Raises:
        InputError: Camera and robot clearly use different units of length.
    """
    if not equation.scale_known:
        return []
    warnings = _scale_warnings(equation, fit, noise)
    if (equation.camera_translation[fit.inliers, 2] < 0).all():
        warnings.append(
            "the board is behind the camera in every image: check that the camera poses are"
            " camera_from_board, with OpenCV's axes (z forward)"
        )
    camera, board = (float(np.linalg.norm(t)) for t in fit.at.translations)
    if mount == "eye_in_hand" and camera > _FAR_M and camera > 2 * board:
        warnings.append(
            f"the camera is {camera:.2f} m from the gripper and the board {board:.2f} m from the"
            f" base: if these should be swapped, both robot and camera poses are inverted"
        )
    if mount == "eye_to_hand" and board > _FAR_M and board > 2 * camera:
        warnings.append(
            f"the camera is {camera:.2f} m from the base and the board {board:.2f} m from the"
            f" gripper: if these should be swapped, both robot and camera poses are inverted"
        )
    return warnings


def _scale_warnings(equation: PoseEquation, fit: HandEyeFit, noise: Array) -> list[str]:
    """Estimate the scale between camera and robot, which should be 1."""
    free = replace(equation, scale_known=False)
    at = refine(free, fit.at, noise, fit.inliers)
    selected = free[fit.inliers]
    jacobian = selected.jacobian(at, selected.residuals(at))
    normal = (np.linalg.inv(noise[fit.inliers]) @ jacobian).reshape(-1, free.unknowns).T
    normal = normal @ jacobian.reshape(-1, free.unknowns)
    sigma = np.sqrt(normal_inverse(normal)[12, 12])
    log_scale = np.log(at.scale)
    if abs(log_scale) < _SCALE_SIGMAS * sigma or abs(log_scale) < _SCALE_WARNING:
        return []
    error = f"{100 * abs(1 / at.scale - 1):.1f} % too {'long' if log_scale < 0 else 'short'}"
    advice = "check the size of the board's squares or of the tag, and the focal length"
    if abs(log_scale) > _SCALE_ERROR:
        raise InputError(
            f"lengths from the camera are {error} compared with the robot; {advice};"
            f" or estimate the scale with --scale unknown"
        )
    return [f"lengths from the camera are {error} compared with the robot; {advice}"]
