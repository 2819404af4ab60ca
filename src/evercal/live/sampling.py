"""Samples for a hand-eye calibration: images with the poses of an arm that stands still."""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import repeat

from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance_mm_deg
from evercal.live.coverage import SAME_DEG, SAME_MM
from evercal.live.robot import Robot, TimedRobot
from evercal.typing import Image

STILL_MM = 0.2
"""Change of the gripper's position, in millimetres, below which the arm stands still."""
STILL_DEG = 0.05
"""Change of the gripper's rotation, in degrees, below which the arm stands still."""
STILL_S = 0.5
"""Time that the arm stands before a sample, seconds: images arrive late from networks and USB."""


class MovedError(InputError):
    """The arm moved while an image was taken."""


def sample(read: Callable[[], tuple[float, Image]], robot: Robot) -> tuple[Image, SE3]:
    """An image by `LiveCamera.read` and its gripper pose; MovedError if the arm moved meanwhile."""
    before = robot.base_from_gripper()
    stamp_s, image = read()
    after = robot.base_from_gripper()
    if _apart(before, after, STILL_MM, STILL_DEG):
        raise MovedError("the arm moved while the image was taken; let it stand still")
    if isinstance(robot, TimedRobot):
        after = robot.at(stamp_s)
    return image, after


def samples(
    read: Callable[[], tuple[float, Image]],
    robot: Robot,
    known: Iterable[SE3] = (),
    asked: Iterable[object] | None = None,
) -> Iterator[tuple[Image, SE3]]:
    """A sample wherever the arm stands still at a pose that differs from all known ones.

    With `asked`, such as lines of the keyboard, one for each of its values, once the arm stands.
    """
    poses = [*known]
    for _ in asked or repeat(None):
        while not _stands(robot, poses if asked is None else []):
            pass
        with suppress(MovedError):
            image, pose = sample(read, robot)
            yield image, pose
            poses.append(pose)


def _stands(robot: Robot, known: Sequence[SE3]) -> bool:
    """Whether the arm stands for `STILL_S` at a pose that is not known."""
    end = time.monotonic() + STILL_S
    pose = robot.base_from_gripper()
    while time.monotonic() < end:
        time.sleep(0.02)
        if _apart(pose, robot.base_from_gripper(), STILL_MM, STILL_DEG):
            return False
    return all(_apart(old, pose, SAME_MM, SAME_DEG) for old in known)


def _apart(first: SE3, second: SE3, most_mm: float, most_deg: float) -> bool:
    millimetres, degrees = pose_distance_mm_deg(first, second)
    return bool(millimetres > most_mm or degrees > most_deg)
