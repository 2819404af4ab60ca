"""The gripper of a running robot, by the transforms of tf."""

import threading
import time

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.live.ros2.graph import FIND_S, PREFIX, Graph, Subscription
from evercal.recordings.formats.bags.file import TF
from evercal.recordings.formats.bags.tf_tree import BASES, GRIPPERS, TfTree
from evercal.robot.frame_names import UNKNOWN, FrameNames

KEPT_S = 3.0
"""Time that transforms are kept, seconds."""
_DEPTH = 2_000
"""Messages that may arrive between two looks."""


class Ros2Robot:
    """Poses of the gripper frame in the base frame, see `Robot` and `TimedRobot`.

    A frame that is not named is the one with a usual name, as in a bag.
    """

    def __init__(self, frames: FrameNames = UNKNOWN):
        graph = Graph()
        self._moving = Subscription(graph, "/tf", TF[0], True, _DEPTH)
        self._static = Subscription(graph, "/tf_static", TF[0], True, _DEPTH)
        self._tree = TfTree(f"{PREFIX}/tf")
        self._zero_ns = time.time_ns()
        self._wanted = frames
        self._lock = threading.Lock()
        self.frames = UNKNOWN
        """Names of the frames, once a pose was read."""

    def base_from_gripper(self) -> SE3:
        """The pose by the next transforms that arrive; InputError if none do."""
        return self._wait(None)

    def at(self, stamp_s: float) -> SE3:
        """The pose at a time, seconds, interpolated; InputError where tf has none."""
        return self._wait(stamp_s - self._zero_ns * 1e-9)

    def _wait(self, stamp_s: float | None) -> SE3:
        with self._lock:
            self._take()
            before_s = -np.inf
            if self.frames is not UNKNOWN:
                before_s = self._until()
            end = time.monotonic() + FIND_S
            while True:
                try:
                    return self._pose(stamp_s, before_s)
                except InputError:  # the tree grows
                    if time.monotonic() > end:
                        raise
                time.sleep(0.005)
                self._take()

    def _pose(self, stamp_s: float | None, before_s: float) -> SE3:
        wanted = self._wanted
        base = self._tree.frame(wanted.base or None, BASES, "base_frame")
        gripper = self._tree.frame(wanted.gripper or None, GRIPPERS, "gripper_frame")
        self.frames = FrameNames(base, gripper)
        until = self._until()
        if stamp_s is None and until <= before_s < np.inf:
            raise InputError(
                f"{PREFIX}/tf: no new pose of {gripper} in {base} for {FIND_S:g} s; check its"
                " publisher"
            )
        if stamp_s is None:
            stamp_s = min(until, time.time())
        poses, valid = self._tree.a_from_b(base, gripper, np.array([stamp_s]))
        if not valid[0]:
            raise InputError(
                f"{PREFIX}/tf: no pose of {gripper} in {base} at the time of the image,"
                f" {until - stamp_s:+.2f} s before the last one; are the clocks the same?"
            )
        return poses[0]

    def _until(self) -> float:
        return self._tree.until(self.frames.base, self.frames.gripper)

    def _take(self) -> None:
        times = []
        for source in (self._static, self._moving):
            for message in source.take():
                times += self._tree.add_message(message, self._zero_ns)
        if times:
            self._tree.forget(max(times) - KEPT_S)
