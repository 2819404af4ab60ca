"""What data say about the error of a calibration, as a linear Gaussian model.

A prediction of the data is differentiated by all that errs: the calibration, the intrinsics, the
gripper poses, and what else the data depend on.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from evercal.calibration.framed_pose import FramedPose
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.robot.pose_errors import ArmErrors, shared_errors
from evercal.typing import Array

_STEP = 1e-6
"""Step of numerical derivatives."""
_USUAL = (0.2, 0.04)
"""Usual scatter of gripper poses, millimetres and degrees."""
_MOST_OFF_M = 0.15
"""Median miss above which the input is wrong rather than the calibration."""


class Evidence(NamedTuple):
    """Residuals: slope @ error + lens @ error of the lens + arm @ errors of the arm + noise."""

    residual: Array
    """(n,) measured less predicted values."""
    slope: Array
    """(n, 6) by the error of the calibration, as in `Calibration.covariance`."""
    lens: Array
    """(n, 3) by the logarithm of the focal lengths, and the principal point in pixels."""
    arm: Array
    """(n, r) by independent effects of joint offsets of their usual size."""
    noise: Array
    """(n, n) covariance of all other errors."""


class Data(NamedTuple):
    """Data that a calibration predicts."""

    what: str
    """In words."""
    predict: Callable[[SE3, Array, SE3, Array], Array]
    """(n,) predicted less measured values, by the pose of the calibration, the change (3,) of the
    intrinsics, the gripper poses (k,) and other errors (q,)."""
    grippers: SE3
    """(k,) base_from_gripper."""
    gripper_sigma: Array
    """(k, 6) standard deviations of their independent errors, in the axes of the gripper."""
    other: Array
    """(q, q) covariance of the other errors."""
    own: Array
    """(n,) standard deviations of the measured values."""
    places: Array
    """(m, 3) where the data lie in the camera frame, metres."""
    reach_m: float
    """Largest distance of these places from the robot's base."""
    misses_m: Mapping[str, float]
    """Distance of each measured place from its prediction, by its name."""
    free: int = 0
    """Number of values that only tell unknown constants."""

    def evidence(self, calibrated: SE3, errors: ArmErrors | None = None) -> Evidence:
        """The linear model of these data; InputError if they are far from what is predicted."""
        miss = np.median([*self.misses_m.values()])
        if not miss < _MOST_OFF_M:
            raise InputError(
                f"the calibration misses these data by {miss:.2g} m: are points in the base frame"
                " in metres, the poses base_from_gripper and not the inverse, and the images and"
                " the calibration of one camera?"
            )
        k = len(self.grippers)
        parts = (6, 9, 9 + 6 * k)

        def predicted(change: Array) -> Array:
            own, lens, by_gripper, other = np.split(change, parts)
            moved = self.grippers @ SE3.exp(by_gripper.reshape(k, 6))
            return self.predict(plus(calibrated, own), lens, moved, other)

        steps = _STEP * np.eye(parts[2] + len(self.other))
        columns = [predicted(step) - predicted(-step) for step in steps]
        slopes = np.stack(columns, 1) / (2 * _STEP)
        slope, lens, by_gripper, by_other = np.split(slopes, parts, 1)
        arm = by_gripper[:, :0]
        if self.gripper_sigma.any():
            kinds = shared_errors(self.grippers, errors or ArmErrors())
            joints = kinds["joint offsets"]
            arm = by_gripper @ (joints.usual * joints.slopes).reshape(6 * k, -1)
        scattered = by_gripper * self.gripper_sigma.ravel()
        noise = scattered @ scattered.T + by_other @ self.other @ by_other.T
        return Evidence(
            -predicted(0 * steps[0]),
            slope,
            lens,
            arm,
            noise + np.diag(self.own**2),
        )


def gripper_sigma(calibration: FramedPose) -> Array:
    """(6,) standard deviations of single gripper poses, by the images of the calibration."""
    rows = [(i.residual_mm, i.residual_deg) for i in calibration.images if i.used]
    sizes = np.array([_USUAL, *rows], float) / [1000, 180 / np.pi]
    return np.repeat(np.sqrt(np.nanmean(sizes**2, 0) / 3), 3)


def plus(pose: SE3, error: Array) -> SE3:
    """Poses with errors (..., 6) as in `Calibration.covariance`."""
    turn = SE3.exp(error * [0, 0, 0, 1, 1, 1])
    return SE3.from_translation(error[..., :3]) @ pose @ turn
