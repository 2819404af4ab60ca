"""The arm of the virtual cell: it states where it should be, and is nearly there."""

import threading
import time
from dataclasses import dataclass

import numpy as np

from evercal.geometry import SE3
from evercal.simulation.panda_arm import HOME_RAD, base_from_flange, joints_for

SPEED_RAD_S = 1.0
"""Speed of the fastest joint."""
_SETTLE_S = 0.1


class Clock:
    """Unix time, or a simulated one that passes only by `sleep`, at once."""

    def __init__(self, real: bool):
        self._now_s = None if real else 0.0

    def now(self) -> float:
        """Seconds since 1970, or since the start."""
        return time.time() if self._now_s is None else self._now_s

    def sleep(self, seconds: float) -> None:
        """Wait, or advance the simulated time."""
        if self._now_s is None:
            time.sleep(seconds)
        else:
            self._now_s += seconds


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion of the joints from one pose to the next."""

    start_rad: np.ndarray
    end_rad: np.ndarray
    start_s: float
    end_s: float
    start_error: SE3
    """gripper_stated_from_gripper before the motion."""
    end_error: SE3
    """The same after it."""

    def at(self, now_s: float) -> tuple[np.ndarray, SE3]:
        """Joint angles (7,) and error at a time; the motion is smooth at both ends."""
        t = np.clip(
            (now_s - self.start_s) / max(self.end_s - self.start_s, 1e-9), 0.0, 1.0
        )
        share = float(t * t * (3 - 2 * t))
        start = self.start_error
        joints = self.start_rad + share * (self.end_rad - self.start_rad)
        return joints, start @ SE3.exp(share * (start.inverse() @ self.end_error).log())


class VirtualRobot:
    """An arm that moves in joint space and stops with a small error that it does not state."""

    def __init__(self, clock: Clock, noise_m: float, noise_rad: float, seed: int):
        # Standard deviations of the true pose about the stated one, per axis.
        self._clock = clock
        self._sigma = np.repeat([noise_m, noise_rad], 3)
        self._rng = np.random.default_rng([seed, 32])
        self._lock = threading.Lock()
        error = self._draw()
        now = clock.now()
        self._motion = Motion(HOME_RAD, HOME_RAD, now, now, error, error)

    def base_from_gripper(self) -> SE3:
        """The stated pose of the flange."""
        return base_from_flange(self._motion.at(self._clock.now())[0])

    def joints_rad(self) -> tuple[float, ...]:
        """The seven stated joint angles, radians."""
        return tuple(self._motion.at(self._clock.now())[0].tolist())

    def move_to(self, base_from_gripper: SE3) -> None:
        """Move and return when the arm stands still; a second caller waits for the first."""
        with self._lock:
            now = self._clock.now()
            start, _ = self._motion.at(now)
            end = joints_for(base_from_gripper, start)
            seconds = float(np.abs(end - start).max()) / SPEED_RAD_S
            errors = self._motion.end_error, self._draw()
            self._motion = Motion(start, end, now, now + seconds, *errors)
            self._clock.sleep(seconds + _SETTLE_S)

    def true_state(self, now_s: float) -> tuple[SE3, np.ndarray]:
        """True base_from_gripper and joint angles (7,) at a time; for cameras and tests only."""
        joints, error = self._motion.at(now_s)
        return base_from_flange(joints) @ error, joints

    def _draw(self) -> SE3:
        return SE3.exp(self._sigma * self._rng.standard_normal(6))
