"""Errors that poses share, beside a step of board or camera."""

from dataclasses import replace

from evercal.calibration.pose_pairs.fit import HandEyeFit, agreement, robust_fit
from evercal.calibration.pose_pairs.noise_levels import evidence_of_shared
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.pose_equation import PoseEquation
from evercal.calibration.pose_pairs.slips import Slip, find_slip
from evercal.robot.pose_errors import WANTED, ArmErrors, shared_errors
from evercal.typing import IntArray


def with_shared(
    pairs: PosePairs,
    rows: IntArray,
    errors: ArmErrors,
    equation: PoseEquation,
    fit: HandEyeFit,
) -> tuple[PoseEquation, HandEyeFit, Slip | None]:
    """Find a step, or take in errors that poses share: one looks like the other."""
    slip = find_slip(equation, fit, rows)
    kinds = shared_errors(pairs.base_from_gripper, errors)
    shared = {name: kind.of_rows(rows) for name, kind in kinds.items()}
    sharing = replace(equation, shared=shared)
    evidence = evidence_of_shared(sharing[fit.inliers].system(fit.at))
    if slip and slip.evidence >= evidence:
        return equation, fit, slip
    if evidence > WANTED:
        fit = robust_fit(sharing, agreement(sharing, fit.at))
        equation = sharing
    return equation, fit, None
