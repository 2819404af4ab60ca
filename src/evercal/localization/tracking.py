"""`Tracker`: the camera poses of a stream; the last pose and its motion are the prior.

A tracked frame is not encoded and not matched: landmarks of the keyframes next to the predicted
pose are aligned at once. The pose must pass the same acceptance as that of a single image. A frame
that does not is located from nothing, and so is one before repeated texture whose prediction leaves
several periods open.
"""

import time
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from evercal.errors import require_numbers
from evercal.geometry import SE3, Camera, pose_distance
from evercal.localization.answer import answer
from evercal.localization.estimate import PoseEstimate
from evercal.localization.hypothesis import Aligned, Hypothesis, accepted
from evercal.localization.intrinsics import INTRINSICS
from evercal.localization.localizer import Localizer
from evercal.localization.query import Candidate
from evercal.mapping.scene_map import SceneMap
from evercal.recordings.images import as_rgb
from evercal.typing import Array, Image, IntArray

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


@dataclass(frozen=True)
class TrackOptions:
    """How a stream is tracked."""

    keyframes: int = 4
    """Number of keyframes next to the predicted pose that are aligned."""
    fallback_s: float = 1 / 15
    """Time between frames without stamps, seconds."""
    longest_gap_s: float = 0.5
    """After a longer gap, seconds, the frame is located from nothing."""
    reach_m: float = 0.10
    """A pose that is farther from its prediction, metres, is verified by locating the frame."""
    reach_deg: float = 8.0
    """The same for the rotation, degrees."""
    settled: float = 2.0
    """Minimum support of the last pose, relative to the threshold, for using it as a prior."""
    at_most_ms: float | None = None
    """Time for a frame, milliseconds; what alignment misses is located in the background, `lost`
    meanwhile."""
    smooth: float = 0.0
    """Time constant of the smoothed pose in seconds; 0 returns measurements."""
    jump_sigmas: float = 4.0
    """Jumps above this many sigmas reset the smoothing."""

    def __post_init__(self) -> None:
        require_numbers(self, ("keyframes",), 1)
        require_numbers(self, ("fallback_s", "longest_gap_s", "smooth"), 0)
        require_numbers(self, ("reach_m", "reach_deg", "settled", "jump_sigmas"), 0)
        if self.at_most_ms is not None:
            require_numbers(self, ("at_most_ms",), 0)


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """A frame of a stream."""

    number: int
    """From 0."""
    stamp_s: float
    state: TrackState
    """`tracking`: located near its prediction. `relocalized`: located from nothing. `lost`: no
    pose."""
    estimate: PoseEstimate
    smoothed: SE3 | None = None
    """base_from_camera, smoothed; None where lost or without smoothing."""
    jumped: bool = False
    """Whether the smoothed pose was reset to this measurement."""


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
    _change: Array = field(default_factory=lambda: np.zeros(INTRINSICS))
    """(5,) change of the intrinsics of the last frame."""
    _smoothed: tuple[float, SE3] | None = None
    _number: int = 0
    _alignment_s: float = 0.0
    """Time of the last alignment."""
    _pool: ThreadPoolExecutor | None = None
    _running: tuple[float, Future[_Located]] | None = None
    """Time of a frame that is located in the background, and its result."""

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
            until = time.perf_counter() + self.options.at_most_ms / 1000
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
        estimate = self._near_prediction(image, stamp)
        if estimate is not None:
            return estimate, "tracking"
        before = self._poses[-1:]
        predicted = self._predicted(stamp)
        scene = self._scene
        estimate, pose = self.localizer.located(image, self.camera)
        self._poses.clear()
        if estimate.status != "ok" or pose is None:
            return estimate, "lost"
        self._remember(pose, stamp)
        same = bool(self._poses) and self._scene == scene
        if predicted is not None and same and self._trusted(pose, predicted, 1.0):
            self._poses = [*before, *self._poses]  # the motion goes on
        return estimate, "relocalized"

    def _located_in_time(
        self, image: Image, stamp: float, until: float
    ) -> tuple[PoseEstimate, TrackState]:
        """The same until a time of the clock; what takes longer goes on in the background."""
        began = time.perf_counter()
        adopted = self._adopted(until)
        estimate = self._near_prediction(image, stamp, until, adopted)
        if estimate is not None:
            if adopted:
                return estimate, "relocalized"
            return estimate, "tracking"
        self._poses.clear()
        if self._running is None:
            self._pool = self._pool or ThreadPoolExecutor(1, "search")
            future = self._pool.submit(self.localizer.located, image, self.camera)
            self._running = stamp, future
            finished = self._finished(until - _ANSWER_S)
            if finished is not None:
                estimate, pose = finished[1]
                if estimate.status != "ok" or pose is None:
                    return estimate, "lost"
                self._remember(pose, stamp)
                return estimate, "relocalized"
        spent = 1000 * (time.perf_counter() - began)
        searching = PoseEstimate.failed(_SEARCHING, spent)
        return replace(searching, omitted=("localization",)), "lost"

    def _finished(self, until: float) -> tuple[float, _Located] | None:
        """Time and result of the frame in the background; None if it is not ready in time."""
        if self._running is None:
            return None
        stamp, future = self._running
        if not wait([future], max(until - time.perf_counter(), 0.0)).done:
            return None
        self._running = None
        return stamp, future.result()

    def _adopted(self, until: float) -> bool:
        """Whether the frame in the background was located, so that its pose is the prior."""
        finished = self._finished(until - _MARGIN * self._alignment_s)
        if finished is None:
            return False
        stamp, (estimate, pose) = finished
        if estimate.status != "ok" or pose is None:
            return False
        self._remember(pose, stamp, settled=True)
        return True

    def _near_prediction(
        self,
        image: Image,
        stamp: float,
        until: float = np.inf,
        adopted: bool = False,
    ) -> PoseEstimate | None:
        """Align the landmarks around the predicted pose; None if that does not suffice.

        The pose of an earlier frame that is `adopted` is farther away and was not confirmed: the
        search is coarse, and the pose needs the support of a settled one.
        """
        began = time.perf_counter()
        predicted = self._predicted(stamp)
        if predicted is None:
            return None
        times = 1.0
        searches = [False, True]
        if adopted:
            times = self.options.settled
            searches = [True]
        query = self.localizer.query(image, self.camera)
        candidate = Candidate(self._scene, self._next_keyframes(predicted))
        for coarse in searches:
            start = time.perf_counter()
            if coarse and not adopted and start + _MARGIN * self._alignment_s > until:
                return None
            pose = self.localizer.poses.aligned(
                query, candidate, predicted, self._change, coarse
            )
            self._alignment_s = time.perf_counter() - start
            if pose is None or not self._trusted(pose, predicted, times):
                continue
            if self._may_have_slipped(pose, predicted, stamp):
                return None
            milliseconds = 1000 * (time.perf_counter() - began)
            estimate = answer(pose, self._map, image.shape[:2], milliseconds)
            if estimate.status != "ok":  # too uncertain to be useful
                return None
            self._remember(pose, stamp)
            return estimate
        return None

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

    def _next_keyframes(self, pose: SE3) -> IntArray:
        """Keyframes in the bank next to a pose, in metres and radians."""
        first = 0
        for scene in self.localizer.contents.scenes[: self._scene]:
            first += len(scene.keyframes)
        metres, radians = pose_distance(pose, self._map.keyframes.base_from_camera)
        spread = max(float(np.median(metres)), 1e-6)
        order = np.argsort(metres / spread + radians, kind="stable")
        return first + order[: self.options.keyframes]

    def _trusted(self, pose: Hypothesis, predicted: SE3, times: float) -> bool:
        """Whether a pose has enough support and is near its prediction."""
        if not accepted(pose, times):
            return False
        metres, radians = pose_distance(pose.pose.pose, predicted)
        near = self._at_room_scale(float(metres)) < self.options.reach_m
        return near and float(radians) < np.deg2rad(self.options.reach_deg)

    def _remember(self, pose: Hypothesis, stamp: float, settled: bool = False) -> None:
        self._scene = pose.scene
        self._change = np.zeros(INTRINSICS)
        if isinstance(pose, Aligned):
            self._change = pose.change
        if settled or self._poses or accepted(pose, self.options.settled):
            self._poses = [*self._poses[-1:], (stamp, pose.pose.pose)]

    def _smooth(self, estimate: PoseEstimate, stamp: float) -> tuple[SE3 | None, bool]:
        """Return the smoothed pose, and whether it follows a jump."""
        pose = estimate.uncertain_pose
        if self.options.smooth <= 0 or estimate.status != "ok" or pose is None:
            self._smoothed = None
            return None, False
        if self._smoothed is None:
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
