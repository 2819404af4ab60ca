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

    names = [
        ", ".join(joint.name for joint in each.joints) for each in (reference, now)
    ]
    if names[0] != names[1]:
        other = (
            f"the reference is of joints [{names[0]}], the recording of [{names[1]}]"
        )
        raise InputError(
            f"{other}: give a recording of the same arm, with its joint values"
        )
    joints = []
    for a, b in zip(reference.joints, now.joints, strict=True):
        sigma = float(np.hypot(a.sigma, b.sigma))
        joints.append(
            replace(b, offset=b.offset - a.offset, sigma=sigma, open=a.open or b.open)
        )
    both = [i for i, joint in enumerate(joints) if not joint.open]
    if not both:
        raise InputError(
            "no joint's offset is determined in both recordings: turn all joints more"
        )
    change, sigma = np.array([(joints[i].offset, joints[i].sigma) for i in both]).T
    covariance = reference.joint_covariance + now.joint_covariance
    weight = np.linalg.inv(covariance[np.ix_(both, both)])
    confidence = float(stats.chi2.cdf(change @ weight @ change, len(change)))
    # Offsets are correlated: the surprise that is gone if this joint alone has changed.
    explained = np.abs(weight @ change) / np.sqrt(np.diag(weight))
    far = (np.abs(change) > _SIGMAS * sigma) | (explained == explained.max())
    far &= (np.abs(change) > _LEAST) & (confidence >= CONFIDENCE)
    return confidence, [joints[i].name for i in np.array(both)[far]], joints
