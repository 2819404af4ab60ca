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
    values: ArrayLike | Sequence[ArrayLike], pieces: Sequence[ArrayLike] | None = None
) -> Interval:
    """Estimate the mean over scenes of the mean over runs and frames, with its 95 % interval.

    Two variances add up: that of the pieces, which are the same for all runs, and that of the runs,
    which are the same for all scenes. Variance of one run on one piece counts in both, so intervals
    are slightly wide (Owen, The Pigeonhole Bootstrap, Ann. Appl. Stat. 2007). With a single run the
    interval covers the choice of frames only. If all values are equal, its width is zero.

    Args:
        values: Typically per-frame correctness, frames in recorded order: an array (frames,) or
            (runs, frames) for one scene, or a list of such arrays, one per scene.
        pieces: Labels (frames,) of each scene from `frame_pieces`. Defaults to `blocks`.

    Raises:
        ValueError: Shapes do not match, values are not finite, or a scene is a single piece.
    """
    scenes = _scenes(values)
    given = [blocks(rows.shape[1]) for rows in scenes] if pieces is None else pieces
    labels = [np.asarray(piece) for piece in given]
    shapes = [piece.shape for piece in labels]
    if shapes != [rows.shape[1:] for rows in scenes]:
        frames = [rows.shape[1] for rows in scenes]
        raise ValueError(f"pieces have shapes {shapes}, expected (frames,) for frames {frames}")
    for i, piece in enumerate(labels):
        if len(np.unique(piece)) < 2:
            raise ValueError(f"scene {i} is one piece of {len(piece)} frames; two are needed")
    mean = float(np.mean([rows.mean() for rows in scenes]))
    half = _half_width(scenes, labels)
    return Interval(mean, mean - half, mean + half)


def paired_difference(
    a: ArrayLike | Sequence[ArrayLike],
    b: ArrayLike | Sequence[ArrayLike],
    pieces: Sequence[ArrayLike] | None = None,
) -> Interval:
    """Estimate how much better method `a` is than `b` on the same frames, with a 95 % interval.

    Args:
        a: Per-frame correctness, as for `mean_interval`.
        b: The same scenes, runs and frames in the same order.
        pieces: As for `mean_interval`.

    Raises:
        ValueError: As `mean_interval`, or `a` and `b` have different shapes.
    """
    first, second = _scenes(a), _scenes(b)
    shapes = [rows.shape for rows in first], [rows.shape for rows in second]
    if shapes[0] != shapes[1]:
        raise ValueError(f"a and b must have the same scenes, runs and frames, got {shapes}")
    return mean_interval([x - y for x, y in zip(first, second, strict=True)], pieces)


def _half_width(scenes: Sequence[Array], labels: Sequence[Labels]) -> float:
    from scipy.stats import t

    parts: list[tuple[float, float]] = []  # variance of the mean, degrees of freedom
    for rows, piece in zip(scenes, labels, strict=True):
        variance, freedom = _of_pieces(rows.mean(axis=0), piece)
        parts.append((variance / len(scenes) ** 2, freedom))
    runs = len(scenes[0])
    if runs > 1:
        means = np.mean([rows.mean(axis=1) for rows in scenes], axis=0)
        parts.append((float(means.var(ddof=1)) / runs, runs - 1))
    total = sum(variance for variance, _ in parts)
    if total <= 1e-24:  # rounding, for values around one
        return 0.0
    freedom = total**2 / sum(variance**2 / freedom for variance, freedom in parts)
    return float(t.ppf(0.975, freedom)) * total**0.5


def _of_pieces(values: Array, labels: Labels) -> tuple[float, float]:
    """Return the CR2 variance of the mean of (frames,) values, and its degrees of freedom.

    A long piece pulls the mean towards itself, which makes its residual too small; CR2 corrects
    this. The degrees of freedom assume that the means of all pieces vary alike.
    """
    _, piece, counts = np.unique(labels, return_inverse=True, return_counts=True)
    share = counts / len(values)
    residual = np.bincount(piece, values - values.mean()) / len(values)
    variance = float((residual**2 / (1 - share)).sum())
    weight = np.sqrt(share**2 / (1 - share))
    products = np.eye(len(share)) - share[:, None] - share + (share**2).sum()
    matrix = weight[:, None] * products * weight
    return variance, float(np.trace(matrix) ** 2 / (matrix**2).sum())


def _scenes(values: ArrayLike | Sequence[ArrayLike]) -> list[Array]:
    """Convert to one checked float array (runs, frames) per scene."""
    several = isinstance(values, (list, tuple)) and any(np.ndim(rows) for rows in values)
    arrays = values if several else [values]
    scenes = [np.atleast_2d(np.asarray(rows, dtype=np.float64)) for rows in arrays]  # pyright: ignore[reportGeneralTypeIssues]
    shapes = [rows.shape for rows in scenes]
    if any(len(shape) != 2 or 0 in shape for shape in shapes) or len({s[0] for s in shapes}) != 1:
        raise ValueError(f"values are (runs, frames) with equal runs in all scenes, got {shapes}")
    if not all(np.isfinite(rows).all() for rows in scenes):
        raise ValueError("values must be finite, got inf or nan; give correctness, not errors")
    return scenes
