"""Answers as JSON values, the same on the command line and over the network."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

from evercal.classes import frozen_arrays

if TYPE_CHECKING:
    from evercal.calibration.calibration import ErrorTerm
    from evercal.calibration.drift import Shift
    from evercal.geometry import UncertainPose
    from evercal.localization.estimate import PoseEstimate
    from evercal.reports.inspected import LearnedLocalizer


@frozen_arrays
class Answer:
    """One image and its estimate."""

    path: Path
    estimate: "PoseEstimate"
    milliseconds: float
    unit_known: bool = True
    """Whether lengths are in metres; else their unit is unknown."""


def unit_known(localizer: "LearnedLocalizer", name: str | None) -> bool:
    """Whether answers in a scene are in metres; those of networks are taken to be."""
    scenes = [scene for scene in localizer.contents.scenes if scene.name == name]
    return all(getattr(scene, "metric", True) for scene in scenes)


def answer_row(answer: Answer) -> dict[str, object]:
    """The row of `evercal localize --json` for one image; null without a pose.

    Where the unit of length is unknown, lengths are in that unit and there are no millimetres.
    """
    from evercal.geometry import pose_to_dict

    estimate = answer.estimate
    pose = pose_to_dict(estimate.base_from_camera)
    uncertain = finite_pose(estimate)
    if pose is not None and estimate.base_from_camera:
        pose["matrix"] = estimate.base_from_camera.matrix().tolist()
    terms = []
    for term, share in budget_of(estimate):
        terms.append({**vars(term), "share": share})
        if not answer.unit_known:
            terms[-1]["translation_mm"] = None
    unit = None
    if pose is not None or estimate.alternatives:
        unit = "metres" if answer.unit_known else "unknown"
    covariance = None
    if uncertain:
        covariance = uncertain.covariance.tolist()
    return {
        "path": str(answer.path),
        "status": estimate.status,
        "reason": estimate.reason,
        "scene": estimate.scene,
        "base": estimate.base,
        "unit": unit,
        "parent_frame": estimate.parent_frame,
        "base_from_camera": pose,
        "alternatives": [pose_to_dict(other) for other in estimate.alternatives],
        "alternatives_in": list(estimate.alternatives_in),
        "covariance": covariance,
        "error_terms": terms,
        "inliers": int(estimate.inliers),
        "inlier_ratio": float(estimate.inlier_ratio),
        "support": float(estimate.support),
        "ms": answer.milliseconds,
    }


def finite_pose(estimate: "PoseEstimate") -> "UncertainPose | None":
    """The pose with its covariance; None without a usable one."""
    uncertain = estimate.uncertain_pose
    if not uncertain or all(map(math.isfinite, uncertain.covariance.flat)):
        return uncertain
    return None


def budget_of(estimate: "PoseEstimate") -> "list[tuple[ErrorTerm, float]]":
    """The causes of an answer's covariance, each with its share of the position's variance."""
    from evercal.calibration.calibration import ErrorTerm, position_shares

    terms = [ErrorTerm.of(term.name, term.covariance) for term in estimate.terms]
    return list(zip(terms, position_shares(terms), strict=True))


def shift_dict(shift: "Shift") -> dict[str, object]:
    """The shift of a camera as JSON values."""
    return {
        "moved": shift.moved,
        "translation_mm": shift.translation_mm,
        "rotation_deg": shift.rotation_deg,
        "sigma_mm": shift.sigma_mm,
        "sigma_deg": shift.sigma_deg,
        "confidence": shift.confidence,
        "same_map": shift.same_map,
        "note": shift.note,
        "reference_from_now": shift.reference_from_now.matrix().tolist(),
    }


def check_record(shift: "Shift") -> dict[str, object]:
    """The object of `evercal check --json`: the shift, and the images that were left out."""
    rejected = [vars(use) for use in shift.images if not use.used]
    return {**shift_dict(shift), "images": len(shift.images), "left_out": rejected}
