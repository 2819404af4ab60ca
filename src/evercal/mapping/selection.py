"""Selection of the frames of a scene that are stored, from their camera poses alone.

All selectors work inside one scene, take the poses in recorded order and return the selected
indices in recorded order. Poses are positions in metres, ``(n, 3)``, and unit quaternions
wxyz, ``(n, 4)``, in any frame.

The metric is the one of SARS (spatial-aware replay)::

    D(a, b) = |(p_a - p_b) / unit| + rotation_weight * 2 arccos |q_a . q_b|

The paper does not state the unit of positions. By default it is the longest side of the
axis-aligned box around the scene's cameras (1 if all cameras have one position).

The angle is computed as ``4 arcsin(chord / 2)``, where ``chord`` is the shorter of ``|q_a - q_b|``
and ``|q_a + q_b|``. The two are equal, but arccos near 1 is exact to 3e-8 rad only, while the chord
of identical rotations (``q`` and ``-q`` included) is exactly 0. D is symmetric to the last bit, so
ties are real ties.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from evercal.classes import frozen
from evercal.errors import require_numbers
from evercal.geometry import norms
from evercal.geometry.se3 import SE3
from evercal.typing import Array, IntArray

UNITS: Mapping[str, Callable[[Array], Array | float]] = {
    "side": lambda positions_m: np.ptp(positions_m, axis=0).max(),
    "metre": lambda positions_m: 1.0,
    "axes": lambda positions_m: np.ptp(positions_m, axis=0),
    "reach": lambda positions_m: norms(positions_m - positions_m.mean(axis=0)).max(),
    "deviation": lambda positions_m: positions_m.std(axis=0),
}
"""Readings of the paper's normalised pose space: the unit of camera positions (n, 3), metres.

The longest side of their box, a metre, each side of the box, the distance of the farthest camera
from the mean, and the standard deviation along each axis."""


@frozen
class SarsOptions:
    """When SARS rejects a pose as redundant."""

    radius: float = 0.5
    """Exclusion radius r (units + weighted radians): closer frames are rejected."""
    rotation_weight: float = 1.0
    """Weight lambda of the rotation angle (units per radian)."""
    unit: str = "side"
    """Unit of positions, a key of `UNITS`."""
    fill: bool = False
    """Ignore `radius` and search one that fills the capacity.

    Bisection assumes that all smaller radii fill it, too. Where some do not, it may miss a larger
    one."""

    def __post_init__(self) -> None:
        """Refuse numbers outside their range.

        Raises:
            InputError: A negative or non-finite number.
        """
        require_numbers(self, ("radius", "rotation_weight"), 0)


@frozen
class PoseSpace:
    """The poses of one scene, scaled for the metric and stored one component per row."""

    positions: Array
    """(3, n) positions divided by their unit."""
    quaternions: Array
    """(4, n) unit quaternions, wxyz."""
    rotation_weight: float
    """Units per radian."""

    @classmethod
    def of(
        cls,
        positions_m: Array,
        quaternions_wxyz: Array,
        rotation_weight: float = 1.0,
        unit: str = "side",
    ) -> PoseSpace:
        """Check, scale and transpose ``(n, 3)`` positions and ``(n, 4)`` quaternions.

        Raises:
            ValueError: A wrong shape, a number that is not finite, or a zero quaternion.
        """
        positions = np.asarray(positions_m, float)
        quaternions = np.asarray(quaternions_wxyz, float)
        if positions.shape[1:] != (3,) or quaternions.shape != (len(positions), 4):
            raise ValueError(
                f"poses are (n, 3) and (n, 4), got {positions.shape} and {quaternions.shape}"
            )
        lengths = np.linalg.norm(quaternions, axis=1, keepdims=True)
        finite = np.isfinite(np.hstack([positions, lengths])).all(axis=1)
        bad = ~finite | (lengths[:, 0] == 0)
        if bad.any():
            raise ValueError(
                f"pose {int(np.argmax(bad))} is not finite or has a zero quaternion; "
                "leave untracked frames out"
            )
        scale = np.ones(3)
        if len(positions):
            scale *= UNITS[unit](positions)
        scale[scale <= 0] = 1.0
        return cls(
            np.ascontiguousarray((positions / scale).T),
            np.ascontiguousarray((quaternions / lengths).T),
            rotation_weight,
        )

    def __len__(self) -> int:
        """Return the number of poses."""
        return self.positions.shape[1]

    def distances(self, index: int, others: slice | IntArray = slice(None)) -> Array:
        """Return D from pose `index` to the poses of another index, by default to all."""
        here = self.positions[:, index, None]
        quaternion = self.quaternions[:, index, None]
        step = self.positions[:, others] - here
        turned = self.quaternions[:, others]
        # q and -q are one rotation.
        chords = [((turned + sign * quaternion) ** 2).sum(axis=0) for sign in (-1, 1)]
        angle = (
            4.0 * self.rotation_weight * np.arcsin(np.sqrt(np.minimum(*chords)) * 0.5)
        )
        return angle + np.sqrt((step**2).sum(axis=0))


def _accept_until_full(
    space: PoseSpace,
    radius: float,
    capacity: int,
) -> IntArray:
    """Return the frames SARS accepts before its buffer of `capacity` is full."""
    if radius == 0 or capacity == 0:
        return np.arange(min(capacity, len(space)))
    # From each frame to its nearest accepted one.
    gap = np.full(len(space), np.inf)
    accepted: list[int] = []
    frame = 0
    while len(accepted) < capacity:
        free = np.flatnonzero(gap[frame:] >= radius)
        if not len(free):
            break
        frame += int(free[0])
        accepted.append(frame)
        later = gap[frame + 1 :]
        np.minimum(later, space.distances(frame, slice(frame + 1, None)), out=later)
        frame += 1
    return np.array(accepted, np.int64)


def spread_poses(poses: SE3, capacity: int) -> IntArray:
    """Select some of (n,) poses: by SARS with a radius that fills the capacity."""
    if len(poses) <= capacity:
        return np.arange(len(poses))
    fill = SarsOptions(fill=True)
    return select_sars(poses.translation_m, poses.rotation_wxyz, capacity, fill)


def select_sars(
    positions_m: Array,
    quaternions_wxyz: Array,
    capacity: int,
    options: SarsOptions | None = None,
) -> IntArray:
    """Select frames by Algorithm 1 of the paper, run once over the scene in recorded order.

    A frame closer than r to the buffer is rejected. Otherwise it is appended; if the buffer is
    full, the member with the smallest distance to another member leaves first. That distance
    does not count the new frame. A closest pair always ties, and the older of the two leaves.
    With a buffer of one frame, every accepted frame replaces the one before.

    At r = 0.5 few frames are selected. With r below the step from frame to frame, a full buffer
    follows the camera and covers little of its path. ``fill`` avoids both.

    Args:
        positions_m: ``(n, 3)`` camera positions, metres.
        quaternions_wxyz: ``(n, 4)`` camera orientations.
        capacity: largest number of frames to select (N_b).
        options: radius, rotation weight, and whether to fill the buffer.

    Returns:
        Selected indices, ascending; with ``fill`` exactly ``min(capacity, n)``, without it often
        fewer than `capacity`. Time O(n * capacity), memory O(n + capacity ** 2).

    Raises:
        ValueError: A negative capacity or an unusable pose.
    """
    options = options or SarsOptions()
    if capacity < 0:
        raise ValueError(f"capacity is {capacity}; it is a number of frames >= 0")
    weight = options.rotation_weight
    space = PoseSpace.of(positions_m, quaternions_wxyz, weight, options.unit)
    radius = options.radius
    if options.fill:
        radius = _filling_radius(space, capacity, 1e-5)
    accepted = _accept_until_full(space, radius, capacity)
    if len(accepted) < capacity or not len(accepted):
        return accepted
    if accepted[-1] == len(space) - 1:
        return accepted
    frames = accepted.copy()
    pairwise = np.stack([space.distances(int(frame), frames) for frame in frames])
    np.fill_diagonal(pairwise, np.inf)
    nearest = pairwise.min(axis=1)
    for frame in range(int(accepted[-1]) + 1, len(space)):
        row = space.distances(frame, frames)
        if row.min() < radius:
            continue
        ties = np.flatnonzero(nearest == nearest.min())
        slot = int(ties[frames[ties].argmin()])
        orphans = nearest == pairwise[slot]
        orphans[slot] = True
        frames[slot] = frame
        row[slot] = np.inf
        pairwise[slot] = pairwise[:, slot] = row
        np.minimum(nearest, row, out=nearest)
        nearest[orphans] = pairwise[orphans].min(axis=1)
    return np.sort(frames)


def _filling_radius(
    space: PoseSpace,
    capacity: int,
    tolerance: float,
) -> float:
    wanted = min(capacity, len(space))
    low = 0.0
    high = math.sqrt(3.0) + math.pi * space.rotation_weight + tolerance
    if wanted <= 1:
        return high
    while high - low > tolerance:
        middle = 0.5 * (low + high)
        if len(_accept_until_full(space, middle, wanted)) == wanted:
            low = middle
        else:
            high = middle
    return low


def select_farthest(
    positions_m: Array,
    quaternions_wxyz: Array,
    capacity: int,
    rotation_weight: float = 1.0,
    start: Sequence[int] = (),
) -> IntArray:
    """Farthest-point sampling of poses.

    Starting from `start`, or the first frame, the frame farthest from all selected ones is added
    until the capacity is reached; ties go to the earlier frame. The covering radius is at most
    twice the smallest one possible. Unlike SARS, it needs the whole scene at once.
    """
    space = PoseSpace.of(positions_m, quaternions_wxyz, rotation_weight)
    gap = np.full(len(space), np.inf)
    selected = list(start)
    for i in range(min(capacity, len(space))):
        if i == len(selected):
            selected.append(int(gap.argmax()))
        np.minimum(gap, space.distances(selected[i]), out=gap)
        # Another frame with the same pose can still be selected.
        gap[selected[: i + 1]] = -1.0
    return np.sort(np.array(selected, np.int64))
