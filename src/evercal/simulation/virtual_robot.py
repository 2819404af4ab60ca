"""The arm of the virtual cell: it states where it should be, and is nearly there."""

import threading
import time

import numpy as np
from numpy.random import default_rng

from evercal.classes import frozen_arrays
from evercal.geometry import SE3
from evercal.simulation.panda_arm import HOME_RAD, base_from_flange, joints_for
from evercal.typing import Array, Floats

SPEED_RAD_S = 1.0
"""Speed of the fastest joint, radians per second."""
_SETTLE_S = 0.1
"""Time after a motion until the arm stands still, seconds."""


class Clock:
    """Unix time, or a simulated one that passes only by `sleep`, at once."""

    def __init__(self, real: bool):
        self._real = real
        self._now_s = 0.0

    def now(self) -> float:
        """Seconds since 1970, or since the start."""
        if self._real:
            return time.time()
        return self._now_s

    def sleep(self, seconds: float) -> None:
        """Wait, or advance the simulated time."""
        if self._real:
            time.sleep(seconds)
        else:
            self._now_s += seconds


@frozen_arrays
class Motion:
    """A motion of the joints from one pose to the next."""

    start_rad: Array
    """(7,) joint angles before the motion."""
    end_rad: Array
    """(7,) joint angles after the motion."""
    start_s: float
    """Time at which the motion starts, seconds."""
    end_s: float
    """Time at which the motion ends, seconds."""
    start_error: SE3
    """gripper_stated_from_gripper before the motion."""
    end_error: SE3
    """gripper_stated_from_gripper after the motion."""

    def at(self, now_s: float) -> tuple[Array, SE3]:
        """Joint angles (7,) and error at a time; the motion is smooth at both ends."""
        seconds = max(self.end_s - self.start_s, 1e-9)
        passed = now_s - self.start_s
        t = np.clip(passed / seconds, 0.0, 1.0)
        share = float(t * t * (3 - 2 * t))
        turn = self.end_rad - self.start_rad
        joints = self.start_rad + share * turn
        change = (self.start_error.inverse() @ self.end_error).log()
        return joints, self.start_error @ SE3.exp(share * change)


class VirtualRobot:
    """An arm that moves in joint space and stops with a small error that it does not state."""

    def __init__(
        self,
        clock: Clock,
        noise_m: float,
        noise_rad: float,
        seed: int,
    ):
        # Standard deviations of the true pose about the stated one, per axis.
        self._clock = clock
        self._sigma = np.repeat([noise_m, noise_rad], 3)
        self._rng = default_rng([seed, 32])
        self._lock = threading.Lock()
        error = self._draw()
        now = clock.now()
        self._motion = Motion(
            start_rad=HOME_RAD,
            end_rad=HOME_RAD,
            start_s=now,
            end_s=now,
            start_error=error,
            end_error=error,
        )

    def base_from_gripper(self) -> SE3:
        """The stated pose of the flange."""
        return base_from_flange(self._stated_joints())

    def joints_rad(self) -> Floats:
        """The seven stated joint angles, radians."""
        return tuple(self._stated_joints().tolist())

    def move_to(self, base_from_gripper: SE3) -> None:
        """Move and return when the arm stands still; a second caller waits for the first."""
        with self._lock:
            now = self._clock.now()
            start, _ = self._motion.at(now)
            end = joints_for(base_from_gripper, start)
            largest_rad = np.abs(end - start).max()
            seconds = float(largest_rad) / SPEED_RAD_S
            self._motion = Motion(
                start_rad=start,
                end_rad=end,
                start_s=now,
                end_s=now + seconds,
                start_error=self._motion.end_error,
                end_error=self._draw(),
            )
            self._clock.sleep(seconds + _SETTLE_S)

    def true_state(self, now_s: float) -> tuple[SE3, Array]:
        """True base_from_gripper and joint angles (7,) at a time; for cameras and tests only."""
        joints, error = self._motion.at(now_s)
        return base_from_flange(joints) @ error, joints

    def _stated_joints(self) -> Array:
        joints, _ = self._motion.at(self._clock.now())
        return joints

    def _draw(self) -> SE3:
        return SE3.exp(self._sigma * self._rng.standard_normal(6))
