"""`check` of an arm: test which offsets of joints have changed since its calibration.

The errors of two recordings are independent, so a change has the sum of their covariances.
"""

from dataclasses import replace

import numpy as np

from evercal.calibration.calibration import Calibration, JointOffset
from evercal.calibration.drift import CONFIDENCE
from evercal.errors import InputError

_LEAST = 1e-3
"""Smaller changes, radians or metres, do not count."""
_SIGMAS = 2.58
"""Beside the joint that explains most, others count from here: 99 %."""


def arm_change(
    reference: Calibration, now: Calibration
) -> tuple[float, list[str], list[JointOffset]]:
    """Compare the offsets of an arm with those of its calibration.

    Returns:
        Confidence that any joint changed, 0 to 1; names of the joints that explain it; and of each
        joint the change of its offset, which is open if one of the two offsets is.

    Raises:
        InputError: Calibrations of different arms, or no joint is determined in both.
    """
    from scipy import stats

    before = ", ".join([joint.name for joint in reference.joints])
    after = ", ".join([joint.name for joint in now.joints])
    if before != after:
        raise InputError(
            f"the reference is of joints [{before}], the recording of [{after}]: give a recording"
            " of the same arm, with its joint values"
        )
    joints = []
    determined = []
    for i, (old, new) in enumerate(zip(reference.joints, now.joints, strict=True)):
        sigma = float(np.hypot(old.sigma, new.sigma))
        offset = new.offset - old.offset
        is_open = old.open or new.open
        joints.append(replace(new, offset=offset, sigma=sigma, open=is_open))
        if not is_open:
            determined.append(i)
    if not determined:
        raise InputError(
            "no joint's offset is determined in both recordings: turn all joints more"
        )
    change = np.array([joints[i].offset for i in determined])
    sigma = np.array([joints[i].sigma for i in determined])
    covariance = reference.joint_covariance + now.joint_covariance
    weight = np.linalg.inv(covariance[np.ix_(determined, determined)])
    confidence = float(stats.chi2.cdf(change @ weight @ change, len(change)))
    # Offsets are correlated: the surprise that is gone if this joint alone has changed.
    explained = np.abs(weight @ change) / np.sqrt(np.diag(weight))
    far = (np.abs(change) > _SIGMAS * sigma) | (explained == explained.max())
    far &= (np.abs(change) > _LEAST) & (confidence >= CONFIDENCE)
    changed = np.array(determined)[far]
    return confidence, [joints[i].name for i in changed], joints
