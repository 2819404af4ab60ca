"""`BuiltMap`: a scene's map, what was adjusted to build it, and what is needed to judge it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Self

import numpy as np

from evercal.classes import frozen, frozen_arrays
from evercal.geometry import SE3, Camera, norms
from evercal.mapping.arm_offsets import with_offsets
from evercal.mapping.bundle_equations import DISTORTION, INTRINSICS, Adjustment
from evercal.mapping.scene_map import LeftOut, SceneMap
from evercal.recordings.frame import Frame
from evercal.robot.arm_offsets import ArmOffsets
from evercal.typing import Array, Floats, IntArray, JsonObject, Pair, Strings

GAP = 10
"""Cross-validation: frames without keyframes before and after a part that is left out. Frames
between similar keyframes are located more exactly than new images are."""
MOST_FOCAL_PERCENT = 1.0
"""A larger change of the focal length indicates errors that the covariance does not contain."""
LENGTHS = (
    "common_translation_mm",
    "common_sigma_mm",
    "pose_sigma_mm",
    "shared_mm",
    "depth_m",
)
"""Fields of `Adjusted` that are None where the unit of length is unknown."""
MOST_PARTS = 48
"""Maximum number of frames that are left out in turn."""
PART = 4
"""Frames between two that are left out, at least."""


@frozen
class Adjusted:
    """What bundle adjustment changed about a recording, as JSON values."""

    common_translation_mm: Floats | None = (0.0, 0.0, 0.0)
    """(3,) correction common to all stated poses, in the camera frame; None where their unit of
    length is unknown, as `pose_sigma_mm`."""
    common_rotation_deg: Floats = (0.0, 0.0, 0.0)
    """(3,) its rotation vector."""
    common_sigma_mm: float | None = 0.0
    """Standard deviation of the length of that translation, with systematic errors; None as it."""
    common_sigma_deg: float = 0.0
    """The same for the angle, degrees."""
    shared_mm: float | None = 0.0
    """Root mean square per axis of errors of stated positions that neighbouring frames share."""
    depth_m: float | None = None
    """Median depth of the landmarks; None without adjustment, or where the unit is unknown."""
    focal_percent: float = 0.0
    """Change of the focal length."""
    focal_change: float = 0.0
    """Change of the focal length within the recording, relative, see `LensChange`; 0 for none."""
    focal_change_at: str = ""
    """First frame after it; empty where the focal length differs from frame to frame."""
    residual_px: float | None = None
    """Median reprojection error after the adjustment; None without adjustment."""
    pose_sigma_mm: float | None = 0.0
    """Estimated error of the stated positions, standard deviation per axis."""
    pose_sigma_deg: float = 0.0
    """The same for the stated rotations, degrees."""
    time_shift_frames: float = 0.0
    """Delay of the images after their stated poses."""
    wrong_poses: Strings = ()
    """Frames whose stated pose contradicts the images; they are excluded."""
    untracked: Strings = ()
    """Frames that could not be tracked in other images, or not enough; they are excluded."""
    doubtful_poses: Strings = ()
    """Frames whose stated pose has an unusually large error; they were given less weight."""
    corner_px: float = 0.0
    """Largest change of a corner of the first frame's image by the intrinsics, pixels."""
    intrinsics: tuple[JsonObject, ...] = ()
    """Its intrinsics as stated and as adjusted; none without adjustment."""

    @classmethod
    def of(
        cls,
        adjustment: Adjustment,
        stated: Camera,
        camera: Camera,
    ) -> Self:
        """Changes by bundle adjustment, without names of frames.

        `stated` and `camera` are the intrinsics before and after.
        """
        tangent = adjustment.common.log()
        covariance = adjustment.common_covariance + adjustment.common_systematic
        size = stated.size
        unit_square = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
        corners = unit_square * size - 0.5
        moved = norms(camera.project(stated.unproject(corners)) - corners)
        return cls(
            common_translation_mm=tuple((1000 * tangent[:3]).tolist()),
            common_rotation_deg=tuple(np.rad2deg(tangent[3:]).tolist()),
            common_sigma_mm=1000 * _length_sigma(tangent[:3], covariance[:3, :3]),
            common_sigma_deg=np.rad2deg(_length_sigma(tangent[3:], covariance[3:, 3:])),
            depth_m=float(1 / np.median(adjustment.inverse_depth)),
            focal_percent=100 * (camera.fx / stated.fx - 1),
            residual_px=adjustment.residual_px,
            pose_sigma_mm=1000 * adjustment.sigma_m,
            pose_sigma_deg=float(np.rad2deg(adjustment.sigma_rad)),
            time_shift_frames=adjustment.shift_frames,
            corner_px=float(np.fmax.reduce(moved, initial=0.0)),
            intrinsics=(stated.to_dict(), camera.to_dict()),
        )


def _length_sigma(vector: Array, covariance: Array) -> float:
    """The length of a vector over its Mahalanobis distance from 0."""
    length = float(np.linalg.norm(vector))
    distance = float(np.sqrt(vector @ np.linalg.solve(covariance, vector)))
    return length / max(distance, 1e-12)


def of_rays(
    adjustment: Adjustment, camera: Camera, whole: Camera, scale: float
) -> tuple[Array, Array, Array]:
    """Covariances (6, 6) of the common transform for the estimated intrinsics, by their causes.

    The transform belongs to its intrinsics: an error of it that trades against one of theirs leaves
    the rays where they are, and counts as none.

    Args:
        adjustment: Result of bundle adjustment.
        camera: Intrinsics that were adjusted.
        whole: Intrinsics of whole images, where these are windows of them.
        scale: Factor on the covariance by noise.

    Returns:
        Of noise, of the uncertainty of the intrinsics, and of errors that vary slowly.
    """
    from evercal.geometry.rays import turn_by_lens

    turn = turn_by_lens(whole, DISTORTION)
    turn[:, 1:3] *= whole.fx / camera.fx
    rays = np.eye(6, 6 + INTRINSICS)
    rays[3:, 6:] = -turn
    joint = rays @ adjustment.lens_covariance
    lens = adjustment.lens_covariance[6:, 6:]
    by_lens = joint[:, 6:] @ np.linalg.solve(lens, joint[:, 6:].T)
    by_noise = scale * joint @ rays.T - by_lens
    return by_noise, by_lens, rays @ adjustment.lens_systematic @ rays.T


@frozen_arrays
class HandEyeCorrection:
    """Adjustment of a rough `gripper_from_camera`."""

    start_camera_from_camera: SE3
    """gripper_from_camera is the rough one times this."""
    by_noise: Array
    """(6, 6) covariance by noise of images and gripper poses; camera frame, metres and radians."""
    by_lens: Array
    """(6, 6) covariance by the uncertainty of the intrinsics."""
    by_drift: Array
    """(6, 6) covariance by errors of gripper poses that vary slowly over the recording."""
    residuals: dict[str, Array]
    """(6,) deviation of each frame's gripper pose from the images, by name; gripper frame."""
    left_out: dict[str, Array]
    """(7,) the same by all other gripper poses, see `Adjustment.left_out`."""
    moved: dict[str, Array]
    """(6,) the same as a motion of the camera, camera frame."""
    arm: ArmOffsets | None = None
    """Offsets of the joints of the arm, where its joint values are stated."""

    @property
    def covariance(self) -> Array:
        """(6, 6) of all causes."""
        return self.by_noise + self.by_lens + self.by_drift


@frozen_arrays
class BuiltMap:
    """A scene's map and how it came about."""

    scene: SceneMap
    """What is stored."""
    adjusted: Adjusted
    """Changes by bundle adjustment, for reports."""
    keyframe_names: Strings
    """Names of the frames that are keyframes."""
    hand_eye: HandEyeCorrection | None = None
    """Adjustment of `gripper_from_camera`; None where camera poses were stated."""

    @property
    def independent_noise(self) -> Pair:
        """Standard deviation of stated poses per axis that neighbouring frames do not share."""
        metres = (self.adjusted.pose_sigma_mm or 0) / 1000
        radians = np.deg2rad(self.adjusted.pose_sigma_deg)
        shared = self.scene.frame.frame_sigma
        independent = np.where(shared, 0.0, [metres, radians])
        return float(independent[0]), float(independent[1])

    def corrected(self, frames: Sequence[Frame]) -> list[Frame]:
        """Other frames of the recording, with the adjusted `gripper_from_camera`."""
        if self.hand_eye is None:
            return list(frames)
        if self.hand_eye.arm:
            frames = with_offsets(frames, self.hand_eye.arm)
        change = self.hand_eye.start_camera_from_camera
        corrected = []
        for frame in frames:
            if frame.base_from_camera:
                pose = frame.base_from_camera @ change
                corrected.append(replace(frame, base_from_camera=pose))
        return corrected

    def cleared(self, names: Sequence[str]) -> "BuiltMap":
        """The same map, in which the poses of some frames no longer count as wrong."""
        before = self.adjusted
        wrong = tuple(name for name in before.wrong_poses if name not in names)
        untracked = (*before.untracked, *names)
        adjusted = replace(before, wrong_poses=wrong, untracked=untracked)
        return replace(self, adjusted=adjusted)

    def left_out(self, frames: Sequence[Frame]) -> list[LeftOut]:
        """Frames of the recording, each with the keyframes recorded well before and after it.

        The frames are all that the map was built from, in recorded order. A recording that is too
        short for it, or that states gripper poses, gives none.
        """
        if len(frames) < 3 * GAP or self.hand_eye:
            return []
        order = {frame.name: i for i, frame in enumerate(frames)}
        recorded = np.array([order[name] for name in self.keyframe_names])
        excluded = {*self.adjusted.wrong_poses, *self.adjusted.untracked}
        count = min(MOST_PARTS, len(frames) // PART)
        parts = []
        middles = np.linspace(GAP, len(frames) - GAP - 1, count).astype(int)
        for middle in middles.tolist():
            others = np.flatnonzero(np.abs(recorded - middle) > GAP)
            frame = frames[middle]
            if len(others) and frame.name not in excluded:
                parts.append(LeftOut((frame,), others))
        return parts

    def take(self, index: IntArray) -> "BuiltMap":
        """The same map with a subset of its keyframes."""
        names = tuple(self.keyframe_names[i] for i in index.tolist())
        scene = replace(self.scene, keyframes=self.scene.keyframes.take(index))
        return replace(self, scene=scene, keyframe_names=names)
