"""Signs that an answer which fits may still mean something else than asked for."""

import numpy as np

from evercal.calibration.calibration import Mount
from evercal.calibration.pose_pairs.hand_eye import HandEyeFit, refine
from evercal.calibration.pose_pairs.noise_levels import normal_inverse
from evercal.calibration.pose_pairs.pose_equation import PoseEquation
from evercal.errors import InputError

Array = np.ndarray

_SURE = 6.0
"""Standard deviations."""
_SCALE_WRONG, _SCALE_ODD = 0.02, 0.005
"""Share of the scale."""
_FAR_M = 0.4


def warnings_of(
    equation: PoseEquation, fit: HandEyeFit, noise: Array, mount: Mount, is_board: bool = True
) -> list[str]:
    """Sentences about what looks odd.

    Args:
        equation: the poses of `fit`.
        fit: the answer.
        noise: (n, 6, 6) covariance of the residuals.
        mount: as given.
        is_board: whether the camera saw a board, which lies before it.

    Raises:
        InputError: The camera's lengths are clearly not the robot's.
    """
    found = []
    if equation.scale_known:
        found += _scale(equation, fit, noise)
    depth = equation.camera_translation[fit.inliers, 2]
    if is_board and equation.scale_known and (depth < 0).all():
        found.append(
            "the board lies behind the camera in every image: check that the camera poses are"
            " camera_from_board, in OpenCV's axes (z forward)"
        )
    near, far = (float(np.linalg.norm(t)) for t in fit.at.translations)
    if mount == "eye_in_hand" and equation.scale_known and near > _FAR_M and near > 2 * far:
        found.append(
            f"the camera would sit {near:.2f} m from the gripper and the board {far:.2f} m from"
            f" the base: if it is the other way round, robot and camera poses are both inverted"
        )
    if mount == "eye_to_hand" and equation.scale_known and far > _FAR_M and far > 2 * near:
        found.append(
            f"the camera would stand {near:.2f} m from the base and the board {far:.2f} m from the"
            f" gripper: if it is the other way round, robot and camera poses are both inverted"
        )
    return found


def _scale(equation: PoseEquation, fit: HandEyeFit, noise: Array) -> list[str]:
    """Whether the camera's lengths are those of the robot, as they should be."""
    free = equation.freed()
    at = refine(free, fit.at, noise, fit.inliers)
    chosen = free[fit.inliers]
    residual = chosen.residuals(at)
    jacobian = chosen.jacobian(at, residual)
    normal = (np.linalg.inv(noise[fit.inliers]) @ jacobian).reshape(-1, free.unknowns).T
    normal = normal @ jacobian.reshape(-1, free.unknowns)
    sigma = np.sqrt(normal_inverse(normal)[12, 12])
    off = np.log(at.scale)
    if abs(off) < _SURE * sigma or abs(off) < _SCALE_ODD:
        return []
    size = f"{100 * abs(1 / at.scale - 1):.1f} % too {'long' if off < 0 else 'short'}"
    advice = "check the size of the board's squares or of the tag, and the focal length"
    if abs(off) > _SCALE_WRONG:
        raise InputError(
            f"the camera's lengths are {size} for the robot's; {advice}; or say --scale unknown"
        )
    return [f"the camera's lengths are {size} for the robot's; {advice}"]
