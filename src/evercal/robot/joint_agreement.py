"""`JointTest`: readings of joint values, compared with the motions between images.

A reading is q = matrix @ values + offset. Thousands of readings are compared in a second.
"""

import numpy as np

from evercal.geometry import SE3, norms
from evercal.geometry.motions import PairMotions
from evercal.robot.arm import Arm
from evercal.robot.mount import Mount
from evercal.typing import Array

OFFSET = -3
"""Column of a reading: offset of a joint, radians, or metres of sliding joints."""
SPREAD = -2
"""Column of its standard deviation."""
FREEDOM = -1
"""Column of the standard deviation of the logarithm of a factor."""
_AT_ONCE = 400
"""Readings that are compared at once."""
_PARALLEL = 0.02
"""Ratio of turns about the second axis to those about the main one, below which all are alike."""
_OF_DIRECTIONS = 0.25
"""Weight of an angle between translations; that of a rotation is 1."""
_POSITION_M = {True: 0.2, False: 2.0}
"""Standard deviation of the position of a camera that moves with the gripper, or stands."""
_PRIOR = 1e-3
"""Weight of a deviation of parameters by one standard deviation."""
_STEP = 1e-4
"""Step of numerical derivatives."""
_ITERATIONS = 8
"""Number of iterations of a refinement."""
_LARGEST_STEP = 0.5
"""Largest change of an offset, radians, or of the logarithm of a factor in an iteration."""


class JointTest:
    """Joint values (n, k) of an arm beside the motions of a camera between n images.

    A reading is an array (k, k + 3): the matrix, and the columns above.
    """

    def __init__(
        self,
        arm: Arm,
        values: Array,
        motions: PairMotions,
        mount: Mount,
    ):
        used, ends = np.unique(motions.ends, return_inverse=True)
        self.arm = arm
        self.values = values[used]
        self.ends = ends
        self.motions = motions
        self.mount = mount
        count = values.shape[1]
        stated = self._between(np.eye(count, count + 3)[None])
        sizes = np.linalg.svd(stated.rotation.as_rotvec()[0], compute_uv=False)
        # Turns about one axis leave the camera's rotation about it open.
        parallel = sizes[1] < _PARALLEL * sizes[0]
        self.of_directions = 0.0 if parallel else _OF_DIRECTIONS

    def residuals(self, readings: Array) -> Array:
        """(h, 2, p, 3) differences of rotations and of directions, of h readings."""
        spread_m = _POSITION_M[self.mount.moves]
        turned, aside = self.motions.residuals(
            self._between(readings),
            _PRIOR * len(self.ends) / spread_m**2,
        )
        return np.stack([turned, self.of_directions * aside], 1)

    def _between(self, readings: Array) -> SE3:
        """(h, p) motions of what carries the camera."""
        frames, count = self.values.shape
        joints = self.values @ readings[:, :, :count].swapaxes(1, 2)
        joints += readings[:, None, :, OFFSET]
        poses = self.arm.poses(joints.reshape(-1, count))
        poses = self.mount.scene_from_parent(poses)
        firsts = frames * np.arange(len(readings))
        rows = firsts[:, None, None] + self.ends
        return poses[rows[..., 0]].inverse() @ poses[rows[..., 1]]

    def saturated(
        self,
        readings: Array,
        cap: float,
    ) -> Array:
        """(h, m) residuals of h readings, each divided so that its size is below 1."""
        residuals = self.residuals(readings)
        squares = (residuals**2).sum(3, keepdims=True)
        count = 2 * len(self.ends)
        scaled = residuals / np.sqrt((squares + cap**2) * count)
        return scaled.reshape(len(readings), -1)

    def costs(
        self,
        readings: Array,
        cap: float,
    ) -> Array:
        """(h,) mean of squares that saturate at `cap`."""
        costs = []
        for some in np.array_split(readings, 1 + len(readings) // _AT_ONCE):
            costs.append((self.saturated(some, cap) ** 2).sum(1))
        return np.concatenate(costs)

    def errors_deg(self, reading: Array) -> tuple[float, float]:
        """Median differences of rotations, and of directions."""
        medians = np.median(norms(self.residuals(reading[None])[0]), 1)
        turned, aside = np.rad2deg(medians).tolist()
        return turned, aside / _OF_DIRECTIONS

    def refined(
        self,
        readings: Array,
        cap: float,
    ) -> Array:
        """Readings with offsets and factors that fit best: Levenberg-Marquardt, all at once."""
        spread = readings[:, :, SPREAD:]
        used = spread.any(0)
        prior = np.sqrt(_PRIOR) / np.maximum(spread[:, used], _STEP)

        def moved(change: Array) -> Array:
            both = np.zeros(spread.shape)
            both[:, used] = change
            changed = readings.copy()
            changed[..., :OFFSET] *= np.exp(both[..., 1:])
            changed[..., OFFSET] += both[..., 0]
            return changed

        def errors(change: Array) -> Array:
            seen = self.saturated(moved(change), cap)
            return np.concatenate([seen, prior * change], 1)

        best = np.zeros(prior.shape)
        least = errors(best)
        damping = np.ones((len(best), 1, 1))
        identity = np.eye(used.sum())
        for _ in range(_ITERATIONS):
            slopes = []
            for step in _STEP * identity:
                slopes.append((errors(best + step) - least) / _STEP)
            sides = np.stack(slopes, 1)
            curvature = sides @ sides.swapaxes(1, 2) + damping * identity
            step = np.linalg.solve(curvature, sides @ least[..., None])[..., 0]
            trial = best - step.clip(-_LARGEST_STEP, _LARGEST_STEP)
            after = errors(trial)
            better = (after**2).sum(1) < (least**2).sum(1)
            best[better] = trial[better]
            least[better] = after[better]
            damping *= np.where(better, 0.25, 8.0)[:, None, None]
        return moved(best)
