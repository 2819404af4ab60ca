"""`build_map`: a recording in, keyframes with adjusted poses and sub-pixel landmarks out."""

from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.features.encoder import Encoder
from evercal.features.vlad import vlad_for
from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.mapping.bundle_adjustment import (
    Adjustment,
    BundleAdjustment,
    BundleOptions,
)
from evercal.mapping.bundle_tracks import bundle_tracks
from evercal.mapping.frame_correction import FrameCorrection, fit_correction
from evercal.mapping.keyframes import Keyframes, jpeg
from evercal.mapping.pose_check import (
    PoseCheckOptions,
    contradicting_frames,
    depth_scale,
    matched_pairs,
)
from evercal.mapping.prepared_frames import PreparedFrames, WorkingSize
from evercal.mapping.scene_maps import frame_moved_by_cameras
from evercal.mapping.selection import select_farthest, spread_poses
from evercal.mapping.tracks import (
    KeyframeTracks,
    TrackOptions,
    open_keyframe,
    refine_depths,
)
from evercal.recordings.frame import Frame, stated_poses

Result = TypeVar("Result")


HAND_EYE_COVARIANCE_SCALE = 2.5
"""Alignment errors of a landmark go together over many frames, which the residuals cannot tell: the
squared error of `gripper_from_camera` in 30 trials was 1.8 times what they say
(docs/experiments/handeye.md)."""
NOTICED_RAD = 1e-4
"""Poses and lens are tracked again where they moved what is seen by more: some hundredths of a
pixel."""


@dataclass(frozen=True)
class MapOptions:
    """How a map is built."""

    size: WorkingSize = field(default_factory=WorkingSize)
    """Working sizes of images."""
    tracks: TrackOptions = field(default_factory=TrackOptions)
    """How landmarks are found in other frames."""
    bundle: BundleOptions = field(default_factory=BundleOptions)
    """Bundle adjustment."""
    check: PoseCheckOptions = field(default_factory=PoseCheckOptions)
    """When a stated pose is wrong."""
    support_frames: int = 250
    """Frames that take part beside the keyframes, spread evenly; more add time and no precision."""
    adjust: bool = True
    """Adjust poses and lens; else they are taken as stated."""
    rounds: int = 2
    """Rounds of tracking and adjusting; the second only where the first moved something."""

    def for_hand_eye(self) -> "MapOptions":
        """The same where stated poses come from a `gripper_from_camera` that is only a start.

        Arms place their gripper to some tenths of a millimetre, less than the images of one frame
        can tell: to take their poses for exact would make the answer surer than it is.
        """
        free = {
            "common_known": False,
            "common_sigma_m": 0.2,
            "common_sigma_deg": 10.0,
            "least_sigma_m": 2e-4,
            "least_sigma_deg": 0.015,
        }
        return replace(self, bundle=replace(self.bundle, **free))


@dataclass(frozen=True)
class Adjusted:
    """What bundle adjustment changed about a recording, for reports."""

    common_translation_mm: tuple[float, float, float]
    """Correction common to all stated poses, in the camera frame."""
    common_rotation_deg: tuple[float, float, float]
    """Its rotation vector."""
    focal_percent: float
    """By how much the focal length was changed."""
    residual_px: float
    """Median reprojection error afterwards."""
    pose_sigma_mm: float
    """Estimated error of the stated positions, standard deviation per axis."""
    pose_sigma_deg: float
    """The same of the stated rotations."""
    time_shift_frames: float
    """The images were taken this many frames after their stated poses."""
    wrong_poses: tuple[str, ...]
    """Frames whose stated pose contradicts the images; they were left out."""
    doubtful_poses: tuple[str, ...]
    """Frames whose stated pose is much further off than most; they were given less weight."""


@dataclass(frozen=True, eq=False)
class HandEyeCorrection:
    """What bundle adjustment found about where the camera sits on its gripper."""

    start_camera_from_camera: SE3
    """gripper_from_camera is its start times this."""
    covariance: NDArray[np.float64]
    """(6, 6), camera frame, translation in metres and rotation in radians."""


@dataclass(frozen=True, eq=False)
class SceneMap:
    """The map of one scene."""

    keyframes: Keyframes
    """With adjusted poses, landmarks and descriptors."""
    camera: Camera
    """The lens of the recording as adjusted, at the size of its first frame."""
    common: SE3
    """camera_from_stated_camera is its inverse: adjusted = stated @ common."""
    pose_sigma: tuple[float, float]
    """Uncertainty of the map itself against the stated frame: metres and radians per axis."""
    adjusted: Adjusted
    """What was changed."""
    bend: FrameCorrection | None = None
    """Corrections of stated poses that answers take back; None where none go together."""
    hand_eye: HandEyeCorrection | None = None
    """What the start of `gripper_from_camera` is corrected by; None where it was stated."""
    frame_covariance: NDArray[np.float64] | None = None
    """(6, 6) see `SceneRecord`."""
    names: tuple[str, ...] = ()
    """Of the frames that are keyframes."""

    def take(self, index: NDArray[np.int64]) -> "SceneMap":
        """The same map with some of its keyframes."""
        names = tuple(self.names[i] for i in index.tolist())
        return replace(self, keyframes=self.keyframes.take(index), names=names)

    def adjusted_frames(self, frames: Sequence[Frame]) -> list[Frame]:
        """Frames of the recording as the map sees them, without those whose pose is wrong.

        Poses are corrected by the shift in time and by what is common to all frames or to those
        nearby, and the lens is the adjusted one, so that a network learns the same points as the
        landmarks.

        Args:
            frames: the posed frames that the map was built from, in recorded order.
        """
        common = self.hand_eye.start_camera_from_camera if self.hand_eye else self.common
        moved = SE3.exp(self.adjusted.time_shift_frames * _velocity(frames))
        poses = stated_poses(frames) @ moved
        nominal, found = frames[0].camera, []
        for i, frame in enumerate(frames):
            if frame.name in self.adjusted.wrong_poses:
                continue
            pose = poses[i] @ common
            if self.bend is not None:
                pose = pose @ SE3.exp(self.bend.at(poses[i]))
            camera = self.camera if frame.camera == nominal else frame.camera
            found.append(replace(frame, base_from_camera=pose, camera=camera))
        return found


@dataclass(frozen=True)
class Mapping:
    """A map is being built."""

    what: str
    """Which part of the work."""
    done: int
    """Steps of it done."""
    total: int
    """Steps of it."""


def build_map(
    frames: Sequence[Frame],
    encoder: Encoder,
    chosen: Sequence[int] | NDArray[np.int64],
    options: MapOptions | None = None,
) -> SceneMap:
    """Builds the map of a scene; see `map_steps`."""
    return finished(map_steps(frames, encoder, chosen, options or MapOptions()))


def finished(steps: Generator[object, None, Result]) -> Result:
    """What a generator returns; what it yields is passed over."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return end.value


def map_steps(
    frames: Sequence[Frame],
    encoder: Encoder,
    chosen: Sequence[int] | NDArray[np.int64],
    options: MapOptions,
) -> Generator[Mapping, None, SceneMap]:
    """Builds the map of a scene step by step.

    Args:
        frames: posed training frames in recorded order.
        encoder: frozen local encoder.
        chosen: which of them are to be keyframes.
        options: how.

    Raises:
        InputError: no two frames see the same, so nothing can be triangulated.

    Yields:
        What is being done, for progress bars.

    Returns:
        The map.
    """
    recording, numbers, wrong = yield from _open(frames, encoder, chosen, options)
    keyframes = []

    def opened(frame: int) -> KeyframeTracks:
        keyframe = open_keyframe(recording, frame, options.tracks)
        refine_depths(recording, keyframe, options.tracks)
        return keyframe

    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        for keyframe in pool.map(opened, numbers):
            keyframes.append(keyframe)
            yield Mapping("mapping", len(keyframes), len(numbers))
    if not any(keyframe.kept.any() for keyframe in keyframes):
        raise InputError(
            "no two training frames see the same surfaces under parallax: record views from at"
            " least 10 cm apart, or check that the stated poses belong to these images"
        )
    place = {frame.name: i for i, frame in enumerate(frames)}
    velocity = _velocity(frames)[[place[frame.name] for frame in recording.frames]]
    adjustment = None
    if options.adjust:
        adjustment = yield from _adjust(recording, keyframes, velocity, options)
    return _finished(recording, keyframes, adjustment, wrong, options)


def _open(
    frames: Sequence[Frame],
    encoder: Encoder,
    chosen: Sequence[int] | NDArray[np.int64],
    options: MapOptions,
) -> Generator[Mapping, None, tuple[PreparedFrames, list[int], tuple[str, ...]]]:
    """Frames that take part, which of them are keyframes, and names of those left out."""
    wanted = {int(i) for i in chosen}
    support = sorted({*spread_frames(frames, options.support_frames).tolist(), *wanted})
    recording = PreparedFrames([frames[i] for i in support], encoder, options.size)
    for i in range(len(recording)):
        recording.features(i)
        yield Mapping("encoding", i + 1, len(recording))
    pairs = matched_pairs(recording, vlad_for(encoder), options.check)
    recording.depth_scale = depth_scale(recording, pairs)
    bad = contradicting_frames(recording, pairs, options.check)
    wrong = tuple(recording.frames[i].name for i in bad)
    keep = sorted(set(range(len(support))) - set(bad.tolist()))
    if len(bad):
        recording = recording.without(bad)
    places, turns = recording.stated.translation_m, recording.stated.rotation_wxyz
    good = [new for new, old in enumerate(keep) if support[old] in wanted]
    # Others take the place of those that were left out.
    keyframes = select_farthest(places, turns, len(wanted), start=good)
    return recording, keyframes.tolist(), wrong


def spread_frames(frames: Sequence[Frame], capacity: int) -> NDArray[np.int64]:
    """Posed frames spread over their poses, see `spread_poses`."""
    return spread_poses(stated_poses(frames), capacity)


def _velocity(frames: Sequence[Frame]) -> np.ndarray:
    """(n, 6) motion a frame, camera frame, where the frames before and after are its neighbours.

    Jumps of the recording (blocks left out) are told by steps much longer than the median one.
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
    recording: PreparedFrames,
    keyframes: list[KeyframeTracks],
    velocity: np.ndarray,
    options: MapOptions,
) -> Generator[Mapping, None, Adjustment]:
    stated_cameras = list(recording.cameras)
    adjustment = None
    for number in range(options.rounds):
        yield Mapping("adjusting", number, options.rounds)
        tracks = bundle_tracks(recording, keyframes, options.tracks)
        problem = BundleAdjustment(recording.stated, stated_cameras, velocity, options.bundle)
        adjustment = problem.solve(tracks)
        recording.adjust(adjustment.poses, adjustment.camera)
        if not _moved(recording.stated, stated_cameras[0], adjustment):
            break
        with ThreadPoolExecutor(torch.get_num_threads()) as pool:
            list(pool.map(partial(_refined_again, recording, options.tracks), keyframes))
    yield Mapping("adjusting", options.rounds, options.rounds)
    assert adjustment is not None
    return adjustment


def _refined_again(
    recording: PreparedFrames, options: TrackOptions, keyframe: KeyframeTracks
) -> None:
    refine_depths(recording, keyframe, options, again=True)


def _moved(stated: SE3, camera: Camera, adjustment: Adjustment) -> bool:
    """Whether poses and lens were adjusted by an amount that landmarks would notice.

    Args:
        stated: (n,) poses before.
        camera: the lens before, where all frames share one.
        adjustment: of both.
    """
    change = np.linalg.norm((stated.inverse() @ adjustment.poses).log().reshape(-1, 2, 3), axis=2)
    metres, radians = np.median(change, 0)
    lens = 0.0
    if adjustment.camera is not None:
        across = [np.linspace(0, side - 1, 9) for side in (camera.width, camera.height)]
        grid = np.stack(np.meshgrid(*across), -1)
        off = adjustment.camera.project(camera.unproject(grid)) - grid
        lens = float(np.nanmedian(np.linalg.norm(off, axis=-1))) / camera.fx
    return max(metres * np.median(adjustment.inverse_depth), radians, lens) > NOTICED_RAD


def _finished(
    recording: PreparedFrames,
    keyframes: list[KeyframeTracks],
    adjustment: Adjustment | None,
    wrong: tuple[str, ...],
    options: MapOptions,
) -> SceneMap:
    numbers = [keyframe.frame for keyframe in keyframes]
    vlad = vlad_for(recording.encoder)
    landmarks = []
    for keyframe in keyframes:
        kept = np.flatnonzero(keyframe.kept)
        landmarks.append(keyframe.landmarks.take(kept))
    complete = Keyframes(
        tuple(jpeg(recording.grey[i]) for i in numbers),
        tuple(recording.cameras[i] for i in numbers),
        recording.poses[np.array(numbers)],
        tuple(torch.from_numpy(k.cell_inverse_depth).half() for k in keyframes),
        tuple(landmarks),
        torch.stack([vlad(recording.features(i)) for i in numbers]).half(),
    )
    first = recording.frames[0].camera
    camera = recording.cameras[0].resized(first.width, first.height)
    common = adjustment.common if adjustment else SE3.identity()
    stated, hand_eye, loose = recording.stated, None, None
    if adjustment is not None and not options.bundle.common_known:
        # Nobody stated this transform: what was found is the answer, and nothing is taken back.
        common_covariance = np.asarray(adjustment.common_covariance, np.float64)
        spread_of_common = HAND_EYE_COVARIANCE_SCALE * common_covariance
        hand_eye = HandEyeCorrection(common, spread_of_common)
        stated, common = stated @ common, SE3.identity()
        loose = frame_moved_by_cameras(stated, spread_of_common)
    spread = (0.0, 0.0)
    if adjustment is not None:
        block = adjustment.covariance[numbers]
        variance = np.einsum("nii->ni", block)
        spread = (
            float(np.sqrt(variance[:, :3].mean())),
            float(np.sqrt(variance[:, 3:].mean())),
        )
    bend = None
    if adjustment is not None:
        bend = fit_correction(adjustment.poses @ common.inverse(), adjustment.correction)
    told = _adjusted(recording, adjustment, camera, wrong)
    names = tuple(recording.frames[i].name for i in numbers)
    return SceneMap(complete, camera, common, spread, told, bend, hand_eye, loose, names)


def _adjusted(
    recording: PreparedFrames, adjustment: Adjustment | None, camera: Camera, wrong: tuple[str, ...]
) -> Adjusted:
    if adjustment is None:
        zero = (0.0, 0.0, 0.0)
        return Adjusted(zero, zero, 0.0, float("nan"), 0.0, 0.0, 0.0, wrong, ())
    six = adjustment.common.log()
    shift, turn = 1000 * six[:3], np.rad2deg(six[3:])
    doubtful = np.flatnonzero(adjustment.weight < 0.25)
    return Adjusted(
        (float(shift[0]), float(shift[1]), float(shift[2])),
        (float(turn[0]), float(turn[1]), float(turn[2])),
        100 * (camera.fx / recording.frames[0].camera.fx - 1),
        adjustment.residual_px,
        1000 * adjustment.sigma_m,
        float(np.rad2deg(adjustment.sigma_rad)),
        adjustment.shift_frames,
        wrong,
        tuple(recording.frames[i].name for i in doubtful),
    )
