"""`build_map`: from posed frames to keyframes with adjusted poses and sub-pixel landmarks.

The steps: select keyframes by pose, encode, check the stated poses against the images, sweep the
keyframes' depths, pick and track landmarks, adjust everything together, refine the depths.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from evercal.errors import InputError
from evercal.features.encoder import Encoder
from evercal.geometry import SE3, Camera
from evercal.geometry.uncertain_pose import frame_covariance
from evercal.mapping.arm_offsets import ArmOffsets
from evercal.mapping.bundle_adjustment import Adjustment, BundleAdjustment
from evercal.mapping.bundle_options import BundleOptions
from evercal.mapping.keyframes import Keyframes, jpeg
from evercal.mapping.map_frame import MapFrame, Similarity, fit_correction, shared_sigma
from evercal.mapping.memory_budget import MemoryBudget
from evercal.mapping.pose_check import (
    check_poses,
    depth_scale,
    matched_pairs,
)
from evercal.mapping.prepared_frames import PreparedFrames, WorkingSize
from evercal.mapping.scene_map import LeftOut, SceneMap
from evercal.mapping.selection import select_farthest, spread_poses
from evercal.mapping.tracks import (
    KeyframeTracks,
    bundle_tracks,
    open_keyframe,
    refine_depths,
)
from evercal.processes import cores
from evercal.progress import OnProgress
from evercal.recordings.frame import Frame, stated_grippers, stated_poses
from evercal.robot.mount import Mount
from evercal.typing import Array, IntArray

HAND_EYE_COVARIANCE_SCALE = 2.5
"""Factor on the covariance of `gripper_from_camera`. Alignment errors of a landmark are correlated
over many frames, which residuals do not show (research/handeye.md)."""
GAP, MOST_PARTS = 10, 12
"""Frames without keyframes before and after a part that is left out, and number of parts at most.
Frames between similar keyframes are located more exactly than new images are."""
NOTICEABLE_RAD = 1e-4
"""Landmarks are tracked again if poses and intrinsics moved their projections by more than this:
some hundredths of a pixel."""


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
    metric: bool = True
    """Whether stated poses are in metres. Otherwise the map's unit follows from its depths."""
    adjust: bool = True
    """Adjust poses and intrinsics. False keeps them as stated."""
    rounds: int = 2
    """Rounds of tracking and adjusting; the second runs only if the first moved something."""
    arm: ArmOffsets | None = None
    """Joint offsets that the stated poses contain, in a hand-eye calibration; they are adjusted."""
    mount: Mount | None = None
    """Mount of a camera whose poses follow from those of a gripper; see `for_hand_eye`."""

    def for_hand_eye(self, mount: Mount) -> "MapOptions":
        """The same options for poses from a rough `gripper_from_camera`.

        The common transform has no prior. The poses of arms have errors of a tenth of a millimetre
        at least, which bounds the estimated errors of stated poses.
        """
        bundle = replace(
            self.bundle,
            common_stated=False,
            # Before one place, the adjusted mount depends on its start by more than the noise.
            least_systematic=1.0 if mount.moves else 0.1,
            common_sigma_m=0.2,
            common_sigma_deg=10.0,
            least_sigma_m=2e-4,
            least_sigma_deg=0.015,
        )
        if not mount.moves:
            bundle = replace(
                bundle,
                correlation=2.7,
                least_share=0.0025,
                least_sigma_m=1e-4,
                least_sigma_deg=0.01,
            )
        return replace(self, bundle=bundle, mount=mount)


@dataclass(frozen=True)
class Adjusted:
    """What bundle adjustment changed about a recording, as JSON values."""

    common_translation_mm: tuple[float, float, float] | None
    """Correction common to all stated poses, in the camera frame; None where their unit of length
    is unknown, as `pose_sigma_mm`."""
    common_rotation_deg: tuple[float, float, float]
    """Its rotation vector."""
    focal_percent: float
    """Change of the focal length."""
    residual_px: float | None
    """Median reprojection error after the adjustment; None without adjustment."""
    pose_sigma_mm: float | None
    """Estimated error of the stated positions, standard deviation per axis."""
    pose_sigma_deg: float
    """The same for the stated rotations, degrees."""
    time_shift_frames: float
    """Delay of the images after their stated poses."""
    wrong_poses: tuple[str, ...]
    """Frames whose stated pose contradicts the images; they are excluded."""
    untracked: tuple[str, ...]
    """Frames that could not be tracked in other images, or not enough; they are excluded."""
    doubtful_poses: tuple[str, ...]
    """Frames whose stated pose has an unusually large error; they were given less weight."""
    corner_px: float = 0.0
    """Largest change of a corner of the first frame's image by the intrinsics, pixels."""
    intrinsics: tuple[dict[str, object], ...] = ()
    """Its intrinsics as stated and as adjusted; none without adjustment."""


@dataclass(frozen=True, eq=False)
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
    moved: dict[str, Array]
    """(6,) the same as a motion of the camera, camera frame."""
    arm: ArmOffsets | None = None
    """Offsets of the joints of the arm, where its joint values are stated."""

    @property
    def covariance(self) -> Array:
        """(6, 6) of all causes."""
        return self.by_noise + self.by_lens + self.by_drift


@dataclass(frozen=True, eq=False)
class BuiltMap:
    """A scene's map and how it came about."""

    scene: SceneMap
    """What is stored."""
    adjusted: Adjusted
    """Changes by bundle adjustment, for reports."""
    keyframe_names: tuple[str, ...]
    """Names of the frames that are keyframes."""
    hand_eye: HandEyeCorrection | None = None
    """Adjustment of `gripper_from_camera`; None where camera poses were stated."""

    @property
    def independent_noise(self) -> tuple[float, float]:
        """Standard deviation of stated poses per axis that neighbouring frames do not share."""
        stated = (
            (self.adjusted.pose_sigma_mm or 0) / 1000,
            np.deg2rad(self.adjusted.pose_sigma_deg),
        )
        metres, radians = (
            0.0 if shared else float(sigma)
            for sigma, shared in zip(stated, self.scene.frame.frame_sigma, strict=True)
        )
        return metres, radians

    def corrected(self, frames: Sequence[Frame]) -> list[Frame]:
        """Other frames of the recording, with the adjusted `gripper_from_camera`."""
        if self.hand_eye is None:
            return list(frames)
        change = self.hand_eye.start_camera_from_camera
        arm = self.hand_eye.arm
        moved = frames if arm is None else arm.moved(frames)
        return [
            replace(frame, base_from_camera=frame.base_from_camera @ change)
            for frame in moved
            if frame.base_from_camera is not None
        ]

    def cleared(self, names: Sequence[str]) -> "BuiltMap":
        """The same map, in which the poses of some frames no longer count as wrong."""
        adjusted = self.adjusted
        wrong = tuple(name for name in adjusted.wrong_poses if name not in names)
        adjusted = replace(
            adjusted, wrong_poses=wrong, untracked=(*adjusted.untracked, *names)
        )
        return replace(self, adjusted=adjusted)

    def left_out(self, frames: Sequence[Frame]) -> list[LeftOut]:
        """Parts of the recording, each with the keyframes that were recorded before and after it.

        The frames are all that the map was built from, in recorded order. A recording that is too
        short for it, or that states gripper poses, gives none.
        """
        if len(frames) < 3 * GAP or self.hand_eye is not None:
            return []
        order = {frame.name: i for i, frame in enumerate(frames)}
        recorded = np.array([order[name] for name in self.keyframe_names])
        excluded = {*self.adjusted.wrong_poses, *self.adjusted.untracked}
        count = min(MOST_PARTS, len(frames) // (2 * GAP))
        parts = []
        for middle in (
            np.linspace(GAP, len(frames) - GAP - 1, count).astype(int).tolist()
        ):
            others = np.flatnonzero(np.abs(recorded - middle) > GAP)
            some = [
                f for f in frames[middle - 3 : middle + 4 : 2] if f.name not in excluded
            ]
            if len(others) and some:
                parts.append(LeftOut(tuple(some), others))
        return parts

    def take(self, index: IntArray) -> "BuiltMap":
        """The same map with a subset of its keyframes."""
        names = tuple(self.keyframe_names[i] for i in index.tolist())
        scene = replace(self.scene, keyframes=self.scene.keyframes.take(index))
        return replace(self, scene=scene, keyframe_names=names)


def build_map(
    name: str,
    frames: Sequence[Frame],
    encoder: Encoder,
    options: MapOptions | None = None,
    on_progress: OnProgress = lambda *_: None,
) -> BuiltMap:
    """Build the map of a scene.

    The frames are posed, in recorded order.
    """
    options = options or MapOptions()
    prepared = _prepare(frames, encoder, options, on_progress)
    keyframes = _open_keyframes(prepared, options, on_progress)
    adjustment = None
    if options.adjust:
        order = {frame.name: i for i, frame in enumerate(frames)}
        velocity = _velocity(frames) / np.repeat([prepared.unit, 1.0], 3)
        velocity = velocity[[order[frame.name] for frame in prepared.frames.frames]]
        adjustment = _adjust(prepared.frames, keyframes, velocity, options, on_progress)
    built = _finish(name, prepared, keyframes, adjustment, options)
    built = replace(built, scene=replace(built.scene, train_frames=len(frames)))
    return built.take(options.memory.fitting(built.scene.keyframes))


@dataclass(frozen=True, eq=False)
class _Prepared:
    """Encoded frames whose stated poses are consistent with the images."""

    frames: PreparedFrames
    keyframes: list[int]
    """Numbers of the keyframes."""
    wrong: tuple[str, ...]
    """Names of frames whose stated pose contradicts the images."""
    untracked: tuple[str, ...]
    """Names of frames that could not be tracked."""
    unit: float
    """Units of the recording per unit of the map."""


def _prepare(
    frames: Sequence[Frame],
    encoder: Encoder,
    options: MapOptions,
    on_progress: OnProgress,
) -> _Prepared:
    short_side = min(options.size.patches, *frames[0].read_image().shape[:2])
    wanted = set(
        spread_frames(frames, options.memory.capacity(frames, short_side)).tolist()
    )
    support = sorted({*spread_frames(frames, options.support_frames).tolist(), *wanted})
    prepared = PreparedFrames([frames[i] for i in support], encoder, options.size)
    features = []
    for i in range(len(prepared)):
        features.append(prepared.features(i))
        on_progress("encoding", i + 1, len(prepared))
    pairs = matched_pairs(prepared, encoder.vlad(features))
    unit = 1.0
    scale = depth_scale(prepared, pairs, options.metric)
    if options.metric:
        prepared.depth_scale = scale
    else:
        unit = scale
        prepared = prepared.in_unit(scale)
    check = check_poses(prepared, pairs)
    wrong, untracked = (
        tuple(prepared.frames[i].name for i in part)
        for part in (check.wrong, check.untracked)
    )
    good = sorted(set(range(len(support))) - set(check.excluded.tolist()))
    if len(check.excluded):
        prepared = prepared.without(check.excluded)
    start = [new for new, old in enumerate(good) if support[old] in wanted]
    # Other frames replace excluded keyframes.
    positions = prepared.stated.translation_m
    rotations = prepared.stated.rotation_wxyz
    keyframes = select_farthest(positions, rotations, len(wanted), start=start)
    return _Prepared(prepared, keyframes.tolist(), wrong, untracked, unit)


def spread_frames(frames: Sequence[Frame], capacity: int) -> IntArray:
    """Indices of posed frames spread over their poses, see `spread_poses`."""
    return spread_poses(stated_poses(frames), capacity)


def _open_keyframes(
    prepared: _Prepared, options: MapOptions, on_progress: OnProgress
) -> list[KeyframeTracks]:
    """Depths, landmarks and tracks of every keyframe."""

    def open_one(frame: int) -> KeyframeTracks:
        keyframe = open_keyframe(prepared.frames, frame)
        refine_depths(prepared.frames, keyframe)
        return keyframe

    keyframes = []
    with ThreadPoolExecutor(cores()) as pool:
        for keyframe in pool.map(open_one, prepared.keyframes):
            keyframes.append(keyframe)
            on_progress("mapping", len(keyframes), len(prepared.keyframes))
    if not any(keyframe.confirmed.any() for keyframe in keyframes):
        raise InputError(
            "no two training frames show the same surfaces with parallax: record views from at"
            " least 10 cm apart, or check that the stated poses belong to these images"
        )
    return keyframes


def _velocity(frames: Sequence[Frame]) -> np.ndarray:
    """(n, 6) motion per frame, camera frame; 0 beside gaps of the recording.

    A gap is a step much longer than the median one.
    """
    poses = stated_poses(frames)
    if len(frames) < 3:
        return np.zeros((len(frames), 6))
    steps = (poses[:-1].inverse() @ poses[1:]).log()
    size = np.linalg.norm(steps, axis=1)
    smooth = size < 4 * np.median(size) + 1e-9
    velocity = np.zeros((len(frames), 6))
    both = smooth[:-1] & smooth[1:]
    velocity[1:-1][both] = (steps[:-1][both] + steps[1:][both]) / 2
    return velocity


def _adjust(
    prepared: PreparedFrames,
    keyframes: list[KeyframeTracks],
    velocity: np.ndarray,
    options: MapOptions,
    on_progress: OnProgress,
) -> Adjustment:
    """Alternate tracking and bundle adjustment."""
    stated_cameras = list(prepared.cameras)
    arm = options.arm
    adjustment = None
    for number in range(options.rounds):
        on_progress("adjusting", number, options.rounds)
        tracks = bundle_tracks(prepared, keyframes)
        problem = BundleAdjustment(
            prepared.stated,
            stated_cameras,
            velocity,
            options.bundle,
            _gripper_from_camera(prepared, options.mount),
            None if arm is None else arm.slopes(prepared.frames),
        )
        adjustment = problem.solve(tracks)
        prepared.adjust(adjustment.poses, adjustment.cameras)
        if arm is not None:
            arm = _offsets(arm, adjustment)
            prepared.frames = tuple(arm.moved(prepared.frames))
        if not _moved(prepared.stated, stated_cameras[0], adjustment):
            break
        again = partial(refine_depths, prepared, again=True)
        with ThreadPoolExecutor(cores()) as pool:
            list(pool.map(again, keyframes))
    on_progress("adjusting", options.rounds, options.rounds)
    assert adjustment is not None, "at least one round"
    return adjustment


def _offsets(start: ArmOffsets, adjustment: Adjustment) -> ArmOffsets:
    covariance = HAND_EYE_COVARIANCE_SCALE * adjustment.offsets_covariance
    values = adjustment.offsets
    prior = adjustment.offsets_prior
    known = adjustment.offsets_known
    return replace(
        start, values=values, covariance=covariance, prior=prior, determined=known
    )


def _gripper_from_camera(prepared: PreparedFrames, mount: Mount | None) -> SE3 | None:
    """(n,) stated poses of the cameras in the gripper; None where camera poses were stated."""
    if mount is None:
        return None
    if not mount.moves:
        return prepared.stated
    return stated_grippers(prepared.frames).inverse() @ prepared.stated


def _moved(stated: SE3, camera: Camera, adjustment: Adjustment) -> bool:
    change = np.linalg.norm(
        (stated.inverse() @ adjustment.poses).log().reshape(-1, 2, 3), axis=2
    )
    metres, radians = np.median(change, 0)
    by_camera = 0.0
    if adjustment.cameras is not None:
        across = [np.linspace(0, side - 1, 9) for side in (camera.width, camera.height)]
        grid = np.stack(np.meshgrid(*across), -1)
        shift = adjustment.cameras[0].project(camera.unproject(grid)) - grid
        by_camera = float(np.nanmedian(np.linalg.norm(shift, axis=-1))) / camera.fx
    return (
        max(metres * np.median(adjustment.inverse_depth), radians, by_camera)
        > NOTICEABLE_RAD
    )


def _finish(
    name: str,
    prepared: _Prepared,
    tracks: list[KeyframeTracks],
    adjustment: Adjustment | None,
    options: MapOptions,
) -> BuiltMap:
    """The built map of all adjusted parts."""
    frames = prepared.frames
    numbers = [keyframe.frame for keyframe in tracks]
    first = frames.frames[0].camera
    camera = frames.cameras[0].resized(first.width, first.height)
    frame = MapFrame()
    hand_eye = None
    own = (
        None
        if options.metric
        else Similarity(SE3.identity(), prepared.unit, metric=False)
    )
    if adjustment is not None:
        block = np.einsum("nii->ni", adjustment.covariance[numbers])
        common = adjustment.common
        # Corrections are looked up at poses without what `common` undoes.
        undone = common if options.bundle.common_stated else SE3.identity()
        stated = adjustment.poses @ undone.inverse()
        correction = fit_correction(stated, adjustment.correction)
        frame = MapFrame(
            common=common,
            correction=correction,
            pose_sigma=(
                float(np.sqrt(block[:, :3].mean())),
                float(np.sqrt(block[:, 3:].mean())),
            ),
            frame_sigma=shared_sigma(stated, adjustment.correction, correction),
        )
        if not options.bundle.common_stated:
            # The common transform is part of the answer and not an error to undo.
            by_noise = np.asarray(adjustment.common_covariance, np.float64)
            if options.mount is not None and options.mount.moves:
                by_noise = HAND_EYE_COVARIANCE_SCALE * by_noise
            by_lens = np.asarray(adjustment.common_by_lens, np.float64)
            by_drift = np.asarray(adjustment.common_systematic, np.float64)
            names = [frame.name for frame in frames.frames]
            residuals = dict(zip(names, adjustment.errors, strict=True))
            moved = dict(zip(names, adjustment.correction, strict=True))
            arm = None
            if options.arm is not None and len(adjustment.offsets):
                arm = _offsets(options.arm, adjustment)
            hand_eye = HandEyeCorrection(
                common, by_noise - by_lens, by_lens, by_drift, residuals, moved, arm
            )
            base = frame_covariance(frames.stated @ common, hand_eye.covariance)
            frame = replace(frame, common=SE3.identity(), base_covariance=base)
    return BuiltMap(
        SceneMap(
            name=name,
            camera=first,
            adjusted_camera=camera,
            keyframes=_keyframes(frames, tracks),
            frame=replace(frame, similarity=own),
            unit=None if options.metric else prepared.unit,
            train_frames=len(frames),
        ),
        _adjusted(prepared, adjustment, camera),
        tuple(frames.frames[i].name for i in numbers),
        hand_eye,
    )


def _keyframes(frames: PreparedFrames, tracks: list[KeyframeTracks]) -> Keyframes:
    numbers = [keyframe.frame for keyframe in tracks]
    vlad = frames.encoder.vlad()
    return Keyframes(
        tuple(jpeg(frames.grey[i]) for i in numbers),
        tuple(frames.cameras[i] for i in numbers),
        frames.poses[np.array(numbers)],
        tuple(k.cell_inverse_depth.astype(np.float16) for k in tracks),
        tuple(k.landmarks.take(np.flatnonzero(k.confirmed)) for k in tracks),
        np.stack([vlad(frames.features(i)) for i in numbers]).astype(np.float16),
    )


def _adjusted(
    prepared: _Prepared, adjustment: Adjustment | None, camera: Camera
) -> Adjusted:
    frames = prepared.frames
    wrong = prepared.wrong
    untracked = prepared.untracked
    if adjustment is None:
        zero = (0.0, 0.0, 0.0)
        return Adjusted(zero, zero, 0.0, None, 0.0, 0.0, 0.0, wrong, untracked, ())
    tangent = adjustment.common.log()
    shift = 1000 * tangent[:3]
    rotation = np.rad2deg(tangent[3:])
    doubtful = np.flatnonzero(adjustment.weight < 0.25)
    stated = frames.frames[0].camera
    corners = (
        np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * (stated.width, stated.height) - 0.5
    )
    moved = np.linalg.norm(camera.project(stated.unproject(corners)) - corners, axis=-1)
    return Adjusted(
        common_translation_mm=(float(shift[0]), float(shift[1]), float(shift[2])),
        common_rotation_deg=(
            float(rotation[0]),
            float(rotation[1]),
            float(rotation[2]),
        ),
        focal_percent=100 * (camera.fx / stated.fx - 1),
        residual_px=adjustment.residual_px,
        pose_sigma_mm=1000 * adjustment.sigma_m,
        pose_sigma_deg=float(np.rad2deg(adjustment.sigma_rad)),
        time_shift_frames=adjustment.shift_frames,
        wrong_poses=wrong,
        untracked=untracked,
        doubtful_poses=tuple(frames.frames[i].name for i in doubtful),
        corner_px=float(np.fmax.reduce(moved, initial=0.0)),
        intrinsics=(stated.to_dict(), camera.to_dict()),
    )
