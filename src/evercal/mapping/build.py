"""`build_map`: from posed frames to keyframes with adjusted poses and sub-pixel landmarks.

The steps: select keyframes by pose, encode, check the stated poses against the images, sweep the
keyframes' depths, pick and track landmarks, adjust everything together, refine the depths.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from evercal.classes import frozen_arrays
from evercal.errors import InputError, require_numbers
from evercal.features.encoder import Encoder
from evercal.geometry import SE3, Camera, norms
from evercal.mapping.arm_offsets import camera_in_gripper, joint_slopes, with_offsets
from evercal.mapping.built_map import Adjusted, BuiltMap, HandEyeCorrection, of_rays
from evercal.mapping.bundle_adjustment import BundleAdjustment
from evercal.mapping.bundle_equations import Adjustment
from evercal.mapping.bundle_options import BundleOptions
from evercal.mapping.bundle_tracks import bundle_tracks
from evercal.mapping.changed_lens import LensChange
from evercal.mapping.map_frame import (
    MapFrame,
    Similarity,
    fit_correction,
    frame_covariance,
    shared_sigma,
)
from evercal.mapping.memory_budget import MemoryBudget
from evercal.mapping.pose_check import check_poses, depth_scale, matched_pairs
from evercal.mapping.pose_readings import require_consistent
from evercal.mapping.prepared_frames import PreparedFrames, WorkingSize
from evercal.mapping.scene_map import SceneMap
from evercal.mapping.selection import select_farthest, spread_poses
from evercal.mapping.stated_errors import StatedErrors, velocity_of
from evercal.mapping.tracks import (
    SWEPT_FRAMES,
    KeyframeTracks,
    opened_keyframes,
    refine_depths,
    tracked_keyframes,
)
from evercal.processes import cores
from evercal.progress import OnProgress
from evercal.recordings.frame import Frame, stated_grippers, stated_poses
from evercal.robot.arm_offsets import ArmOffsets
from evercal.robot.frame_names import UNKNOWN, FrameNames
from evercal.robot.mount import Mount
from evercal.robot.pose_errors import ArmErrors, shared_errors
from evercal.typing import Array, IntArray, Strings

HAND_EYE_COVARIANCE_SCALE = 2.5
"""Factor on the covariance of `gripper_from_camera`. Alignment errors of a landmark are correlated
over many frames, which residuals do not show (research/handeye.md)."""
NOTICEABLE_RAD = 1e-4
"""Landmarks are tracked again if poses and intrinsics moved their projections by more than this:
some hundredths of a pixel."""
DOUBTFUL_WEIGHT = 0.25
"""A stated pose with a smaller weight is reported as doubtful."""


@dataclass(frozen=True)
class MapOptions:
    """Options of building a map."""

    memory: MemoryBudget = field(default_factory=MemoryBudget)
    """Number of keyframes."""
    size: WorkingSize = field(default_factory=WorkingSize)
    """Working sizes of images."""
    bundle: BundleOptions = field(default_factory=BundleOptions)
    """Bundle adjustment."""
    support_frames: int = 250
    """Frames that are adjusted beside the keyframes, spread by pose. The dense normal equations
    have six rows for each; more frames add time and no precision."""
    swept_frames: int = SWEPT_FRAMES
    """Maximum number of frames that a keyframe is tracked in."""
    metric: bool = True
    """Whether stated poses are in metres. Otherwise the map's unit follows from its depths."""
    adjust: bool = True
    """Adjust poses and intrinsics. False keeps them as stated."""
    rounds: int = 2
    """Rounds of tracking and adjusting; the second runs only if the first moved something."""
    arm: ArmOffsets | None = None
    """Joint offsets that the stated poses contain, in a hand-eye calibration; they are adjusted."""
    confirmed: Strings = ()
    """Names of frames whose stated poses are known to agree with the images."""
    mount: Mount | None = None
    """Mount of a camera whose poses follow from those of a gripper; see `for_hand_eye`."""
    whole: Camera | None = None
    """Intrinsics of whole images, where the frames are windows of them."""
    errors: ArmErrors = field(default_factory=ArmErrors)
    """What is known of the arm that moves the gripper."""
    names: FrameNames = UNKNOWN
    """Names of the frames of the recording."""

    def __post_init__(self) -> None:
        """Refuse numbers outside their range.

        Raises:
            InputError: Fewer than one round or support frame.
        """
        require_numbers(self, ("support_frames", "rounds"), 1)

    def for_hand_eye(self, mount: Mount) -> "MapOptions":
        """The same options for poses from a rough `gripper_from_camera`."""
        bundle = self.bundle.for_hand_eye(mount.moves)
        return replace(self, bundle=bundle, mount=mount)


def build_map(
    name: str,
    frames: Sequence[Frame],
    encoder: Encoder,
    options: MapOptions | None = None,
    on_progress: OnProgress = lambda *_: None,
) -> BuiltMap:
    """Build the map of a scene.

    The frames are posed, in recorded order.

    Raises:
        InputError: The frames have no parallax, or the images do not determine their poses.
    """
    options = options or MapOptions()
    prepared = _prepare(frames, encoder, options, on_progress)
    tracks = opened_keyframes(
        prepared.frames, prepared.keyframes, on_progress, options.swept_frames
    )
    if not any(keyframe.confirmed.any() for keyframe in tracks):
        raise InputError(
            "no two training frames show the same surfaces with parallax: record views from at"
            " least 10 cm apart, or check that the stated poses belong to these images"
        )
    adjustment = None
    if options.adjust:
        order = {frame.name: i for i, frame in enumerate(frames)}
        rows = [order[frame.name] for frame in prepared.frames.frames]
        velocity = velocity_of(stated_poses(frames))[rows]
        velocity /= np.repeat([prepared.unit or 1.0, 1.0], 3)
        adjustment = _adjust(
            prepared.frames,
            tracks,
            velocity,
            options,
            on_progress,
        )
    built = _finish(
        name,
        prepared,
        tracks,
        adjustment,
        options,
    )
    built = replace(built, scene=replace(built.scene, train_frames=len(frames)))
    return built.take(options.memory.fitting(built.scene.keyframes))


@frozen_arrays
class _Prepared:
    """Encoded frames whose stated poses are consistent with the images."""

    frames: PreparedFrames
    keyframes: list[int]
    """Numbers of the keyframes."""
    wrong: Strings
    """Names of frames whose stated pose contradicts the images."""
    untracked: Strings
    """Names of frames that could not be tracked."""
    unit: float | None
    """See `SceneMap.unit`."""


def _prepare(
    frames: Sequence[Frame],
    encoder: Encoder,
    options: MapOptions,
    on_progress: OnProgress,
) -> _Prepared:
    short_side = min(options.size.patches, *frames[0].read_image().shape[:2])
    wanted = spread_frames(frames, options.memory.capacity(frames, short_side))
    support = np.union1d(spread_frames(frames, options.support_frames), wanted)
    prepared = PreparedFrames([frames[i] for i in support], encoder, options.size)
    for i in range(len(prepared)):
        prepared.features(i)
        on_progress("encoding", i + 1, len(prepared))
    pairs = matched_pairs(prepared)
    unit = None
    scale = depth_scale(prepared, pairs, options.metric)
    if options.metric:
        prepared.depth_scale = scale
    else:
        unit = scale
        prepared = prepared.in_unit(scale)
    check = check_poses(prepared, pairs, options.confirmed)
    if not options.mount:
        require_consistent(prepared, pairs, check)
    consistent = prepared.without(check.excluded)
    # Other frames replace excluded keyframes.
    start = np.flatnonzero(np.isin(np.delete(support, check.excluded), wanted))
    keyframes = select_farthest(
        consistent.stated.translation_m,
        consistent.stated.rotation_wxyz,
        len(wanted),
        start=start.tolist(),
    )
    return _Prepared(
        consistent,
        keyframes.tolist(),
        prepared.names(check.wrong),
        prepared.names(check.untracked),
        unit,
    )


def spread_frames(frames: Sequence[Frame], capacity: int) -> IntArray:
    """Indices of posed frames spread over their poses, see `spread_poses`."""
    return spread_poses(stated_poses(frames), capacity)


def _adjust(
    prepared: PreparedFrames,
    keyframes: list[KeyframeTracks],
    velocity: Array,
    options: MapOptions,
    on_progress: OnProgress,
) -> Adjustment:
    """Alternate tracking and bundle adjustment."""
    stated_cameras = list(prepared.cameras)
    arm = options.arm
    joints = None
    adjustment = None
    kinds = None
    # Stated joint values show their offsets better than poses.
    if options.mount and not arm:
        kinds = shared_errors(stated_grippers(prepared.frames), options.errors)
    for number in range(options.rounds):
        on_progress("adjusting", number, options.rounds)
        tracks = bundle_tracks(prepared, keyframes)
        if arm:
            joints = joint_slopes(prepared.frames, arm)
        problem = BundleAdjustment(
            prepared.stated,
            stated_cameras,
            StatedErrors(
                velocity,
                camera_in_gripper(prepared.frames, prepared.stated, options.mount),
                joints,
                kinds,
            ),
            options.bundle,
        )
        adjustment = problem.solve(tracks)
        prepared.adjust(adjustment.poses, adjustment.cameras)
        if arm:
            arm = _offsets(arm, adjustment)
            prepared.frames = tuple(with_offsets(prepared.frames, arm))
        if not _moved(prepared.stated, stated_cameras[0], adjustment):
            break
        again = partial(refine_depths, prepared, again=True)
        with ThreadPoolExecutor(cores()) as pool:
            list(pool.map(again, keyframes))
    on_progress("adjusting", options.rounds, options.rounds)
    assert adjustment, "at least one round"
    return adjustment


def _offsets(start: ArmOffsets, adjustment: Adjustment) -> ArmOffsets:
    return replace(
        start,
        values=adjustment.offsets,
        covariance=HAND_EYE_COVARIANCE_SCALE * adjustment.offsets_covariance,
        prior=adjustment.offsets_prior,
        determined=adjustment.offsets_known,
    )


def _moved(
    stated: SE3,
    camera: Camera,
    adjustment: Adjustment,
) -> bool:
    """Whether projections of landmarks moved noticeably, by poses or by intrinsics."""
    change = (stated.inverse() @ adjustment.poses).log().reshape(-1, 2, 3)
    metres, radians = np.median(norms(change), 0)
    by_position = metres * np.median(adjustment.inverse_depth)
    by_camera = 0.0
    if adjustment.cameras is not None:
        right = np.linspace(0, camera.width - 1, 9)
        down = np.linspace(0, camera.height - 1, 9)
        grid = np.stack(np.meshgrid(right, down), -1)
        shift = adjustment.cameras[0].project(camera.unproject(grid)) - grid
        by_camera = float(np.nanmedian(norms(shift))) / camera.fx
    return max(by_position, radians, by_camera) > NOTICEABLE_RAD


def _finish(
    name: str,
    prepared: _Prepared,
    tracks: list[KeyframeTracks],
    adjustment: Adjustment | None,
    options: MapOptions,
) -> BuiltMap:
    """The built map of all adjusted parts."""
    frames = prepared.frames
    numbers = np.array([keyframe.frame for keyframe in tracks])
    stated = frames.frames[0].camera
    camera = frames.cameras[0].resized(*stated.size)
    adjusted = Adjusted()
    frame = MapFrame()
    hand_eye = None
    if adjustment:
        doubtful = np.flatnonzero(adjustment.weight < DOUBTFUL_WEIGHT)
        frame = _map_frame(adjustment, numbers, options)
        lens = LensChange.of(adjustment.focal_changes)
        at = ""
        if lens.first >= 0:
            at = frames.frames[lens.first].name
        adjusted = replace(
            Adjusted.of(adjustment, stated, camera),
            focal_change=lens.size,
            focal_change_at=at,
            doubtful_poses=frames.names(doubtful),
            shared_mm=1000 * frame.shared_m,
        )
        if not options.bundle.common_stated:
            # The common transform is part of the answer and not an error to undo.
            hand_eye = _hand_eye(frames, adjustment, options)
            corrected = frames.stated @ adjustment.common
            covariance = frame_covariance(corrected, hand_eye.covariance)
            frame = replace(frame, common=SE3.identity(), base_covariance=covariance)
    adjusted = replace(
        adjusted, wrong_poses=prepared.wrong, untracked=prepared.untracked
    )
    if prepared.unit is not None:
        similarity = Similarity(SE3.identity(), prepared.unit, metric=False)
        frame = replace(frame, similarity=similarity)
    scene = SceneMap(
        name=name,
        camera=stated,
        adjusted_camera=camera,
        keyframes=tracked_keyframes(frames, tracks),
        frame=frame,
        unit=prepared.unit,
        train_frames=len(frames),
        frames=options.names,
    )
    return BuiltMap(scene, adjusted, frames.names(numbers), hand_eye)


def _map_frame(
    adjustment: Adjustment,
    keyframes: IntArray,
    options: MapOptions,
) -> MapFrame:
    """Relation of the adjusted keyframes to the frame of the stated poses."""
    # Corrections are looked up at poses without what `common` undoes.
    stated = adjustment.poses
    if options.bundle.common_stated:
        stated = stated @ adjustment.common.inverse()
    correction = fit_correction(stated, adjustment.correction)
    variance = np.einsum("nii->ni", adjustment.covariance[keyframes])
    metres = float(np.sqrt(variance[:, :3].mean()))
    radians = float(np.sqrt(variance[:, 3:].mean()))
    return MapFrame(
        common=adjustment.common,
        correction=correction,
        pose_sigma=(metres, radians),
        frame_sigma=shared_sigma(stated, adjustment.correction, correction),
    )


def _hand_eye(
    frames: PreparedFrames,
    adjustment: Adjustment,
    options: MapOptions,
) -> HandEyeCorrection:
    scale = 1.0
    if options.mount and options.mount.moves:
        scale = HAND_EYE_COVARIANCE_SCALE
    camera = frames.cameras[0]
    by_cause = of_rays(adjustment, camera, options.whole or camera, scale)
    arm = None
    if options.arm and len(adjustment.offsets):
        arm = _offsets(options.arm, adjustment)
    names = frames.names(np.arange(len(frames)))
    return HandEyeCorrection(
        adjustment.common,
        *by_cause,
        dict(zip(names, adjustment.errors, strict=True)),
        dict(zip(names, adjustment.left_out, strict=True)),
        dict(zip(names, adjustment.correction, strict=True)),
        arm,
    )
