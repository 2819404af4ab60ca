"""From a fit of an arm to its `Calibration`: covariance, offsets, checks, and what is wrong."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from evercal.calibration.arm_in_view.covariance import (
    SCATTER,
    covariance_of,
    halves,
    in_base,
    parts,
)
from evercal.calibration.arm_in_view.equations import FOCAL, JOINTS, LENS, POSE, ArmFit
from evercal.calibration.arm_in_view.fit import Fitter
from evercal.calibration.calibration import Calibration, ErrorTerm
from evercal.calibration.checks import Checks
from evercal.calibration.framed_pose import ImageUse, JointOffset
from evercal.calibration.from_map.hand_eye import verdict_of
from evercal.calibration.held_thing.background import motion_of_still
from evercal.calibration.held_thing.slip import MOVED_DEG, drift_deg_of
from evercal.errors import InputError
from evercal.geometry import length_mm_deg
from evercal.recordings.frame import Frame
from evercal.robot.frame_names import FrameNames
from evercal.typing import Array

LEAST_CONFIRMED = 0.2
"""Least share of the outline that the images show at the right pose."""
DOUBTFUL_CONFIRMED = 0.3
"""Below it, there is a warning."""
MOST_SCATTER = 1 / 640
"""Standard deviation of the outlines from which there is a warning, in long sides of the image;
right answers have 0.3 to 0.7 of it."""
REFUSED_DEG = 0.25
"""Motion of the background from which a recording is refused: 7 mm at 1.6 m."""
MESHES_RAD = 5e-4
"""Standard deviation of joint offsets by meshes that are not quite the arm."""
MOST_FOCAL = 0.015
"""Change of the focal length above which the intrinsics are doubtful."""
_HALVES_D2 = 12.6
"""Squared distance of the halves above which the covariance is too small: 95 % are below."""
_LINK_SHOWN = 0.4
"""Least share of the outline of a link, of that of all links."""
_LINK_POINTS = 40
"""Least number of its points."""


def calibration_of(
    fit: ArmFit, fitter: Fitter, frames: Sequence[Frame], names: FrameNames
) -> Calibration:
    """The calibration of a camera whose frames (n,) were fitted."""
    whole = parts(fit)
    covariance = covariance_of(whole)
    of_pose = in_base(fit, covariance)
    terms = [
        ErrorTerm.of(name, in_base(fit, part), cause)
        for name, (part, cause) in whole.items()
    ]
    for name, added in _turns_of_base(fit, fitter).items():
        of_pose = of_pose + added
        terms.append(ErrorTerm.of(f"offset of joint {name}", added, "arm"))
    apart = halves(fit)
    # Halves differ by twice the error of the whole.
    scatter = whole[SCATTER][0][POSE, POSE]
    d2 = apart @ np.linalg.pinv(4 * scatter) @ apart
    if d2 > _HALVES_D2:
        added = of_pose * (d2 / _HALVES_D2 - 1)
        of_pose = of_pose + added
        terms.append(ErrorTerm.of("distance of halves of the images", added, "images"))
    stated = frames[0].camera
    estimated = stated.changed(fit.estimate.parameters[LENS])
    warnings = warnings_of(fit, fitter)
    of_joints = covariance[JOINTS:, JOINTS:] + MESHES_RAD**2 * np.eye(
        len(fit.estimate.offsets)
    )
    calibration = Calibration(
        "eye_to_hand",
        fit.estimate.camera_from_base.inverse(),
        of_pose,
        frames=names,
        camera=estimated,
        lenses={"stated": stated, "estimated": estimated},
        images=_uses(fit, frames),
        error_terms=tuple(terms),
        checks=_checks(fit, apart, warnings),
        joints=_joints(fit, fitter, of_joints),
        joint_covariance=of_joints,
        source={
            "command": "arm-in-view",
            "frames": len(frames),
            "links_not_shown": links_not_shown(fit, fitter),
        },
    )
    return replace(calibration, verdict=verdict_of(calibration, warnings, ""))


def _turns_of_base(fit: ArmFit, fitter: Fitter) -> dict[str, Array]:
    """Covariances (6, 6) by the joints that turn the arm as a whole, and so no image shows."""
    base_from_camera = fit.estimate.camera_from_base.inverse()
    rotation = base_from_camera.rotation_matrix()
    found = {}
    for arm in fitter.views.body.arms:
        if not arm.chain:
            continue
        joint = arm.chain[0]
        sigma = fit.priors.size * fit.priors.usual.max()
        axis = joint.before[:3, :3] @ joint.axis
        lever = base_from_camera.translation_m - joint.before[:3, 3]
        motion = np.concatenate([np.cross(axis, lever), axis @ rotation])
        if not joint.rotates:
            motion = np.concatenate([axis, np.zeros(3)])
        found[arm.joints[joint.value]] = np.outer(motion, motion) * sigma**2
    return found


def _uses(fit: ArmFit, frames: Sequence[Frame]) -> tuple[ImageUse, ...]:
    uses = []
    equations = fit.equations
    for i, frame in enumerate(frames):
        rows = equations.image == i
        name = frame.name
        if not rows.any():
            uses.append(ImageUse(name, False, "its outlines are not those of the arm"))
            continue
        px = float(np.median(np.abs(equations.px[rows])))
        uses.append(ImageUse(name, True, "", px * _mm_per_px(fit)))
    return tuple(uses)


def _mm_per_px(fit: ArmFit) -> float:
    """Millimetres at the arm that a pixel of the outline is."""
    across = fit.equations.slopes[:, :2]
    return 1000 / float(np.median(np.linalg.norm(across, axis=1)))


def _checks(fit: ArmFit, apart: Array, warnings: Sequence[str]) -> Checks:
    mm, deg = length_mm_deg(apart)
    return Checks(
        images_given=len(fit.equations.testable),
        repeatability_mm=mm,
        repeatability_deg=deg,
        outline_confirmed=fit.confirmed,
        outline_sigma_px=fit.scale_px,
        warnings=warnings,
    )


def _joints(fit: ArmFit, fitter: Fitter, covariance: Array) -> tuple[JointOffset, ...]:
    body = fitter.views.body
    rotates = {}
    for arm in body.arms:
        rotates |= dict(zip(arm.joints, arm.rotates().tolist(), strict=True))
    rows = []
    for k, name in enumerate(body.joints):
        why = ""
        prior = fit.priors.sigma()[JOINTS + k]
        sigma = float(np.sqrt(covariance[k, k]))
        if not prior:
            why = "its offset turns the frame of the base: a mark at its zero shows it"
        elif sigma > 0.7 * prior:
            why = f"move {name} and the joints after it more between the images"
        offset = float(fit.estimate.offsets[k])
        rows.append(JointOffset(name, offset, sigma, rotates.get(name, True), why))
    return tuple(rows)


def warnings_of(fit: ArmFit, fitter: Fitter) -> list[str]:
    """What the images contradict, one sentence each."""
    warnings = []
    if fit.confirmed < DOUBTFUL_CONFIRMED:
        warnings.append(
            f"the images show {100 * fit.confirmed:.0f} % of the outline of the arm only: look at"
            " the overlays, give more light, or take away what moves"
        )
    if fit.scale_px > MOST_SCATTER * max(fitter.views.camera.size):
        warnings.append(
            f"the outlines of the arm scatter by {fit.scale_px:.1f} px: look at the overlays; the"
            " URDF differs from the arm, people move, or the light changes"
        )
    focal = float(np.expm1(fit.estimate.parameters[FOCAL]))
    if abs(focal) > MOST_FOCAL:
        warnings.append(
            f"the images suggest a focal length {100 * focal:+.1f} % from the stated one:"
            " calibrate the intrinsics first ('evercal detect' on images of a board)"
        )
    drift_deg = _drift_deg(fitter)
    if drift_deg > REFUSED_DEG:
        raise InputError(
            f"the background moves by {drift_deg:.2f} deg in the recording: fasten the camera and"
            " record again, or use the images before or after"
        )
    if drift_deg > MOVED_DEG:
        warnings.append(
            f"the background moves by {drift_deg:.2f} deg in the recording: fasten the camera and"
            " record again"
        )
    return warnings


def links_not_shown(fit: ArmFit, fitter: Fitter) -> list[str]:
    """Names of links whose outlines the images do not show."""
    links = fitter.views.body.links
    testable = fit.equations.testable.sum(0)
    shown = np.bincount(fit.equations.link, fit.weights, minlength=len(links))
    is_lost = shown < _LINK_SHOWN * fit.confirmed * testable
    is_lost &= testable >= _LINK_POINTS
    return [links[k].link for k in np.flatnonzero(is_lost)]


def _drift_deg(fitter: Fitter) -> float:
    views = fitter.views
    greys = [
        np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        for image in views.images
    ]
    motion = motion_of_still(greys, views.uncovered)
    return drift_deg_of(motion / [views.camera.fx, views.camera.fy])
