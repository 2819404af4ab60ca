"""A camera from nothing: images and gripper poses give `gripper_from_camera` or `base_from_camera`.

A camera on the gripper sees a scene that stands still. A fixed camera sees a thing that the
gripper holds: `gripper_from_base` moves the camera around it, so it is the same problem in the
frame of the gripper. `hand_eye_start` estimates a first transform from pairs of images. The map's
bundle adjustment refines it together with all poses and landmarks.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Self

import numpy as np

from evercal.calibration.calibration import Calibration, ErrorTerm
from evercal.calibration.checks import Checks
from evercal.calibration.framed_pose import ImageUse, JointOffset
from evercal.calibration.from_map.hand_eye_start import HandEyeStart
from evercal.calibration.from_map.next_views import open_position
from evercal.calibration.pose_pairs.checks import held_out_sizes
from evercal.calibration.verdict import verdict
from evercal.classes import frozen_arrays
from evercal.geometry import (
    SE3,
    UncertainPose,
    length_mm_deg,
    norms,
    pose_distance_mm_deg,
)
from evercal.mapping.built_map import (
    MOST_FOCAL_PERCENT,
    Adjusted,
    BuiltMap,
    HandEyeCorrection,
)
from evercal.recordings.frame import Frame, stated_grippers
from evercal.robot.arm_offsets import ArmOffsets
from evercal.typing import JsonObject, Pair, Record, Strings

_HOW = ("pairs", "of_pairs", "start_mm", "start_deg", "given_mm", "given_deg", "advice")
"""Fields of `HandEye` that are JSON values."""
MOST_POSE_SIGMA_MM = 5.0
"""A larger standard deviation of gripper positions indicates such errors, too; millimetres."""


@frozen_arrays
class HandEye:
    """A calibration from images and gripper poses alone, and how it was estimated."""

    calibration: Calibration
    """gripper_from_camera, or base_from_camera of a fixed camera."""
    pairs: int
    """Pairs of frames whose motion agrees with the first estimate."""
    of_pairs: int
    """Pairs of frames that the first estimate was made from."""
    start_mm: float
    """Change of the position of the first estimate by bundle adjustment."""
    start_deg: float
    """Change of its rotation."""
    given_mm: float | None = None
    """Distance from a given `gripper_from_camera`, such as from CAD."""
    given_deg: float | None = None
    warnings: Strings = ()
    """Reasons not to rely on the estimate."""
    advice: str = ""
    """Images that would improve it most; empty if no direction of the position is open."""

    @property
    def parent_from_camera(self) -> UncertainPose:
        """The transform with its covariance."""
        return self.calibration.uncertain_pose

    def to_dict(self) -> JsonObject:
        """Return JSON values, as `evercal learn --json` prints them."""
        values = {name: vars(self)[name] for name in _HOW}
        return {
            **self.calibration.to_dict(),
            **values,
            "warnings": list(self.warnings),
        }

    @classmethod
    def from_dict(cls, values: Record, calibration: Calibration) -> Self:
        """The inverse of `to_dict`, beside the calibration that is stored with the scene."""
        how = {name: values[name] for name in _HOW}
        return cls(calibration, warnings=tuple(values["warnings"]), **how)


def hand_eye_of(
    start: HandEyeStart,
    built: BuiltMap,
    frames: Sequence[Frame],
    given: SE3 | None = None,
    warnings: Strings = (),
) -> HandEye:
    """Return the estimate of a map that was built from `frames` with `MapOptions.for_hand_eye`.

    `given` is `gripper_from_camera` from another source, to compare with. `warnings` are further
    reasons not to rely on the estimate.
    """
    correction = built.hand_eye
    assert correction, "the map was built for a hand-eye calibration"
    # The covariance of the correction is about camera axes, as that of a pose after an exact one.
    start_from_camera = UncertainPose(
        correction.start_camera_from_camera, correction.covariance
    )
    estimate = start.parent_from_camera @ start_from_camera
    start_mm, start_deg = pose_distance_mm_deg(estimate.pose, start.parent_from_camera)
    calibration = Calibration(
        start.mount.name,
        estimate.pose,
        estimate.covariance,
        frames=built.scene.frames,
        camera=built.scene.adjusted_camera,
        lenses={
            "stated": built.scene.camera,
            "estimated": built.scene.adjusted_camera,
        },
        images=_uses(frames, built),
        error_terms=_error_terms(correction),
        checks=_checks(correction),
        source={
            "command": "learn" if start.mount.moves else "eye-to-hand",
            "scene": built.scene.name,
            "frames": len(frames),
            "map": built.scene.digest,
        },
    )
    if correction.arm:
        calibration = _with_joints(calibration, correction.arm, frames)
    warnings = (*_warnings(built.adjusted), *warnings)
    advice = _advice(frames, estimate) if start.mount.moves else ""
    return HandEye(
        replace(calibration, verdict=verdict_of(calibration, warnings, advice)),
        start.pairs,
        start.of_pairs,
        start_mm,
        start_deg,
        *_from_given(calibration, given),
        warnings,
        advice,
    )


def _error_terms(correction: HandEyeCorrection) -> tuple[ErrorTerm, ...]:
    noise = "noise of images and gripper poses"
    shared = "errors that gripper poses share"
    return (
        ErrorTerm.of(noise, correction.by_noise, "images"),
        ErrorTerm.of("intrinsics", correction.by_lens, "lens"),
        ErrorTerm.of(shared, correction.by_drift, "arm"),
    )


def _from_given(
    calibration: Calibration, given: SE3 | None
) -> Pair | tuple[None, None]:
    """Distance from a given transform, which is taken to be for the stated intrinsics."""
    if not given:
        return None, None
    return pose_distance_mm_deg(calibration.for_program().parent_from_child, given)


def verdict_of(calibration: Calibration, warnings: Sequence[str], advice: str) -> str:
    """Return the warnings, or else what the calibration is good for; then the advice."""
    sentences = [f"Do not rely on it: {warning}." for warning in warnings]
    if not sentences:
        sentences.append(verdict(calibration))
    if advice:
        sentences.append(f"{advice[:1].upper()}{advice[1:]}.")
    return " ".join(sentences)


def _advice(frames: Sequence[Frame], gripper_from_camera: UncertainPose) -> str:
    grippers = stated_grippers(frames)
    open_direction = open_position(grippers, gripper_from_camera.pose)
    if not open_direction:
        return ""
    variances = np.linalg.eigvalsh(gripper_from_camera.covariance[:3, :3])
    return open_direction.sentence(1000 * float(np.sqrt(variances[-1])))


def _uses(frames: Sequence[Frame], built: BuiltMap) -> tuple[ImageUse, ...]:
    """Use of each frame; residuals are of its gripper pose, as all others predict it."""
    assert built.hand_eye, "the map was built for a hand-eye calibration"
    uses = []
    for frame in frames:
        name = frame.name
        if isinstance(frame.image, Path):
            name = str(frame.image)
        residual = built.hand_eye.left_out.get(frame.name)
        reason = "not adjusted: set aside as a test of the map, or like its neighbours"
        if frame.name in built.adjusted.wrong_poses:
            reason = "its gripper pose contradicts the images"
        elif frame.name in built.adjusted.untracked:
            reason = "it could not be tracked in other images"
        elif residual is not None:
            uses.append(ImageUse(name, True, "", *length_mm_deg(residual[:6])))
            continue
        uses.append(ImageUse(name, False, reason))
    return tuple(uses)


def _checks(correction: HandEyeCorrection) -> Checks:
    """How well each gripper pose is predicted without it."""
    rows = np.array([*correction.left_out.values()])
    sigmas = float(np.sqrt(rows[:, 6].mean() / 6))
    return Checks(**held_out_sizes(rows[:, :6]), held_out_sigmas=sigmas)


def _with_joints(
    calibration: Calibration, offsets: ArmOffsets, frames: Sequence[Frame]
) -> Calibration:
    """Add the offsets, and what that of the joint at the camera does, which no image shows.

    It turns the gripper, or the base of a fixed camera, and the camera with it.
    """
    calibration = replace(
        calibration,
        joints=_joint_offsets(offsets),
        joint_covariance=offsets.covariance,
        checks=replace(calibration.checks, joints_move_mm=_moved_mm(offsets, frames)),
    )
    end = -1 if offsets.mount.moves else 0
    joint = offsets.arm.chain[end].value
    if offsets.arm.free()[joint]:
        return calibration
    values = np.array([f.joints_rad for f in frames[:1] if f.joints_rad is not None])
    slope = offsets.arm.slopes(values)[0, :, joint]
    if not offsets.mount.moves:
        slope = offsets.arm.poses(values).adjoint()[0] @ slope
    camera_from_parent = calibration.parent_from_child.inverse()
    motion = offsets.prior[joint] * (camera_from_parent.adjoint() @ slope)
    # The covariance is of the translation in the parent frame and the rotation about child axes.
    motion[:3] = calibration.parent_from_child.rotation_matrix() @ motion[:3]
    added = np.outer(motion, motion)
    term = ErrorTerm.of(f"offset of joint {offsets.arm.joints[joint]}", added, "arm")
    return replace(
        calibration,
        covariance=calibration.covariance + added,
        error_terms=(*calibration.error_terms, term),
    )


def _joint_offsets(offsets: ArmOffsets) -> tuple[JointOffset, ...]:
    """The offsets, and why some are not determined."""
    free = offsets.arm.free()
    rotates = offsets.arm.rotates()
    rows = []
    for i, name in enumerate(offsets.arm.joints):
        why = ""
        sigma = offsets.prior[i]
        if not free[i]:
            frame = "base" if i == 0 else "gripper"
            why = f"its offset turns the frame of the {frame}: a mark at its zero shows it"
        elif not offsets.determined[i]:
            why = f"move {name} and the joints after it more between the images"
        else:
            sigma = np.sqrt(offsets.covariance[i, i])
        value = float(offsets.values[i])
        rows.append(JointOffset(name, value, float(sigma), bool(rotates[i]), why))
    return tuple(rows)


def _moved_mm(offsets: ArmOffsets, frames: Sequence[Frame]) -> list[float]:
    """Mean and largest displacement of the gripper by the offsets."""
    values = np.array([f.joints_rad for f in frames if f.joints_rad is not None])
    before = offsets.arm.poses(values)
    after = offsets.arm.poses(values + offsets.values)
    shift = after.translation_m - before.translation_m
    lengths = 1000 * norms(shift)
    return [float(lengths.mean()), float(lengths.max())]


def _warnings(adjusted: Adjusted) -> Strings:
    warnings = []
    if abs(adjusted.focal_percent) > MOST_FOCAL_PERCENT:
        warnings.append(
            f"the images suggest a focal length {adjusted.focal_percent:+.1f} % from the stated"
            " one: calibrate the intrinsics first ('evercal detect' on images of a board)"
        )
    if (adjusted.pose_sigma_mm or 0) > MOST_POSE_SIGMA_MM:
        warnings.append(
            f"the gripper poses fit the images to {adjusted.pose_sigma_mm:.0f} mm only: let the arm"
            " stand still at every image, and check the clocks"
        )
    return tuple(warnings)
