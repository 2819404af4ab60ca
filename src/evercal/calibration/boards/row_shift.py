"""Shifts of corners that grow with the row: a rolling shutter, or images taken in motion.

All corners of an image share such a shift, so its size follows from the scatter of the images and
not from that of the corners.
"""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np

from evercal.calibration.boards.corners import MIN_SIGMA_PX, BoardPose
from evercal.typing import Array, ArrayPair, BoolArray

_MIN_CORNERS = 16
"""Minimum number of corners of an image that tells a shift from noise."""
_SIZES_PX = np.r_[0.0, np.geomspace(0.01, 30, 60)]
"""Standard deviations of the shift that are tried."""
_LEAST_SHARE = 0.02
"""Squared part of a shift that a pose leaves unexplained, over that of the clearest one, below
which it tells nothing."""
_LEAST_EVIDENCE = 4.0
"""Twice the logarithm of the likelihood ratio below which there is no shift."""


class CornerNoise(NamedTuple):
    """Noise of the corners of all images."""

    sigma_px: float
    """Standard deviation of a corner coordinate, over images that fit well."""
    row_shift_px: float = 0.0
    """Standard deviation of the shift of the last row of an image against the first."""

    @classmethod
    def plain(
        cls,
        poses: Sequence[BoardPose],
    ) -> Self:
        """Estimate the noise where there is no shift."""
        squared = np.array([pose.squared_px for pose in poses])
        freedom = np.array([max(2 * pose.corners - 6, 1) for pose in poses])
        return cls(float(np.sqrt(_variance(squared, freedom)[0])))

    @classmethod
    def of(
        cls,
        poses: Sequence[BoardPose],
        most_shift_px: float = np.inf,
    ) -> Self:
        """Estimate both from least-squares poses by maximum likelihood."""
        used = [pose for pose in poses if pose.corners >= _MIN_CORNERS]
        if not used or not most_shift_px:
            return cls.plain(poses)
        signals, sizes = np.stack([_shift(pose) for pose in used], 1)
        squared = np.array([pose.squared_px for pose in used])
        freedom = np.array([2 * pose.corners - 6 for pose in used])
        counted = sizes > 0
        rest = squared - signals.sum(1)
        variance, inliers = _variance(rest, freedom - counted.sum(1))
        signals = signals[inliers][counted[inliers]]
        sizes = sizes[inliers][counted[inliers]]
        tried = variance + _SIZES_PX[:, None] ** 2 * sizes
        costs = (np.log(tried) + signals / tried).sum(1)
        if costs[0] - costs.min() < _LEAST_EVIDENCE:
            return cls.plain(poses)
        shift_px = min(float(_SIZES_PX[costs.argmin()]), most_shift_px)
        return cls(float(np.sqrt(variance)), shift_px)

    def weighted(
        self,
        poses: Sequence[BoardPose],
    ) -> list[BoardPose]:
        """Return the poses that allow for the shift."""
        if not self.row_shift_px:
            return list(poses)
        ratio = self.row_shift_px / self.sigma_px
        return [pose.weighted(ratio) for pose in poses]


def _shift(pose: BoardPose) -> ArrayPair:
    """Squared signals (4,) of the shift, and their slopes (4,) by its variance.

    Both are 0 where a pose explains the shift, so that other errors would be taken for it.
    """
    jacobian, _, by_rows = pose.slopes
    free = by_rows - jacobian @ np.linalg.lstsq(jacobian, by_rows, rcond=None)[0]
    sizes, axes = np.linalg.eigh(free.T @ free)
    signals = (axes.T @ (free.T @ pose.residual_px.ravel())) ** 2
    tells = sizes > _LEAST_SHARE * sizes[-1]
    return np.where(tells, signals / sizes.clip(1e-12), 0.0), np.where(tells, sizes, 0)


def _variance(
    squared: Array,
    freedom: Array,
) -> tuple[float, BoolArray]:
    """Variance of a coordinate, and (n,) the images that fit well."""
    variance = squared / freedom
    inliers = variance <= 4 * np.median(variance) + 1e-12
    mean = squared[inliers].sum() / freedom[inliers].sum()
    return max(float(mean), MIN_SIGMA_PX**2), inliers
