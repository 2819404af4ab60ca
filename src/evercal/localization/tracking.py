"""`Tracker`: the camera poses of a stream; the last pose and the motion in the image are the prior.

A tracked frame is not encoded and not matched. The landmarks of the last image are followed by
optical flow, which predicts the pose to a pixel, and the landmarks of the map are aligned there.
Such a pose is no chance of a search, so it has a law of its own: it agrees with the motion in the
image, and about as many landmarks agree with it as in the frames before. Other frames are located
from nothing, and so are those before repeated texture whose prediction leaves several periods open.
Every n-th frame is located from nothing as well, and its pose replaces one that contradicts it.
"""

from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Literal

import numpy as np

from evercal.classes import frozen, frozen_arrays
from evercal.errors import require_numbers
from evercal.features.views import working_grey
from evercal.geometry import SE3, Camera, norms, pose_distance
from evercal.localization.acceptance import APART_SIGMAS
from evercal.localization.answer import answer
from evercal.localization.estimate import PoseEstimate
from evercal.localization.hypothesis import Aligned, Hypothesis, accepted
from evercal.localization.image_motion import followed
from evercal.localization.intrinsics import INTRINSICS
from evercal.localization.localizer import Localizer
from evercal.localization.query import Candidate
from evercal.mapping.scene_map import SceneMap
from evercal.recordings.images import as_rgb
from evercal.typing import Array, Image

TrackState = Literal["tracking", "relocalized", "lost"]
_Located = tuple[PoseEstimate, Hypothesis | None]
_SEARCHING = "localization takes longer than the time for a frame"
"""Reason of a frame that is located in the background."""
_MARGIN = 1.3
"""Time allowance for an alignment, relative to the previous one."""
_ANSWER_S = 0.002
"""Time to answer after waiting, seconds."""

MOST_SPEED_M_S = 1.0
"""Maximum speed of a camera that a prediction allows for; faster ones are rare on arms."""
MOST_ACCELERATION_M_S2 = 10.0
"""Maximum acceleration of a camera that a prediction allows for."""
MOST_MOVED_PX = 1.0
"""Maximum median distance of landmarks from where their motion in the image predicts them, pixels
at working size. From farther away alignment may end in another minimum (research/streams.md)."""
LEAST_OF_RATIO = 0.75
"""Minimum inlier ratio, relative to the highest one since a frame was located from nothing."""
MOST_CHANGES = 15
"""Number of frames, the median of whose intrinsics the next one starts with."""


@frozen
class TrackOptions:
    """How a stream is tracked."""

    checked: int = 16
    """Every n-th tracked frame in turn is also located from nothing."""
    fallback_s: float = 1 / 15
    """Time between frames without stamps, seconds."""
    longest_gap_s: float = 0.5
    """After a longer gap, seconds, the frame is located from nothing."""
    at_most_ms: float | None = None
    """Time for a frame, milliseconds; what alignment misses is located in the background, `lost`
    meanwhile."""
    smooth: float = 0.0
    """Time constant of the smoothed pose in seconds; 0 returns measurements."""
    jump_sigmas: float = 4.0
    """Jumps above this many sigmas reset the smoothing."""

    def __post_init__(self) -> None:
        require_numbers(self, ("checked",), 1)
        numbers = ("fallback_s", "longest_gap_s", "smooth", "jump_sigmas")
        require_numbers(self, numbers, 0)
        if self.at_most_ms is not None:
            require_numbers(self, ("at_most_ms",), 0)


@frozen_arrays
class TrackedFrame:
    """A frame of a stream."""

    number: int
    """From 0."""
    stamp_s: float
    state: TrackState
    """`tracking`: located near its prediction. `relocalized`: located from nothing, without a
    prediction or against it. `lost`: no pose."""
    estimate: PoseEstimate
    smoothed: SE3 | None = None
    """base_from_camera, smoothed; None where lost or without smoothing."""
    jumped: bool = False
    """Whether the smoothed pose was reset to this measurement."""


@frozen_arrays
class _Running:
    """A frame that is located in the background."""

    image: Image
    stamp: float
    tracked: PoseEstimate | None
    """Its tracked pose, which is checked."""
    future: Future[_Located]


@dataclass(eq=False)
class Tracker:
    """Locates the frames of one camera in order."""

    localizer: Localizer
    camera: Camera | None = None
    """Intrinsics. Default: those of the camera that recorded the scene."""
    options: TrackOptions = field(default_factory=TrackOptions)
    _scene: int = -1
    _poses: list[tuple[float, SE3]] = field(default_factory=list)
    """Times and poses map_from_camera of the last two frames."""
    _changes: list[Array] = field(default_factory=list)
    """Changes (5,) of the intrinsics of the last frames."""
    _ratio: float = 0.0
    """Highest inlier ratio since the last frame that was located from nothing, and its own."""
    _last: tuple[Image, Hypothesis] | None = None
    """The last located image, at working size, and its pose."""
    _unchecked: int = 0
    """Frames since one was located from nothing."""
    _smoothed: tuple[float, SE3] | None = None
    _number: int = 0
    _alignment_s: float = 0.0
    """Time of the last alignment."""
    _pool: ThreadPoolExecutor | None = None
    _running: "_Running | None" = None

    def track(self, image: np.ndarray, stamp_s: float | None = None) -> TrackedFrame:
        """Locate the next frame, an image as for `Localizer.localize`, at a time in seconds.

        Frames without a time are `fallback_s` apart.
        """
        number = self._number
        self._number = self._number + 1
        stamp = stamp_s
        if stamp is None:
            stamp = number * self.options.fallback_s
        image = as_rgb(image)
        if self.options.at_most_ms is None:
            estimate, state = self._located(image, stamp)
        else:
            until = perf_counter() + self.options.at_most_ms / 1000
            estimate, state = self._located_in_time(image, stamp, until)
        smoothed, jumped = self._smooth(estimate, stamp)
        return TrackedFrame(
            number,
            stamp,
            state,
            estimate,
            smoothed,
            jumped,
        )

    def frames(
        self, images: Iterable[np.ndarray | tuple[float, np.ndarray]]
    ) -> Iterator[TrackedFrame]:
        """Locate images, or times and images, in order."""
        for item in images:
            if isinstance(item, tuple):
                stamp, image = item
                yield self.track(image, stamp)
            else:
                yield self.track(item)

    def _located(self, image: Image, stamp: float) -> tuple[PoseEstimate, TrackState]:
        tracked = self._near_prediction(image, stamp)
        self._unchecked += 1
        if tracked and self._unchecked < self.options.checked:
            return tracked, "tracking"
        located = self.localizer.located(image, self.camera)
        if tracked and self._confirmed(tracked, located[0]):
            return tracked, "tracking"
        return self._relocalized(image, stamp, located)

    def _relocalized(
        self, image: Image, stamp: float, located: _Located
    ) -> tuple[PoseEstimate, TrackState]:
        """Go on from the pose of a frame that was located from nothing."""
        estimate, pose = located
        self._unchecked = 0
        self._ratio = 0.0
        if estimate.status != "ok" or not pose:
            self._poses.clear()
            return estimate, "lost"
        self._remember(pose, stamp, self._small(image))
        return estimate, "relocalized"

    def _confirmed(self, tracked: PoseEstimate, alone: PoseEstimate) -> bool:
        """Whether the location of a frame from nothing does not contradict its tracked pose."""
        pose = tracked.uncertain_pose
        other = alone.uncertain_pose
        if pose and other:
            squares = pose.squared_mahalanobis(other.pose)
            if tracked.scene != alone.scene or squares > APART_SIGMAS**2:
                return False
        self._unchecked = 0
        self._ratio = tracked.inlier_ratio
        return True

    def _located_in_time(
        self, image: Image, stamp: float, until: float
    ) -> tuple[PoseEstimate, TrackState]:
        """The same until a time of the clock; what takes longer goes on in the background."""
        began = perf_counter()
        adopted = self._adopted(until)
        tracked = self._near_prediction(image, stamp)
        self._unchecked += 1
        due = tracked is None or self._unchecked >= self.options.checked
        started = due and self._running is None
        if started:
            self._pool = self._pool or ThreadPoolExecutor(1, "search")
            future = self._pool.submit(self.localizer.located, image, self.camera)
            self._running = _Running(image, stamp, tracked, future)
        if tracked:
            if adopted:
                return tracked, "relocalized"
            return tracked, "tracking"
        self._poses.clear()
        if started:
            finished = self._finished(until - _ANSWER_S)
            if finished:
                return self._relocalized(image, stamp, finished.future.result())
        spent = 1000 * (perf_counter() - began)
        searching = PoseEstimate.failed(_SEARCHING, spent)
        return replace(searching, omitted=("localization",)), "lost"

    def _finished(self, until: float) -> "_Running | None":
        """The frame in the background; None if it is not located in time."""
        running = self._running
        if not running:
            return None
        if not wait([running.future], max(until - perf_counter(), 0.0)).done:
            return None
        self._running = None
        return running

    def _adopted(self, until: float) -> bool:
        """Whether the pose of the frame in the background is the prior from now on."""
        finished = self._finished(until - _MARGIN * self._alignment_s)
        if not finished:
            return False
        located = finished.future.result()
        tracked = finished.tracked
        if tracked and self._poses and self._confirmed(tracked, located[0]):
            return False
        _, state = self._relocalized(finished.image, finished.stamp, located)
        return state == "relocalized"

    def _near_prediction(self, image: Image, stamp: float) -> PoseEstimate | None:
        """Follow the landmarks of the last image and align; None if that does not suffice."""
        began = perf_counter()
        predicted = self._predicted(stamp)
        if not predicted or not self._last:
            return None
        localizer = self.localizer
        query = localizer.query(image, self.camera)
        # A stream has one camera: the next frame must not inherit the mistake of a single one.
        change = np.median(self._changes, axis=0)
        camera = query.camera(self._scene).changed(change)
        small = camera.short_side_resized(localizer.contents.short_side)
        grey = self._small(image)
        start = followed(*self._last, grey, small, predicted)
        if start is None:
            return None
        seen = localizer.poses.bank.seen(self._scene, start, camera)
        candidate = Candidate(self._scene, seen[: localizer.options.keyframes])
        pose = localizer.poses.aligned(query, candidate, start, change, coarse=False)
        self._alignment_s = perf_counter() - began
        if not pose or not self._trusted(pose, start, small):
            return None
        if self._may_have_slipped(pose, predicted, stamp):
            return None
        milliseconds = 1000 * (perf_counter() - began)
        estimate = answer(pose, self._map, image.shape[:2], milliseconds)
        if estimate.status != "ok":  # too uncertain to be useful
            return None
        self._remember(pose, stamp, grey)
        return estimate

    def _trusted(self, pose: Aligned, start: SE3, camera: Camera) -> bool:
        """Whether a pose is no local minimum: the law of poses that were not searched for."""
        if not accepted(pose):
            return False
        if pose.inlier_ratio < LEAST_OF_RATIO * self._ratio:
            return False
        before = camera.project(start.inverse().apply(pose.points_m))
        moved_px = np.median(norms(pose.pixels - before))
        return bool(moved_px < MOST_MOVED_PX)

    def _small(self, image: Image) -> Image:
        """An image at the size in which landmarks are followed."""
        return working_grey(image, self.localizer.contents.short_side)

    def _may_have_slipped(self, pose: Aligned, predicted: SE3, stamp: float) -> bool:
        """Whether a pose that lies a period of repeated texture away is as near the prediction."""
        steps = self.localizer.poses.slips(pose)
        if not len(steps):
            return False
        elapsed = stamp - self._poses[-1][0]
        uncertainty_m = MOST_SPEED_M_S * elapsed
        if len(self._poses) > 1:
            accelerated_m = MOST_ACCELERATION_M_S2 / 2 * elapsed**2
            uncertainty_m = min(uncertainty_m, accelerated_m)
        distance, _ = pose_distance(pose.pose.pose, predicted)
        margin = float(np.linalg.norm(steps[0]) - distance)
        return self._at_room_scale(margin) < uncertainty_m

    @property
    def _map(self) -> SceneMap:
        """The map of the scene of the last pose."""
        return self.localizer.contents.scenes[self._scene]

    def _at_room_scale(self, length: float) -> float:
        """A length of the map, see `SceneMap.at_room_scale`."""
        return self._map.at_room_scale(self._map.frame.scale * length)

    def _predicted(self, stamp: float) -> SE3 | None:
        """The pose at a time by constant velocity; None without a recent pose."""
        if not self._poses:
            return None
        last_stamp, pose = self._poses[-1]
        if not 0 <= stamp - last_stamp <= self.options.longest_gap_s:
            return None
        first_stamp, first = self._poses[0]
        if last_stamp <= first_stamp:
            return pose
        share = (stamp - last_stamp) / (last_stamp - first_stamp)
        step = (first.inverse() @ pose).log()
        return pose @ SE3.exp(share * step)

    def _remember(self, pose: Hypothesis, stamp: float, grey: Image) -> None:
        """Take a pose as that of the last frame; `grey` is its image at working size."""
        recent = []
        for before in self._poses[-1:]:
            if pose.scene == self._scene and stamp > before[0]:
                recent.append(before)
        if pose.scene != self._scene:
            self._changes.clear()
        change = np.zeros(INTRINSICS)
        if isinstance(pose, Aligned):
            change = pose.change
        self._changes = [*self._changes, change][-MOST_CHANGES:]
        self._scene = pose.scene
        self._ratio = max(self._ratio, pose.inlier_ratio)
        self._poses = [*recent, (stamp, pose.pose.pose)]
        self._last = grey, pose

    def _smooth(self, estimate: PoseEstimate, stamp: float) -> tuple[SE3 | None, bool]:
        """Return the smoothed pose, and whether it follows a jump."""
        pose = estimate.uncertain_pose
        if self.options.smooth <= 0 or estimate.status != "ok" or not pose:
            self._smoothed = None
            return None, False
        if not self._smoothed:
            self._smoothed = (stamp, pose.pose)
            return pose.pose, True
        last_stamp, before = self._smoothed
        smoothed = pose.pose
        jumped = pose.squared_mahalanobis(before) > 6 * self.options.jump_sigmas**2
        if not jumped:
            elapsed = max(stamp - last_stamp, 0.0)
            gain = 1 - np.exp(-elapsed / self.options.smooth)
            step = (before.inverse() @ pose.pose).log()
            smoothed = before @ SE3.exp(gain * step)
        self._smoothed = (stamp, smoothed)
        return smoothed, bool(jumped)
