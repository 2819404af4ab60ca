"""The gripper of a running robot, by the transforms of tf."""

import threading
import time

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.live.ros2.graph import FIND_S, Graph
from evercal.recordings.formats.bags.file import TF
from evercal.recordings.formats.bags.tf_tree import BASES, GRIPPERS, TfTree
from evercal.robot.frame_names import UNKNOWN, FrameNames

_MOST = 500
"""Transforms of a frame that are kept: seconds of them."""
_DEPTH = 2_000
"""Messages that may arrive between two looks."""


class Ros2Robot:
    """Poses of the gripper frame in the base frame, see `Robot` and `TimedRobot`.

    A frame that is not named is the one with a usual name, as in a bag.
    """

    def __init__(self, frames: FrameNames = UNKNOWN):
        graph = Graph()
        self._topics = (
            graph.subscribe("/tf_static", TF[0], True, True, _DEPTH),
            graph.subscribe("/tf", TF[0], True, False, _DEPTH),
        )
        self._tree = TfTree("ros2:/tf", most=_MOST)
        self._zero_ns = time.time_ns()
        self._lock = threading.Lock()
        self.frames = frames
        """Names of the frames, of both once a pose was read."""

    def base_from_gripper(self) -> SE3:
        """The pose by the next transforms that arrive; InputError if none do."""
        return self._pose(None)

    def at(self, stamp_s: float) -> SE3:
        """The pose at a time, seconds, interpolated; InputError where tf has none."""
        return self._pose(stamp_s - self._zero_ns * 1e-9)

    def _pose(self, stamp_s: float | None) -> SE3:
        end = time.monotonic() + FIND_S
        before = np.inf
        problem = ""
        with self._lock:
            while time.monotonic() < end:
                self._listen()
                try:
                    base, gripper = self._named()
                    until = self._tree.until(base, gripper)  # infinite: nothing moves
                    before = min(before, until)
                    wanted = until if stamp_s is None else stamp_s
                    times = np.array([wanted])
                    poses, valid = self._tree.a_from_b(base, gripper, times)
                    is_new = until > before or before == np.inf
                    if valid[0] and (stamp_s is not None or is_new):
                        return poses[0]
                    what = f"ros2:/tf: no pose of {gripper} in {base}"
                    problem = f"{what} arrives any more; check its publisher"
                    if stamp_s is not None:
                        problem = (
                            f"{what} at the time of the image, {until - wanted:.2f} s before the"
                            " last one; are the clocks the same?"
                        )
                except InputError as error:  # the tree grows
                    problem = str(error)
                time.sleep(0.005)
        if not self._tree.frames():
            problem = (
                "ros2:/tf: nothing arrives; check the robot's driver and ROS_DOMAIN_ID"
            )
        raise InputError(problem)

    def _listen(self) -> None:
        for topic in self._topics:
            for message in topic.take():
                self._tree.add_message(message, self._zero_ns)

    def _named(self) -> tuple[str, str]:
        """The frames that were named, else those with usual names."""
        names = self.frames
        base = self._tree.frame(names.base, BASES, "base_frame")
        gripper = self._tree.frame(names.gripper, GRIPPERS, "gripper_frame")
        self.frames = FrameNames(base, gripper, names.camera)
        return base, gripper
