"""A camera from nothing: images and gripper poses give `gripper_from_camera` or `base_from_camera`.

A camera on the gripper sees a scene that stands still. A fixed camera sees a thing that the
gripper holds: `gripper_from_base` moves the camera around it, so it is the same problem in the
frame of the gripper. `hand_eye_start` estimates a first transform from pairs of images. The map's
bundle adjustment refines it together with all poses and landmarks.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from evercal.calibration.calibration import (
    Calibration,
    ErrorTerm,
    ImageUse,
    JointOffset,
)
from evercal.calibration.from_map.hand_eye_start import (
    HandEyeStart,
    hand_eye_start,
    scene_from_parent,
)
from evercal.calibration.from_map.next_views import open_position
from evercal.calibration.held_thing.moving_parts import moving_parts
from evercal.calibration.held_thing.windows import cropped, windows
from evercal.calibration.located import deviations, length_mm_deg
from evercal.calibration.verdict import verdict
from evercal.errors import InputError
from evercal.features.encoder import Encoder
from evercal.geometry import SE3, Camera, UncertainPose, pose_distance_mm_deg
from evercal.mapping.arm_offsets import has_joints, with_offsets
from evercal.mapping.built_map import Adjusted, BuiltMap, HandEyeCorrection
from evercal.progress import OnProgress
from evercal.recordings.frame import (
    MIN_GRIPPER_FRAMES,
    Frame,
    Recording,
    stated_grippers,
)
from evercal.recordings.held_out import require_frames
from evercal.robot.arm_offsets import ArmOffsets
from evercal.robot.mount import Mount, MountName
from evercal.typing import Array

if TYPE_CHECKING:
    from evercal.localization.localizer import Localizer

MOST_FOCAL_PERCENT, MOST_POSE_SIGMA_MM = 1.0, 5.0
"""Larger corrections indicate systematic errors, which the covariance does not contain."""
STILL_SHARE = 0.3
"""Share of the texture that stands still before a fixed camera; the gripper shows a wrist camera
less of itself."""
SLIP_CHANCE, SLIP_SHARE = 1e-4, 0.5
"""Greatest probability of a step by chance, and least share of the residuals that it explains."""


@dataclass(frozen=True)
class HandEyeReport:
    """The estimated camera, as JSON values."""

    translation_m: tuple[float, ...]
    quaternion_wxyz: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    """(6, 6), as in `Calibration`."""
    pairs: int
    """Pairs of frames whose motion agrees with the first estimate, of those estimated."""
    of_pairs: int
    start_mm: float
    """Change of the first estimate by bundle adjustment."""
    start_deg: float
    mount: MountName = "eye_in_hand"
    """eye_in_hand estimates `gripper_from_camera`, eye_to_hand `base_from_camera`."""
    map: str = ""
    """Digest of the scene, see `SceneMap.digest`."""
    image_scatter: tuple[tuple[float, ...], ...] = ()
    """(6, 6) covariance of `base_from_camera` from single images of a located thing."""
    images_located: int = 0
    """Images that it was measured with."""
    given_mm: float | None = None
    """Distance from a given `gripper_from_camera`, such as from CAD."""
    given_deg: float | None = None
    warnings: tuple[str, ...] = ()
    """Reasons not to rely on the estimate."""
    advice: str = ""
    """Images that would improve it most; empty if no direction of the position is open."""
    created: str = ""
    """ISO 8601 time with zone."""
    error_terms: tuple[ErrorTerm, ...] = ()
    images: tuple[ImageUse, ...] = ()
    """Use of each frame; residuals are those of its gripper pose."""
    joints: tuple[JointOffset, ...] = ()
    """Offsets of the k joints of the arm, where its joint values are stated."""
    joint_covariance: tuple[tuple[float, ...], ...] = ()
    """(k, k) of the offsets."""
    joints_move_mm: tuple[float, ...] = ()
    """Mean and largest way of the gripper by the offsets, over all frames with joint values."""

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """The inverse of `asdict`."""
        kinds = {"error_terms": ErrorTerm, "images": ImageUse, "joints": JointOffset}
        rows = {
            key: tuple(of(**row) for row in values.get(key, ()))
            for key, of in kinds.items()
        }
        return cls(**{**values, **rows})

    @property
    def parent_from_camera(self) -> UncertainPose:
        """The transform with its covariance."""
        pose = SE3(np.array(self.quaternion_wxyz), np.array(self.translation_m))
        return UncertainPose(pose, np.array(self.covariance))

    def calibration(self, camera: Camera, scene: str, frames: int) -> Calibration:
        """Return the estimate as a calibration with the intrinsics that the map adjusted."""
        estimate = self.parent_from_camera
        fixed = self.mount == "eye_to_hand"
        scatter = [list(row) for row in self.image_scatter]
        checks = (
            {"images_used": self.images_located, "image_scatter": scatter}
            if scatter
            else {}
        )
        checks |= (
            {"joints_move_mm": [*self.joints_move_mm]} if self.joints_move_mm else {}
        )
        calibration = Calibration(
            self.mount,
            estimate.pose,
            estimate.covariance,
            parent_frame="base" if fixed else "gripper",
            camera=camera,
            images=self.images,
            error_terms=self.error_terms,
            joints=self.joints,
            joint_covariance=np.array(self.joint_covariance),
            checks=checks,
            source={
                "command": "eye-to-hand" if fixed else "learn",
                "scene": scene,
                "frames": frames,
                "map": self.map,
            },
            created=self.created,
        )
        warnings = [f"Do not rely on it: {warning}." for warning in self.warnings]
        advice = [f"{self.advice[:1].upper()}{self.advice[1:]}."] if self.advice else []
        sentences = [*(warnings or [verdict(calibration)]), *advice]
        return replace(calibration, verdict=" ".join(sentences))


def posed_by_gripper(
    recording: Recording,
    mount: Mount,
    encoder: Encoder,
    on_progress: OnProgress = lambda *_: None,
) -> tuple[Recording, HandEyeStart]:
    """Return the recording with rough camera poses, and the first estimate that they are from.

    Frames without a gripper pose count as untracked. Those of a fixed camera get poses in the frame
    of the gripper, and windows around what it holds.
    """
    frames = tuple(
        frame for frame in recording.train if frame.base_from_gripper is not None
    )
    require_frames(replace(recording, train=frames), MIN_GRIPPER_FRAMES)
    if not mount.moves:
        frames, _ = moving_parts(frames)
    arm = recording.arm if has_joints(frames) else None
    try:
        start = hand_eye_start(frames, mount, encoder, on_progress, arm)
    except InputError as error:
        hint = ""
        if mount.moves and (still := moving_parts(frames)[1]) > STILL_SHARE:
            hint = (
                f"; {100 * still:.0f} % of what the images show stands still: 'evercal eye-to-hand'"
                " calibrates a fixed camera by a thing in the gripper"
            )
        raise InputError(f"{recording.name}: {error}{hint}") from None
    if start.arm is not None:
        frames = tuple(with_offsets(frames, start.arm))
    poses = scene_from_parent(frames, mount) @ start.parent_from_camera
    if not mount.moves and (around := windows(frames, start)) is not None:
        frames = tuple(cropped(*both) for both in zip(frames, around, strict=True))
    train = tuple(
        replace(frame, base_from_camera=pose)
        for frame, pose in zip(frames, poses, strict=True)
    )
    lost = len(recording.train) - len(frames)
    posed = replace(recording, train=train, untracked=recording.untracked + lost)
    return posed, start


def hand_eye_report(
    start: HandEyeStart,
    built: BuiltMap,
    frames: Sequence[Frame],
    given: SE3 | None = None,
) -> HandEyeReport:
    """Return the estimate of a map that was built from `frames` with `MapOptions.for_hand_eye`.

    `given` is `gripper_from_camera` from another source, to compare with.
    """
    correction = built.hand_eye
    assert correction is not None, "the map was built for a hand-eye calibration"
    _refuse_slip(frames, correction, start.mount)
    # The covariance of the correction is about camera axes, as that of a pose after an exact one.
    start_from_camera = UncertainPose(
        correction.start_camera_from_camera, correction.covariance
    )
    estimate = start.parent_from_camera @ start_from_camera
    start_mm, start_deg = pose_distance_mm_deg(estimate.pose, start.parent_from_camera)
    fixed = not start.mount.moves
    left = None if fixed else open_position(stated_grippers(frames), estimate.pose)
    widest_mm = 1000 * float(
        np.sqrt(np.linalg.eigvalsh(estimate.covariance[:3, :3])[-1])
    )
    from_given = (
        (None, None) if given is None else pose_distance_mm_deg(estimate.pose, given)
    )
    return HandEyeReport(
        translation_m=tuple(estimate.pose.translation_m.tolist()),
        quaternion_wxyz=tuple(estimate.pose.rotation_wxyz.tolist()),
        covariance=tuple(tuple(row) for row in estimate.covariance.tolist()),
        pairs=start.pairs,
        of_pairs=start.of_pairs,
        start_mm=start_mm,
        start_deg=start_deg,
        given_mm=from_given[0],
        given_deg=from_given[1],
        mount=start.mount.name,
        map=built.scene.digest,
        warnings=_warnings(built.adjusted),
        advice=left.sentence(widest_mm) if left else "",
        error_terms=(
            ErrorTerm.of("noise of images and gripper poses", correction.by_noise),
            ErrorTerm.of("intrinsics", correction.by_lens),
            ErrorTerm.of("slowly varying errors of gripper poses", correction.by_drift),
        ),
        images=tuple(
            use for frame in frames if (use := _use(frame, built)) is not None
        ),
        joints=() if correction.arm is None else _joint_offsets(correction.arm),
        joint_covariance=()
        if correction.arm is None
        else tuple(tuple(row) for row in correction.arm.covariance.tolist()),
        joints_move_mm=()
        if correction.arm is None
        else _moved_mm(correction.arm, frames),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
    )


def with_image_scatter(
    report: HandEyeReport, localizer: "Localizer", frames: Sequence[Frame]
) -> HandEyeReport:
    """The report with the scatter of single images, which `check` compares a shift with.

    The frames are located in the finished map of the thing. Their gripper poses lead to the base.
    """
    posed = [frame for frame in frames if frame.base_from_gripper is not None]
    camera = report.parent_from_camera.pose
    found = [
        localizer.localize(f.read_image(), f.camera).base_from_camera for f in posed
    ]
    poses = [
        frame.base_from_gripper @ pose
        for frame, pose in zip(posed, found, strict=True)
        if pose is not None and frame.base_from_gripper is not None
    ]
    if len(poses) < 2:
        return report
    off = deviations(SE3.stack(poses), camera)
    rows = tuple(tuple(row) for row in (off.T @ off / len(off)).tolist())
    return replace(report, image_scatter=rows, images_located=len(off))


def _refuse_slip(
    frames: Sequence[Frame], correction: HandEyeCorrection, mount: Mount
) -> None:
    """Refuse a recording of a fixed camera in which the camera or the thing moved once.

    A thing that slips in the gripper steps in the gripper's residuals, a camera in its own.
    """
    if mount.moves:
        return
    names = [frame.name for frame in frames if frame.name in correction.residuals]
    steps = [
        (step, what)
        for values, what in (
            (correction.residuals, "what the gripper holds"),
            (correction.moved, "the camera"),
        )
        if (step := largest_step(np.array([values[name] for name in names])))
        is not None
    ]
    if steps:
        step, what = max(steps, key=lambda both: both[0].share)
        millimetres, degrees = length_mm_deg(step.size)
        raise InputError(
            f"{what} moved by {millimetres:.1f} mm and {degrees:.2f} deg before image"
            f" {names[step.before]}: fasten it and record again, or use the images before or after"
        )


class Step(NamedTuple):
    """A step in a sequence."""

    before: int
    """Number of the first element after it."""
    size: Array
    """(6,) metres and radians."""
    share: float
    """Share of the sum of squares that it explains."""


def largest_step(values: Array) -> Step | None:
    """The step that explains most of deviations (n, 6), metres and radians; None by chance."""
    from scipy import stats

    n = len(values)
    best = None
    for k in range(2, n - 1):
        size = values[k:].mean(0) - values[:k].mean(0)
        total = ((values - values.mean(0)) ** 2).reshape(n, 2, 3).sum((0, 2))
        by_step = k * (n - k) / n * (size**2).reshape(2, 3).sum(1)
        rest = np.maximum(total - by_step, 1e-18)
        chance = (
            stats.f.sf((by_step / 3) / (rest / (3 * (n - 2))), 3, 3 * (n - 2)).min()
            * 2
            * n
        )
        share = float((by_step / np.maximum(total, 1e-18)).max())
        if (
            chance < SLIP_CHANCE
            and share > SLIP_SHARE
            and (best is None or share > best.share)
        ):
            best = Step(k, size, share)
    return best


def _use(frame: Frame, built: BuiltMap) -> ImageUse | None:
    assert built.hand_eye is not None, "the map was built for a hand-eye calibration"
    name = str(frame.image) if isinstance(frame.image, Path) else frame.name
    if frame.name in built.adjusted.wrong_poses:
        return ImageUse(name, False, "its gripper pose contradicts the images")
    if frame.name in built.adjusted.untracked:
        return ImageUse(name, False, "it could not be tracked in other images")
    residual = built.hand_eye.residuals.get(frame.name)
    return (
        None if residual is None else ImageUse(name, True, "", *length_mm_deg(residual))
    )


def _joint_offsets(arm: ArmOffsets) -> tuple[JointOffset, ...]:
    """The offsets, and why some are not determined."""
    free = arm.arm.free()
    rotates = arm.arm.rotates()
    rows = []
    for i, name in enumerate(arm.arm.joints):
        why = ""
        if not free[i]:
            what = "base" if i == 0 else "gripper"
            why = (
                f"its offset turns the frame of the {what}: a mark at its zero shows it"
            )
        elif not arm.determined[i]:
            why = f"move {name} and the joints after it more between the images"
        sigma = arm.prior[i] if why else np.sqrt(arm.covariance[i, i])
        rows.append(
            JointOffset(name, float(arm.values[i]), float(sigma), bool(rotates[i]), why)
        )
    return tuple(rows)


def _moved_mm(offsets: ArmOffsets, frames: Sequence[Frame]) -> tuple[float, ...]:
    """Mean and largest way of the gripper by the offsets."""
    values = np.array([f.joints_rad for f in frames if f.joints_rad is not None])
    before, after = (
        offsets.arm.poses(values + added) for added in (0.0, offsets.values)
    )
    ways = 1000 * np.linalg.norm(after.translation_m - before.translation_m, axis=1)
    return float(ways.mean()), float(ways.max())


def _warnings(adjusted: Adjusted) -> tuple[str, ...]:
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
