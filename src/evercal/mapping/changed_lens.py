"""Whether the focal length changed while a recording was made: a lens that was focused again.

Bundle adjustment has one focal length for all frames. After it, the residuals of each frame show
how far its own one lies from that.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from scipy.stats import f

from evercal.geometry import Camera
from evercal.mapping.bundle_equations import BundleTracks, Linearised
from evercal.typing import Array

LEAST = 0.003
"""Smaller changes are none, as a share of the focal length: frames of one lens differ by 0.1 %."""
SIGNIFICANT = 6.0
"""Least change in standard deviations."""
EXPLAINED = 0.5
"""Share of the squared deviations that one step must explain."""
CHANCE = 1e-4
"""Probability that the best step among random deviations counts."""
FEWEST = 4
"""Least number of frames before and after a step."""
TYPICAL = 1.8
"""Least median of deviations from frame to frame, standard deviations; 0.67 by noise, and up to 1.3
in real images."""
LEAST_VARIANCE = 1e-7
"""Variance of the focal length of a frame by other errors, as a share: 0.03 % squared."""


class LensChange(NamedTuple):
    """A change of the focal length within a recording."""

    size: float = 0.0
    """Relative; that of one step, or the standard deviation from frame to frame. 0 for none."""
    first: int = -1
    """First frame after the step; -1 without one."""

    @classmethod
    def of(cls, focal: Array) -> Self:
        """From the changes (n, 2) of `focal_changes`: one step, or a scatter."""
        change, sigma = focal.T
        known = np.flatnonzero(np.isfinite(sigma))
        if len(known) < 2 * FEWEST:
            return cls()
        change = change[known]
        weight = 1 / (sigma[known] ** 2 + LEAST_VARIANCE)
        mean = np.average(change, weights=weight)
        squares = float((weight * (change - mean) ** 2).sum())
        best = cls()
        left = squares
        for split in range(FEWEST, len(known) - FEWEST + 1):
            parts = np.arange(len(known)) >= split
            before = np.average(change[~parts], weights=weight[~parts])
            after = np.average(change[parts], weights=weight[parts])
            rest = (weight * (change - np.where(parts, after, before)) ** 2).sum()
            if rest < left:
                left = float(rest)
                best = cls(float(after - before), int(known[split]))
        scatter = max(0.0, squares / len(known) - 1) / weight.mean()
        scatter = math.sqrt(scatter)
        # A few frames whose poses are wrong are no autofocus.
        typical = np.median(np.abs(change - mean) * np.sqrt(weight))
        if typical < TYPICAL:
            scatter = 0.0
        explained = squares - left
        freedom = len(known) - 2
        by_chance = f.isf(CHANCE / len(known), 1, freedom) * left / freedom
        if explained > max(EXPLAINED * squares, by_chance):
            size, first = best
        else:
            size, first = scatter, -1
            explained = squares - len(known)
        if abs(size) < LEAST or explained < SIGNIFICANT**2:
            return cls()
        return cls(size, first)


def focal_changes(
    tracks: BundleTracks,
    linearised: Linearised,
    cameras: Sequence[Camera],
    noise: float,
) -> Array:
    """(n, 2) relative change of the focal length of each frame, and its standard deviation.

    The pose of the frame is adjusted with it, the landmarks are not. NaN where undetermined.
    `noise` is that of whitened residuals.
    """
    squares = (linearised.residual**2).sum(1) / noise**2
    weight = np.sqrt(linearised.valid / (1 + squares)) / noise
    changes = np.full((len(cameras), 2), np.nan)
    for number, camera in enumerate(cameras):
        rows = np.flatnonzero(tracks.frame == number)
        if 2 * len(rows) <= FEWEST * 7:
            continue
        away = tracks.observed[rows] - [camera.cx, camera.cy]
        by_focal = np.einsum("nij,nj->ni", tracks.whitening[rows], away)
        slopes = np.concatenate(
            [linearised.by_frame[rows], by_focal[..., None]], axis=2
        )
        slopes = (weight[rows, None, None] * slopes).reshape(-1, 7)
        residual = (weight[rows, None] * linearised.residual[rows]).ravel()
        normal = slopes.T @ slopes
        if np.linalg.cond(normal) > 1e12:
            continue
        covariance = np.linalg.inv(normal)
        step = -covariance @ slopes.T @ residual
        changes[number] = step[6], math.sqrt(covariance[6, 6])
    return changes
