"""Selection of the frames of a scene that are stored, from their camera poses alone.

All selectors work inside one scene, take the poses in recorded order and return the selected
indices in recorded order. Poses are positions in metres, ``(n, 3)``, and unit quaternions
wxyz, ``(n, 4)``, in any frame.

The metric is the one of SARS (spatial-aware replay)::

    D(a, b) = |p_a - p_b| / longest side + rotation_weight * 2 arccos |q_a . q_b|

with the longest side of the axis-aligned box around the scene's cameras (1 if all cameras have
one position). The angle is computed as ``4 arcsin(chord / 2)``, where ``chord`` is the shorter of
``|q_a - q_b|`` and ``|q_a + q_b|``. The two are equal, but arccos near 1 is exact to 3e-8 rad only,
while the chord of identical rotations (``q`` and ``-q`` included) is exactly 0. D is symmetric to
the last bit, so ties are real ties.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evercal.geometry.se3 import SE3


@dataclass(frozen=True)
class SarsOptions:
    """When SARS rejects a pose as redundant."""

    radius: float = 0.5
    """Exclusion radius r (scene sides + weighted radians): closer frames are rejected."""
    rotation_weight: float = 1.0
    """Weight lambda of the rotation angle (scene sides per radian)."""
    fill: bool = False
    """Ignore `radius` and use the largest one that fills the capacity."""

    def __post_init__(self) -> None:
        """Refuse negative or non-finite numbers."""
        for name in ("radius", "rotation_weight"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"SarsOptions.{name} is {value}; it is a finite number >= 0")


@dataclass(frozen=True)
class PoseSpace:
    """The poses of one scene, scaled for the metric and stored one component per row.

    Attributes:
        positions: ``(3, n)`` positions divided by the longest side of their box.
        quaternions: ``(4, n)`` unit quaternions, wxyz.
        rotation_weight: scene sides per radian.
    """

    positions: np.ndarray
    quaternions: np.ndarray
    rotation_weight: float

    @classmethod
    def of(
        cls, positions_m: np.ndarray, quaternions_wxyz: np.ndarray, rotation_weight: float = 1.0
    ) -> PoseSpace:
        """Check, scale and transpose ``(n, 3)`` positions and ``(n, 4)`` quaternions.

        Raises:
            ValueError: A wrong shape, a number that is not finite, or a zero quaternion.
        """
        positions = np.asarray(positions_m, dtype=np.float64)
        quaternions = np.asarray(quaternions_wxyz, dtype=np.float64)
        if positions.ndim != 2 or positions.shape[1] != 3:
            raise ValueError(f"positions_m has shape {positions.shape}; give (n, 3)")
        if quaternions.shape != (len(positions), 4):
            raise ValueError(
                f"quaternions_wxyz has shape {quaternions.shape}; give ({len(positions)}, 4)"
            )
        norms = np.linalg.norm(quaternions, axis=1, keepdims=True)
        bad = ~np.isfinite(positions).all(axis=1) | ~np.isfinite(norms[:, 0]) | (norms[:, 0] == 0)
        if bad.any():
            raise ValueError(
                f"pose {int(np.argmax(bad))} is not finite or has a zero quaternion; "
                "leave untracked frames out"
            )
        side = float(np.ptp(positions, axis=0).max()) if len(positions) else 0.0
        return cls(
            np.ascontiguousarray((positions / (side or 1.0)).T),
            np.ascontiguousarray((quaternions / norms).T),
            rotation_weight,
        )

    def __len__(self) -> int:
        """Return the number of poses."""
        return self.positions.shape[1]

    def distances(self, index: int, others: PoseSpace | None = None) -> np.ndarray:
        """Return D from pose `index` to every pose of `others` (default: of this space)."""
        others = self if others is None else others
        step = others.positions - self.positions[:, index, None]
        quaternion = self.quaternions[:, index, None]
        difference = others.quaternions - quaternion
        step *= step
        difference *= difference
        chord_squared = difference.sum(axis=0)
        far = np.flatnonzero(chord_squared > 2.0)  # q and -q are one rotation
        if far.size:
            difference = others.quaternions[:, far] + quaternion
            difference *= difference
            chord_squared[far] = difference.sum(axis=0)
        angle = np.arcsin(np.sqrt(chord_squared) * 0.5)
        angle *= 4.0 * self.rotation_weight
        angle += np.sqrt(step.sum(axis=0))
        return angle

    def from_frame(self, first: int) -> PoseSpace:
        """Return a view of the poses from frame `first` on."""
        return PoseSpace(
            self.positions[:, first:], self.quaternions[:, first:], self.rotation_weight
        )

    def take(self, indices: np.ndarray) -> PoseSpace:
        """Return a copy of the poses at `indices`."""
        # np.take keeps rows contiguous; fancy indexing would not, and distances are 3x slower.
        return PoseSpace(
            self.positions.take(indices, axis=1),
            self.quaternions.take(indices, axis=1),
            self.rotation_weight,
        )


class _DenseBuffer:
    """A full SARS buffer with the nearest neighbour of every member."""

    def __init__(self, space: PoseSpace, frames: np.ndarray) -> None:
        """Take the frames that filled the buffer; memory is ``len(frames) ** 2`` float64."""
        self.frames = frames.copy()
        self.poses = space.take(frames)
        self._space = space
        self._pairwise = np.stack([space.distances(int(f), self.poses) for f in frames])
        np.fill_diagonal(self._pairwise, np.inf)
        # Of several nearest neighbours the youngest is stored: older ones are evicted first, so
        # a camera at rest does not force a recomputation for every frame.
        self._witness = np.empty(len(frames), dtype=np.int64)
        self._nearest = np.empty(len(frames))
        self._search(np.arange(len(frames)))

    def _search(self, slots: np.ndarray) -> None:
        rows = self._pairwise[slots]
        nearest = rows.min(axis=1)
        self._nearest[slots] = nearest
        self._witness[slots] = np.where(rows == nearest[:, None], self.frames, -1).argmax(axis=1)

    def replace_densest(self, frame: int, row: np.ndarray) -> None:
        """Evict the member nearest to another one (ties: the older), then put `frame` there."""
        ties = np.flatnonzero(self._nearest == self._nearest.min())
        slot = int(ties[self.frames[ties].argmin()])
        self.frames[slot] = frame
        self.poses.positions[:, slot] = self._space.positions[:, frame]
        self.poses.quaternions[:, slot] = self._space.quaternions[:, frame]
        row[slot] = np.inf
        self._pairwise[slot] = row
        self._pairwise[:, slot] = row
        closer = row <= self._nearest
        orphans = self._witness == slot
        orphans &= ~closer
        orphans[slot] = True
        np.minimum(self._nearest, row, out=self._nearest)
        self._witness[closer] = slot
        self._search(np.flatnonzero(orphans))


def _accept_until_full(space: PoseSpace, radius: float, capacity: int) -> np.ndarray:
    """Return the frames SARS accepts before its buffer of `capacity` is full."""
    if radius == 0 or capacity == 0:
        return np.arange(min(capacity, len(space)))
    gap = np.full(len(space), np.inf)  # from each frame to its nearest accepted one
    accepted: list[int] = []
    frame = 0
    while len(accepted) < capacity:
        free = gap[frame:] >= radius
        ahead = int(free.argmax()) if free.size else 0
        if not free.size or not free[ahead]:
            break
        frame += ahead
        accepted.append(frame)
        later = gap[frame + 1 :]
        np.minimum(later, space.distances(frame, space.from_frame(frame + 1)), out=later)
        frame += 1
    return np.array(accepted, dtype=np.int64)


def _checked_capacity(capacity: int) -> int:
    if capacity < 0:
        raise ValueError(f"capacity is {capacity}; it is a number of frames >= 0")
    return int(capacity)


def spread_poses(poses: SE3, capacity: int) -> NDArray[np.int64]:
    """Select some of (n,) poses: by SARS with the largest radius that fills the capacity."""
    if len(poses) <= capacity:
        return np.arange(len(poses))
    fill = SarsOptions(fill=True)
    return select_sars(poses.translation_m, poses.rotation_wxyz, capacity, fill)


def select_sars(
    positions_m: np.ndarray,
    quaternions_wxyz: np.ndarray,
    capacity: int,
    options: SarsOptions | None = None,
) -> np.ndarray:
    """Select frames by Algorithm 1 of the paper, run once over the scene in recorded order.

    A frame closer than r to the buffer is rejected. Otherwise it is appended; if the buffer is
    full, the member with the smallest distance to another member leaves first. That distance
    does not count the new frame. A closest pair always ties, and the older of the two leaves.
    With a buffer of one frame, every accepted frame replaces the one before.

    At r = 0.5 few frames are selected. With r below the step from frame to frame, the closest pair
    is mostly the two newest frames, so a full buffer follows the camera and covers little of its
    path. ``fill`` avoids both.

    Args:
        positions_m: ``(n, 3)`` camera positions, metres.
        quaternions_wxyz: ``(n, 4)`` camera orientations.
        capacity: largest number of frames to select (N_b).
        options: radius, rotation weight, and whether to fill the buffer; see `fill_radius`.

    Returns:
        Selected indices, ascending; with ``fill`` exactly ``min(capacity, n)``, without it often
        fewer than `capacity`. Time O(n * capacity), memory O(n + capacity ** 2).

    Raises:
        ValueError: A negative capacity or an unusable pose.
    """
    options = options or SarsOptions()
    capacity = _checked_capacity(capacity)
    space = PoseSpace.of(positions_m, quaternions_wxyz, options.rotation_weight)
    radius = _largest_radius(space, capacity, 1e-5) if options.fill else options.radius
    accepted = _accept_until_full(space, radius, capacity)
    if len(accepted) < capacity or not len(accepted):
        return accepted
    if accepted[-1] == len(space) - 1:
        return accepted
    buffer = _DenseBuffer(space, accepted)
    for frame in range(int(accepted[-1]) + 1, len(space)):
        row = space.distances(frame, buffer.poses)
        if row.min() >= radius:
            buffer.replace_densest(frame, row)
    return np.sort(buffer.frames)


def _largest_radius(space: PoseSpace, capacity: int, tolerance: float) -> float:
    wanted = min(capacity, len(space))
    low, high = 0.0, math.sqrt(3.0) + math.pi * space.rotation_weight + tolerance
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
    positions_m: np.ndarray,
    quaternions_wxyz: np.ndarray,
    capacity: int,
    rotation_weight: float = 1.0,
    start: Sequence[int] = (),
) -> np.ndarray:
    """Farthest-point sampling of poses.

    Starting from `start`, or the first frame, the frame farthest from all selected ones is added
    until the capacity is reached; ties go to the earlier frame. The covering radius is at most
    twice the smallest one possible. Unlike SARS, it needs the whole scene at once.
    """
    space = PoseSpace.of(positions_m, quaternions_wxyz, rotation_weight)
    gap = np.full(len(space), np.inf)
    selected = list(start)
    for i in range(min(_checked_capacity(capacity), len(space))):
        if i == len(selected):
            selected.append(int(gap.argmax()))
        np.minimum(gap, space.distances(selected[i]), out=gap)
        gap[selected[: i + 1]] = -1.0  # another frame with the same pose can still be selected
    return np.sort(np.array(selected, np.int64))


def covering_radius(
    positions_m: np.ndarray,
    quaternions_wxyz: np.ndarray,
    selected: np.ndarray,
    rotation_weight: float = 1.0,
) -> float:
    """Largest distance D from any frame of the scene to its nearest selected frame.

    0 for a scene without frames; infinite if frames exist and none is selected.
    """
    space = PoseSpace.of(positions_m, quaternions_wxyz, rotation_weight)
    gap = np.full(len(space), np.inf)
    for frame in np.asarray(selected, dtype=np.int64):
        np.minimum(gap, space.distances(int(frame)), out=gap)
    return float(gap.max(initial=0.0))


def smallest_pair(
    positions_m: np.ndarray,
    quaternions_wxyz: np.ndarray,
    selected: np.ndarray,
    rotation_weight: float = 1.0,
) -> float:
    """Smallest distance D between two selected frames; infinite for fewer than two."""
    space = PoseSpace.of(positions_m, quaternions_wxyz, rotation_weight)
    index = np.asarray(selected, dtype=np.int64)
    near = [space.distances(int(a))[index[i + 1 :]].min() for i, a in enumerate(index[:-1])]
    return float(min(near, default=np.inf))
