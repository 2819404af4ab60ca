"""`JointTest`: readings of joint values, compared with the motions between images.

A reading is q = matrix @ values + offset. The rotation of a camera between two images equals that
of the gripper up to one fixed rotation, and its translation does up to one fixed position. Both
have a closed form for each reading, so thousands of readings are compared in a second.
"""

from typing import NamedTuple

import numpy as np

from evercal.geometry import SE3, cross_matrix, norms
from evercal.robot.arm import Arm
from evercal.robot.mount import Mount
from evercal.typing import Array, IntArray

OFFSET = -3
"""Column of a reading: offset of a joint, radians, or metres of sliding joints."""
SPREAD = -2
"""Column of its standard deviation."""
FREEDOM = -1
"""Column of the standard deviation of the logarithm of a factor."""
_AT_ONCE = 400
"""Readings that are compared at once."""
_ANGLE = 0.15
"""Difference of angles at which a pair loses half its weight, radians."""
_ALIGNMENTS = 3
"""Number of weighted alignments of rotations."""
_PARALLEL = 0.02
"""Ratio of turns about the second axis to those about the main one, below which all are alike."""
_SHORT_M = 0.02
"""Motion below which the direction of a translation says little."""
_OF_DIRECTIONS = 0.25
"""Weight of an angle between translations; that of a rotation is 1."""
_POSITION_M = {True: 0.2, False: 2.0}
"""Standard deviation of the position of a camera that moves with the gripper, or stands."""
_PRIOR = 1e-3
"""Weight of a deviation of parameters by one standard deviation."""
_STEP = 1e-4
"""Step of numerical derivatives, standard deviations."""
_LARGEST_STEP = 0.5
"""Largest change of an offset or of the logarithm of a factor in an iteration."""


class PairMotions(NamedTuple):
    """Motions of a camera between p pairs of images, from the images alone."""

    ends: IntArray
    """(p, 2) numbers of the images."""
    turns: Array
    """(p, 3) `chords` of first_from_second."""
    directions: Array
    """(p, 3) unit vectors from the first camera to the second one, in the first."""


class JointTest:
    """Joint values (n, k) of an arm beside the motions of a camera between n images.

    A reading is an array (k, k + 3): the matrix, and the columns above.
    """

    def __init__(self, arm: Arm, values: Array, motions: PairMotions, mount: Mount):
        used, ends = np.unique(
            motions.ends,
            return_inverse=True,
        )
        self.arm = arm
        self.values = values[used]
        self.ends = ends.reshape(motions.ends.shape)
        self.motions = motions
        self.mount = mount
        stated = self._between(
            np.eye(
                values.shape[1],
                values.shape[1] + 3,
            )[None]
        )
        sizes = np.linalg.svd(
            chords(stated)[0],
            compute_uv=False,
        )
        # Turns about one axis leave the camera's rotation about it open.
        parallel = sizes[1] < _PARALLEL * sizes[0]
        self.of_directions = 0.0 if parallel else _OF_DIRECTIONS

    def residuals(self, readings: Array) -> Array:
        """(h, 2, p, 3) differences of rotations and of directions, of h readings."""
        between = self._between(readings)
        stated = chords(between)
        turns = self.motions.turns
        unlike = norms(stated) - norms(turns)
        rotation = np.eye(3)
        turned = stated
        for _ in range(_ALIGNMENTS):
            weighted = stated / (1 + (unlike / _ANGLE) ** 2)[..., None]
            left, _, right = np.linalg.svd(
                weighted.swapaxes(
                    1,
                    2,
                )
                @ turns
            )
            left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
            rotation = left @ right
            turned = stated @ rotation - turns
            unlike = norms(turned)
        directions = self.motions.directions @ rotation.swapaxes(
            1,
            2,
        )
        moved = self._moved(
            between,
            directions,
        )
        unit = moved / (norms(moved)[..., None] + _SHORT_M)
        aside = unit - directions * norms(unit)[..., None]
        return np.stack(
            [turned, self.of_directions * aside],
            1,
        )

    def _between(self, readings: Array) -> SE3:
        """(h, p) motions of what carries the camera."""
        frames, count = self.values.shape
        joints = self.values @ readings[:, :, :count].swapaxes(
            1,
            2,
        )
        joints += readings[:, None, :, OFFSET]
        poses = self.arm.poses(
            joints.reshape(
                -1,
                count,
            )
        )
        poses = self.mount.scene_from_parent(poses)
        rows = frames * np.arange(len(readings))[:, None, None] + self.ends
        return poses[rows[..., 0]].inverse() @ poses[rows[..., 1]]

    def _moved(self, between: SE3, directions: Array) -> Array:
        """(h, p, 3) translations of the camera at the position that fits the directions best."""
        lever = between.rotation_matrix() - np.eye(3)
        moved = between.translation_m
        across = cross_matrix(directions)
        slopes = across @ lever
        aside = across @ moved[..., None]
        prior = _PRIOR * len(self.ends) / _POSITION_M[self.mount.moves] ** 2
        position = np.zeros((len(moved), 1, 3, 1))
        for _ in range(2):
            off = norms((aside + slopes @ position)[..., 0])
            length = norms(moved + (lever @ position)[..., 0]) + _SHORT_M
            weights = 1 / (length**2 + (off / _ANGLE) ** 2)
            sides = (
                slopes.swapaxes(
                    2,
                    3,
                )
                * weights[..., None, None]
            )
            squares = (sides @ slopes).sum(1) + prior * np.eye(3)
            position = -np.linalg.solve(
                squares,
                (sides @ aside).sum(1),
            )[:, None]
        return moved + (lever @ position)[..., 0]

    def costs(self, readings: Array, cap: float) -> Array:
        """(h,) mean of squares that saturate at `cap`."""
        costs = []
        for start in range(
            0,
            len(readings),
            _AT_ONCE,
        ):
            some = self.residuals(readings[start : start + _AT_ONCE])
            costs.append(
                saturated(
                    some,
                    cap,
                )
            )
        return np.concatenate(costs)

    def errors_deg(self, readings: Array) -> Array:
        """(h, 2) median differences of rotations, and of directions."""
        medians = np.median(
            norms(self.residuals(readings)),
            2,
        )
        return np.rad2deg(medians) / (1, _OF_DIRECTIONS)

    def refined(self, readings: Array, cap: float, iterations: int) -> Array:
        """Readings after the refinement of offsets and factors: Levenberg-Marquardt."""
        spread = readings[:, :, SPREAD:].reshape(len(readings), -1)
        used = np.flatnonzero(spread.any(0))
        change = np.zeros_like(spread)
        largest = _LARGEST_STEP / np.maximum(spread, 1e-9)
        prior = _PRIOR * np.eye(len(used))
        damping = np.full(len(spread), 1e-2)
        residuals = self.residuals(readings)
        cost = saturated(residuals, cap)
        for _ in range(iterations):
            slopes = []
            for parameter in used:
                step = change.copy()
                step[:, parameter] += _STEP
                moved = self.residuals(_moved(readings, step))
                slopes.append((moved - residuals) / _STEP)
            slope = np.stack(slopes, -1).reshape(len(spread), -1, len(used))
            squares = (residuals**2).sum(3, keepdims=True)
            factor = (cap / (squares + cap**2)) ** 2 / squares[0].size
            weighted = slope * (factor + 0 * residuals).reshape(len(spread), -1, 1)
            curvature = weighted.swapaxes(1, 2) @ slope + prior
            size = np.trace(curvature, axis1=1, axis2=2) / max(len(used), 1)
            curvature += (damping * size)[:, None, None] * np.eye(len(used))
            sides = (weighted * residuals.reshape(len(spread), -1, 1)).sum(1)
            sides += _PRIOR * change[:, used]
            step = np.zeros_like(spread)
            step[:, used] = np.linalg.solve(curvature, sides[..., None])[..., 0]
            trial = change - step.clip(-largest, largest)
            moved = self.residuals(_moved(readings, trial))
            trial_cost = saturated(moved, cap) + _PRIOR * (trial**2).sum(1)
            better = trial_cost < cost
            change[better] = trial[better]
            residuals[better] = moved[better]
            cost[better] = trial_cost[better]
            damping *= np.where(better, 0.25, 8.0)
        return _moved(readings, change)


def _moved(readings: Array, change: Array) -> Array:
    """Readings after a change (h, 2 k) of offsets and factors, standard deviations."""
    moved = readings.copy()
    change = change.reshape(*readings.shape[:2], 2) * readings[..., SPREAD:]
    moved[..., :OFFSET] *= np.exp(change[..., 1:])
    moved[..., OFFSET] += change[..., 0]
    return moved


def chords(rotations: SE3) -> Array:
    """(..., 3) axis times twice the sine of half the angle, at most half a turn."""
    wxyz = rotations.rotation_wxyz
    return (
        2
        * wxyz[..., 1:]
        * np.where(
            wxyz[..., :1] < 0,
            -1,
            1,
        )
    )


def saturated(residuals: Array, cap: float) -> Array:
    """(h,) mean of squares of residuals (h, 2, p, 3) that saturate at `cap`."""
    squares = (residuals**2).sum(3)
    return (squares / (squares + cap**2)).mean((1, 2))
