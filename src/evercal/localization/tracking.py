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

from evercal.geometry import SE3, Camera, pose_distance
from evercal.localization.acceptance import accepted, answer
from evercal.localization.estimate import PoseEstimate
from evercal.localization.intrinsics import cameras_in_scenes
from evercal.localization.localizer import Localizer
from evercal.localization.query import Candidate, Hypothesis
from evercal.recordings.images import as_rgb
from evercal.typing import Array, IntArray

TrackState = Literal["tracking", "relocalized", "lost"]
_Located = tuple[PoseEstimate, Hypothesis]
_SEARCHING = "localization takes longer than the time for a frame"
_MARGIN = 1.3
"""Time allowance for an alignment, relative to the previous one."""
_ANSWER_S = 0.002
"""Time to answer after waiting."""

MOST_SPEED_M_S, MOST_ACCELERATION_M_S2 = 1.0, 10.0
"""Motions of a camera that a prediction allows for; faster ones are rare on arms and in hands."""


@dataclass(frozen=True)
class TrackOptions:
    """How a stream is tracked."""

    keyframes: int = 4
    """Keyframes next to the predicted pose that are aligned."""
    fallback_s: float = 1 / 15
    """Time between frames without stamps."""
    longest_gap_s: float = 0.5
    """After a longer gap the frame is located from nothing."""
    reach_m: float = 0.10
    """A pose that is farther from its prediction is verified by locating the frame."""
    reach_deg: float = 8.0
    """The same for the rotation."""
    settled: float = 2.0
    """Minimum support of the last pose, relative to the threshold, for using it as a prior."""
    at_most_ms: float | None = None
    """Time for a frame; what alignment misses is located in the background, `lost` meanwhile."""
    smooth: float = 0.0
    """Time constant of the smoothed pose in seconds; 0 returns measurements."""
    jump_sigmas: float = 4.0
    """Deviation, in sigmas, of a jump: the smoothed pose follows at once."""


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """A frame of a stream."""

    number: int
    """From 0."""
    stamp_s: float
    state: TrackState
    """`tracking`: found near its prediction. `relocalized`: located from nothing. `lost`: no
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
    _change: Array | None = None
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
        stamp = number * self.options.fallback_s if stamp_s is None else stamp_s
        image = as_rgb(image)
        if self.options.at_most_ms is None:
            estimate, state = self._located(image, stamp)
        else:
            until = time.perf_counter() + self.options.at_most_ms / 1000
            estimate, state = self._located_in_time(image, stamp, until)
        smoothed, jumped = self._smooth(estimate, stamp)
        return TrackedFrame(number, stamp, state, estimate, smoothed, jumped)

    def frames(
        self, images: Iterable[np.ndarray | tuple[float, np.ndarray]]
    ) -> Iterator[TrackedFrame]:
        """Locate images, or times and images, in order."""
        for item in images:
            stamp, image = item if isinstance(item, tuple) else (None, item)
            yield self.track(image, stamp)

    def _located(
        self, image: np.ndarray, stamp: float
    ) -> tuple[PoseEstimate, TrackState]:
        estimate = self._near_prediction(image, stamp)
        if estimate is not None:
            return estimate, "tracking"
        before = self._poses[-1:]
        predicted = self._predicted(stamp)
        scene = self._scene
        estimate, found = self.localizer.located(image, self.camera)
        self._poses.clear()
        if estimate.status != "ok":
            return estimate, "lost"
        self._remember(found, stamp)
        same = bool(self._poses) and self._scene == scene
        if predicted is not None and same and self._trusted(found, predicted, 1.0):
            self._poses = [*before, *self._poses]  # the motion goes on
        return estimate, "relocalized"

    def _located_in_time(
        self, image: np.ndarray, stamp: float, until: float
    ) -> tuple[PoseEstimate, TrackState]:
        """The same until a time of the clock; what takes longer goes on in the background."""
        began = time.perf_counter()
        adopted = self._running is not None and self._adopted(until)
        estimate = self._near_prediction(image, stamp, until, adopted)
        if estimate is not None:
            return estimate, "relocalized" if adopted else "tracking"
        self._poses.clear()
        if self._running is None:
            self._pool = self._pool or ThreadPoolExecutor(1, "search")
            self._running = (
                stamp,
                self._pool.submit(self.localizer.located, image, self.camera),
            )
            if (done := self._taken(until - _ANSWER_S)) is not None:
                estimate, found = done[1]
                if estimate.status == "ok":
                    self._remember(found, stamp)
                return estimate, "relocalized" if estimate.status == "ok" else "lost"
        spent = 1000 * (time.perf_counter() - began)
        nothing = PoseEstimate("failed", _SEARCHING, None, None, None, 0, 0.0, spent)
        return replace(nothing, omitted=("localization",)), "lost"

    def _taken(self, until: float) -> tuple[float, _Located] | None:
        """Time and result of the frame in the background; None if it is not ready in time."""
        assert self._running is not None, "a frame was given"
        stamp, future = self._running
        if not wait([future], max(until - time.perf_counter(), 0.0)).done:
            return None
        self._running = None
        return stamp, future.result()

    def _adopted(self, until: float) -> bool:
        earlier = self._taken(until - _MARGIN * self._alignment_s)
        if earlier is None or earlier[1][0].status != "ok":
            return False
        stamp, (_, found) = earlier
        self._remember(found, stamp, settled=True)
        return True

    def _near_prediction(
        self,
        image: np.ndarray,
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
        settled = self.options.settled if adopted else 1.0
        localizer = self.localizer
        contents = self.localizer.contents
        cameras = cameras_in_scenes(self.camera, image, contents.scenes)
        query = localizer.query(image, self.camera)
        candidate = Candidate(self._scene, self._next_keyframes(predicted))
        change = np.zeros(5) if self._change is None else self._change
        for coarse in (True,) if adopted else (False, True):
            start = time.perf_counter()
            if coarse and not adopted and start + _MARGIN * self._alignment_s > until:
                return None
            found = localizer.aligned(
                query, candidate, cameras[self._scene], predicted, change, coarse
            )
            self._alignment_s = time.perf_counter() - start
            if found is not None and self._trusted(found, predicted, settled):
                if self._may_have_slipped(found, predicted, stamp):
                    return None
                milliseconds = 1000 * (time.perf_counter() - began)
                estimate = answer(
                    found, contents.scenes[found.scene], image.shape[:2], milliseconds
                )
                if estimate.status != "ok":  # too uncertain to be useful
                    return None
                self._remember(found, stamp)
                return estimate
        return None

    def _may_have_slipped(
        self, found: Hypothesis, predicted: SE3, stamp: float
    ) -> bool:
        """Whether a pose that lies a period of repeated texture away is as near the prediction."""
        assert found.pose is not None, "a trusted pose"
        steps = self.localizer.slips(found)
        if not len(steps):
            return False
        elapsed = stamp - self._poses[-1][0]
        unsure = MOST_SPEED_M_S * elapsed
        if len(self._poses) > 1:
            unsure = min(unsure, MOST_ACCELERATION_M_S2 / 2 * elapsed**2)
        off, _ = pose_distance(found.pose.pose, predicted)
        return self._at_room_scale(float(np.linalg.norm(steps[0]) - off)) < unsure

    def _at_room_scale(self, length: float) -> float:
        """A length of the map, see `SceneMap.at_room_scale`."""
        scene = self.localizer.contents.scenes[self._scene]
        return scene.at_room_scale(scene.frame.scale * length)

    def _predicted(self, stamp: float) -> SE3 | None:
        if not self._poses:
            return None
        (last, pose), before = self._poses[-1], self._poses[:-1]
        if not 0 <= stamp - last <= self.options.longest_gap_s:
            return None
        if not before or last <= before[0][0]:
            return pose
        share = (stamp - last) / (last - before[0][0])
        return pose @ SE3.exp(share * (before[0][1].inverse() @ pose).log())

    def _next_keyframes(self, pose: SE3) -> IntArray:
        keyframes = self.localizer.contents.scenes[self._scene].keyframes
        first = sum(
            len(s.keyframes) for s in self.localizer.contents.scenes[: self._scene]
        )
        metres, radians = pose_distance(pose, keyframes.base_from_camera)
        spread = max(float(np.median(metres)), 1e-6)
        order = np.argsort(metres / spread + radians, kind="stable")
        return first + order[: self.options.keyframes]

    def _trusted(self, found: Hypothesis, predicted: SE3, times: float) -> bool:
        if found.pose is None or not accepted(found, times):
            return False
        metres, radians = pose_distance(found.pose.pose, predicted)
        near = self._at_room_scale(float(metres)) < self.options.reach_m
        return near and float(radians) < np.deg2rad(self.options.reach_deg)

    def _remember(self, found: Hypothesis, stamp: float, settled: bool = False) -> None:
        if found.pose is None:
            return
        self._scene = found.scene
        self._change = None if found.refined is None else found.refined.change
        settled = settled or bool(self._poses)
        settled = settled or accepted(found, self.options.settled)
        self._poses = [*self._poses[-1:], (stamp, found.pose.pose)] if settled else []

    def _smooth(self, estimate: PoseEstimate, stamp: float) -> tuple[SE3 | None, bool]:
        """Return the smoothed pose, and whether it follows a jump."""
        pose = estimate.uncertain_pose
        if self.options.smooth <= 0 or estimate.status != "ok" or pose is None:
            self._smoothed = None
            return None, False
        if self._smoothed is None:
            self._smoothed = (stamp, pose.pose)
            return pose.pose, True
        last, before = self._smoothed
        jumped = pose.squared_mahalanobis(before) > 6 * self.options.jump_sigmas**2
        gain = 1 - np.exp(-max(stamp - last, 0.0) / self.options.smooth)
        now = (
            pose.pose
            if jumped
            else before @ SE3.exp(gain * (before.inverse() @ pose.pose).log())
        )
        self._smoothed = (stamp, now)
        return now, bool(jumped)
