"""Confidence intervals of means and differences over frames of recordings and over seeds.

Neighbouring frames look alike, so they are right or wrong together. The independent units are
pieces of recording: runs of consecutive frames, or long blocks of a scene that was recorded in one
go (batch means; Flegal and Jones, Ann. Stat. 2010). Blocks of one path do not say how another path
would fare.

There are few pieces, often four a scene, and the bootstrap of few pieces is too narrow. Intervals
are therefore Student's t with the cluster-robust variance CR2 (Bell and McCaffrey, Surv. Methodol.
2002) and Satterthwaite's degrees of freedom, which accounts for pieces of unequal length.
`python -m benchmarks intervals` measures their coverage.
"""

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

LARGEST_STEP = 10
"""Steps of frame numbers, in usual steps, above which a new run begins."""


class Interval(NamedTuple):
    """A mean and its 95 % confidence interval, in the unit of the values."""

    mean: float
    low: float
    high: float


def frame_pieces(names: Sequence[str]) -> Labels:
    """Label the independent pieces of a recording, from the names of its frames.

    A piece is a run of consecutive frames. A run ends where the text before the frame number
    changes (`seq-03/frame-000039`, `seq-08/frame-000000`), where the number falls, or where it
    rises by more than `LARGEST_STEP` usual steps. A scene with a single run, with isolated frames,
    or with names without numbers is cut into `blocks`.

    Args:
        names: Names of a scene's frames in recorded order.

    Returns:
        Labels 0, 1, ... of the frames, shape (frames,).
    """
    parts = [re.fullmatch(r"(.*?)(\d+(?:\.\d+)?)(\.\w+)?", name, re.DOTALL) for name in names]
    if all(parts):
        prefix = np.array([part[1] for part in parts if part])
        steps = np.diff([float(part[2]) for part in parts if part])
        together = prefix[1:] == prefix[:-1]
        forward = steps[together & (steps > 0)]
        usual = float(np.median(forward)) if len(forward) else 1.0
        ends = ~together | (steps <= 0) | (steps > LARGEST_STEP * usual)
        if ends.any() and not ends.all():
            return np.concatenate([[0], np.cumsum(ends)]).astype(np.int64)
    return blocks(len(names))


def blocks(frames: int) -> Labels:
    """Label blocks of neighbouring frames: three for 39 frames, eight for 300, at least two.

    Number and length of the blocks grow with the square root of the number of frames.
    """
    count = max(math.isqrt(frames) // 2, 2)
    return np.arange(frames, dtype=np.int64) * count // max(frames, 1)


def mean_interval(
    scenes: Sequence[ArrayLike], pieces: Sequence[ArrayLike] | None = None
) -> Interval:
    """Estimate the mean over scenes of the mean over runs and frames, with its 95 % interval.

    Two variances add up: that of the pieces, which are the same for all runs, and that of the runs,
    which are the same for all scenes. Variance of one run on one piece counts in both, so intervals
    are slightly wide (Owen, The Pigeonhole Bootstrap, Ann. Appl. Stat. 2007). With a single run the
    interval covers the choice of frames only.

    Args:
        scenes: Finite numbers of each scene, typically correctness: (runs, frames) in recorded
            order, with equal runs in all scenes.
        pieces: Labels (frames,) of each scene from `frame_pieces`. Defaults to `blocks`.

    Raises:
        ValueError: Shapes do not match, or a scene is a single piece.
    """
    from scipy.stats import t

    values = [np.asarray(rows, dtype=np.float64) for rows in scenes]
    labels = [blocks(rows.shape[1]) for rows in values] if pieces is None else pieces
    mean = float(np.mean([rows.mean() for rows in values]))
    of_runs = np.mean([rows.mean(axis=1) for rows in values], axis=0)
    runs = len(of_runs)
    parts = [
        (variance / len(values) ** 2, freedom)
        for rows, piece in zip(values, labels, strict=True)
        for variance, freedom in [_of_pieces(rows.mean(axis=0), np.asarray(piece))]
    ]
    if runs > 1:
        parts.append((float(of_runs.var(ddof=1)) / runs, runs - 1))
    total = sum(variance for variance, _ in parts)
    if total <= 1e-24:  # rounding, for values around one
        return Interval(mean, mean, mean)
    freedom = total**2 / sum(variance**2 / freedom for variance, freedom in parts)
    half = float(t.ppf(0.975, freedom)) * total**0.5
    return Interval(mean, mean - half, mean + half)


def seeds_interval(values: ArrayLike, comparisons: int = 1) -> Interval:
    """Estimate a mean over runs with other seeds and orders, on the same rooms and test frames.

    Student's t over the runs. It covers the choice of seed and order, not that of rooms, paths or
    frames. With several comparisons all their intervals hold together in 95 % of repetitions
    (Bonferroni).

    Args:
        values: A finite number of each run, shape (runs,).
        comparisons: Number of comparisons that were named before the runs.

    Raises:
        ValueError: Fewer than two runs.
    """
    from scipy.stats import t

    each = np.asarray(values, dtype=np.float64)
    if len(each) < 2:
        raise ValueError(f"{len(each)} run: an interval over seeds needs two or more")
    mean, deviation = float(each.mean()), float(each.std(ddof=1))
    half = float(t.ppf(1 - 0.025 / comparisons, len(each) - 1)) * deviation / len(each) ** 0.5
    return Interval(mean, mean - half, mean + half)


def _of_pieces(values: Array, labels: Labels) -> tuple[float, float]:
    """Return the CR2 variance of the mean of (frames,) values, and its degrees of freedom.

    A long piece pulls the mean towards itself, which makes its residual too small; CR2 corrects
    this. The degrees of freedom assume that the means of all pieces vary alike.
    """
    _, piece, counts = np.unique(labels, return_inverse=True, return_counts=True)
    if len(counts) < 2:
        raise ValueError(f"a scene is one piece of {len(values)} frames; two are needed")
    share = counts / len(values)
    residual = np.bincount(piece, values - values.mean()) / len(values)
    variance = float((residual**2 / (1 - share)).sum())
    weight = np.sqrt(share**2 / (1 - share))
    products = np.eye(len(share)) - share[:, None] - share + (share**2).sum()
    matrix = weight[:, None] * products * weight
    return variance, float(np.trace(matrix) ** 2 / (matrix**2).sum())
