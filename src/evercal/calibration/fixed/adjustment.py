"""One adjustment of several cameras, and of the board at every moment.

For every sighting, `base_from_camera @ camera_from_board = base_from_board`; the first camera is
the base. Errors that sightings share, of intrinsics and of the board's size, are unknowns.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.stats import chi2, f

from evercal.calibration.evidence import plus
from evercal.calibration.fixed.sightings import Sightings, require_connected
from evercal.geometry import SE3, average_poses, cross_matrix, deviations
from evercal.geometry.normal_equations import normal_inverse
from evercal.typing import Array, BoolArray, IntArray

_GROSS = 0.001
"""Probability of a distance from which on a sighting counts less."""
_USED = 0.3
"""Weight below which a sighting contradicts the others."""
_FREEDOM = 4.0
"""Degrees of freedom below which the usual noise counts, too."""
_MOST = 8.0
"""Squared residual, medians of all, that outliers count as in the noise."""
_ROUNDS = 15


class Adjustment(NamedTuple):
    """All cameras in the frame of the first one."""

    cameras: SE3
    covariances: Array
    """(k, 6, 6) of each; zero for the first."""
    camera: IntArray
    """(n,) camera of each sighting."""
    used: BoolArray
    """(n,) whether it agrees with the others."""
    residual: Array
    """(n, 6) of the sightings."""


class _Rows(NamedTuple):
    """All n sightings."""

    camera: IntArray
    moment: IntArray
    poses: SE3
    covariance: Array
    """(n, 6, 6)."""
    shared: Array
    """(n, 6, q) by shared errors of one standard deviation."""

    @classmethod
    def of(
        cls,
        seen: Sequence[Sightings],
    ) -> "_Rows":
        names = np.concatenate([own.moments for own in seen])
        poses = SE3.stack([pose for own in seen for pose in own.poses])
        shared = block_diag(*[np.concatenate(own.shared) for own in seen])
        camera = np.repeat(np.arange(len(seen)), [len(own.images) for own in seen])
        size = np.array([own.size for own in seen])[camera, None]
        size = np.pad(size * poses.translation_m, ((0, 0), (0, 3)))
        return cls(
            camera,
            np.unique(names, return_inverse=True)[1],
            poses,
            np.concatenate([own.own for own in seen]),
            np.c_[shared, size.ravel()].reshape(len(poses), 6, -1),
        )

    def start(self) -> tuple[SE3, SE3]:
        """Place cameras one by one, beside those with which they share most moments."""
        placed = {0: SE3.identity()}
        count = int(self.camera.max()) + 1
        while len(placed) < count:
            found = []
            for new in {*range(count)} - {*placed}:
                theirs = np.flatnonzero(self.camera == new)
                ours = np.flatnonzero(np.isin(self.camera, [*placed]))
                i, j = np.nonzero(self.moment[ours][:, None] == self.moment[theirs])
                found.append((len(i), new, ours[i], theirs[j]))
            _, new, ours, theirs = max(found, key=lambda item: item[0])
            boards = (
                SE3.stack([placed[i] for i in self.camera[ours]]) @ self.poses[ours]
            )
            placed[new] = average_poses(boards @ self.poses[theirs].inverse())
        cameras = SE3.stack([placed[i] for i in range(count)])
        boards = cameras[self.camera] @ self.poses
        middles = []
        for moment in range(int(self.moment.max()) + 1):
            seen = boards[np.flatnonzero(self.moment == moment)]
            # The mean of two is as wrong as the worse one.
            middles.append(average_poses(seen) if len(seen) > 2 else seen[0])
        return cameras, SE3.stack(middles)

    def slopes(
        self,
        cameras: SE3,
        predicted: SE3,
    ) -> Array:
        """(n, 6, p) of the predictions by cameras but the first, boards and shared errors."""
        across = cameras[self.camera].rotation_matrix().transpose(0, 2, 1)
        by_camera = np.zeros((len(across), 6, 6))
        by_camera[:, :3, :3] = -across
        by_camera[:, :3, 3:] = cross_matrix(predicted.translation_m)
        by_camera[:, 3:, 3:] = -predicted.rotation_matrix().transpose(0, 2, 1)
        by_board = np.zeros((len(across), 6, 6))
        by_board[:, :3, :3] = across
        by_board[:, 3:, 3:] = np.eye(3)
        cameras_of = _spread(by_camera, self.camera)[:, :, 6:]
        boards_of = _spread(by_board, self.moment)
        return np.concatenate([cameras_of, boards_of, self.shared], 2)


def _spread(
    blocks: Array,
    number: IntArray,
) -> Array:
    """Blocks (n, 6, 6) in the columns (n, 6, 6 k) of their numbers."""
    chosen = np.eye(int(number.max()) + 1)[number]
    return np.einsum("nab,nk->nakb", blocks, chosen).reshape(len(blocks), 6, -1)


def adjust(
    seen: Sequence[Sightings],
) -> Adjustment:
    """Estimate all cameras robustly."""
    require_connected(seen)
    rows = _Rows.of(seen)
    cameras, boards = rows.start()
    effects = np.zeros(rows.shared.shape[2])
    unknown = 6 * (len(cameras) + len(boards)) - 6
    freedom = max((rows.poses.translation_m.size - unknown / 2), _FREEDOM)
    least = float(any(own.fit for own in seen))
    noise = np.ones(2)
    rounds = 0
    while True:
        predicted = cameras[rows.camera].inverse() @ boards[rows.moment]
        residual = deviations(rows.poses, predicted) - rows.shared @ effects
        scale = np.repeat(noise, 3)
        root = np.linalg.cholesky(rows.covariance * scale * scale[:, None])
        white = np.linalg.solve(root, residual[..., None])
        most = 6 * f.isf(_GROSS, 6, freedom)
        weights = np.minimum(1.0, most / (white**2).sum((1, 2)).clip(1e-12)) ** 2
        root /= weights[:, None, None] ** 0.5
        slope = np.concatenate(np.linalg.solve(root, rows.slopes(cameras, predicted)))
        pull = np.concatenate(np.linalg.solve(root, residual[..., None]))[:, 0]
        prior = np.pad(np.eye(len(effects)), (unknown, 0))
        covariance = normal_inverse(slope.T @ slope + prior, 1e-14)
        step = covariance @ (slope.T @ pull - prior[:, unknown:] @ effects)
        moved = np.r_[np.zeros(6), step[:unknown]].reshape(-1, 6)
        cameras = plus(cameras, moved[: len(cameras)])
        boards = plus(boards, moved[len(cameras) :])
        effects = effects + step[unknown:]
        noise *= _larger(white, freedom, noise, least)
        rounds += 1
        if rounds == _ROUNDS:
            break
    # By so much an ellipsoid is larger whose noise was estimated.
    told = [own.fit.freedom for own in seen if own.fit]
    few = 6 * f.isf(0.05, 6, min(told, default=max(freedom / 2, _FREEDOM)))
    few /= chi2.isf(0.05, 6)
    covariance = (covariance + covariance.T) / 2
    blocks = [np.zeros((6, 6))]
    for first in range(0, 6 * len(cameras) - 6, 6):
        blocks.append(few * covariance[first : first + 6, first : first + 6])
    return Adjustment(cameras, np.stack(blocks), rows.camera, weights > _USED, residual)


def _larger(
    white: Array,
    freedom: float,
    noise: Array,
    least: float,
) -> Array:
    """Factors (2,) of the noise of positions and rotations, by residuals in units of it."""
    squares = (white.reshape(-1, 2, 3) ** 2).sum(2)
    most = _MOST * np.median(squares, 0)
    squared = np.minimum(squares, most).mean(0) / (6 * freedom / white.size)
    if freedom <= _FREEDOM:
        squared += (1 - 0.5 * freedom / _FREEDOM) * (noise**-2.0 - squared)
    if least:
        squared[:] = squared.mean()  # that of corners correlates both
    return np.sqrt(np.maximum(squared, least * noise**-2.0))
