"""How sure a mean or a difference is, when frames follow one another and runs differ by seed.

Neighbouring frames of a recording see nearly the same, so they are right or wrong together and
count for less than as many independent ones. What counts is how many pieces of recording there are:
whole runs of consecutive frames or, where a scene was recorded in one go, long blocks of it (batch
means; Flegal and Jones, Batch Means and Spectral Variance Estimators in MCMC, Ann. Stat. 2010).
Such blocks tell how much that one path says; what another path would say nobody can know from it.
Pieces are few, often four a scene, and the bootstrap of few things is too narrow. So bounds are
Student's, from the cluster-robust variance CR2 of Bell and McCaffrey (Bias Reduction in Standard
Errors for Linear Regression with Multi-Stage Samples, Surv. Methodol. 2002), with the degrees of
freedom of Satterthwaite: a long run beside short ones counts for more than one piece of many.
`python -m benchmarks intervals` measures how often such bounds hold.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

LARGEST_STEP = 10
"""A run goes on over a gap of fewer frames than this: a tracker may have lost some."""


@dataclass(frozen=True)
class Interval:
    """A mean and the bounds that hold it in 95 % of all repetitions; in the unit of the values."""

    mean: float
    low: float
    high: float


def frame_pieces(names: Sequence[str]) -> Labels:
    """Which piece of its recording each frame belongs to: what may be taken as independent.

    A run of consecutive frames is a piece. It ends where what stands before the frame number
    changes (`seq-03/frame-000039`, `seq-08/frame-000000`), where the number falls, and where it
    steps over ten frames or more; the usual step of the recording counts as one, so that every
    fifth frame of a path is still one run. A scene with a single run, whose frames all stand
    alone or whose names hold no numbers is cut into `blocks` of neighbouring frames.

    Args:
        names: of one scene's frames, in recorded order.

    Returns:
        (frames,) 0 for the first piece, 1 for the next and so on.
    """
    places = [re.fullmatch(r"(.*?)(\d+(?:\.\d+)?)(\.\w+)?", name, re.DOTALL) for name in names]
    if all(places):
        before = np.array([place[1] for place in places if place])
        steps = np.diff([float(place[2]) for place in places if place])
        together = before[1:] == before[:-1]
        forward = steps[together & (steps > 0)]
        usual = float(np.median(forward)) if len(forward) else 1.0
        ends = ~together | (steps <= 0) | (steps > LARGEST_STEP * usual)
        if ends.any() and not ends.all():
            return np.concatenate([[0], np.cumsum(ends)]).astype(np.int64)
    return blocks(len(names))


def blocks(frames: int) -> Labels:
    """(frames,) labels of blocks of neighbouring frames, as `frame_pieces` cuts a single run.

    Their length and their number grow with the root of the frames, so that ends which are alike
    matter less in longer recordings: 39 frames make three blocks, 300 make eight. There are two at
    least.
    """
    count = max(math.isqrt(frames) // 2, 2)
    return np.arange(frames, dtype=np.int64) * count // max(frames, 1)


def mean_interval(
    values: ArrayLike | Sequence[ArrayLike], pieces: Sequence[ArrayLike] | None = None
) -> Interval:
    """The mean over scenes of the mean over runs and frames, with 95 % bounds.

    Two things are drawn by chance: the pieces of recording that a scene is judged by, which are
    the same for all runs, and the runs, which are the same for all scenes. Each adds the variance
    that its means show. Chance that strikes one run on one piece shows in both and is counted
    twice, which makes the bounds a little wide (as in Owen, The Pigeonhole Bootstrap, Ann. Appl.
    Stat. 2007). With one run the bounds tell of the choice of frames alone. Values that are all
    equal have no width, however few they are.

    Args:
        values: (runs, frames) or (frames,) for one scene, or a list of such arrays, one per scene;
            frames in recorded order. Typically per-frame correctness.
        pieces: (frames,) labels for each scene, as `frame_pieces` gives; `blocks` when None.

    Raises:
        ValueError: Shapes that do not fit, values that are not finite, scenes with different
            numbers of runs, or a scene of one piece, whose spread nobody can tell.
    """
    scenes = _scenes(values)
    given = [blocks(rows.shape[1]) for rows in scenes] if pieces is None else list(pieces)
    labels = [np.asarray(of) for of in given]
    if [of.shape for of in labels] != [rows.shape[1:] for rows in scenes]:
        raise ValueError(
            f"pieces are (frames,) per scene, got {[of.shape for of in labels]} for frames"
            f" {[rows.shape[1] for rows in scenes]}"
        )
    alone = next((i for i, of in enumerate(labels) if len(np.unique(of)) < 2), None)
    if alone is not None:
        raise ValueError(
            f"scene {alone} is one piece of recording of {len(labels[alone])} frames; bounds take"
            f" at least two"
        )
    mean = float(np.mean([rows.mean() for rows in scenes]))
    half = _half_width(scenes, labels)
    return Interval(mean, mean - half, mean + half)


def paired_difference(
    a: ArrayLike | Sequence[ArrayLike],
    b: ArrayLike | Sequence[ArrayLike],
    pieces: Sequence[ArrayLike] | None = None,
) -> Interval:
    """How much better method `a` is than `b` on the same frames, with 95 % bounds.

    What both find easy or hard cancels, so the bounds are tighter than those of either mean. The
    difference is real, at that level, if zero lies outside.

    Args:
        a: Per-frame correctness, as `mean_interval` takes it.
        b: The same scenes, runs and frames in the same order.
        pieces: As `mean_interval` takes it.

    Raises:
        ValueError: As `mean_interval`, or `a` and `b` of different shapes.
    """
    first, second = _scenes(a), _scenes(b)
    shapes = [rows.shape for rows in first], [rows.shape for rows in second]
    if shapes[0] != shapes[1]:
        raise ValueError(f"a and b hold the same scenes, runs and frames, got {shapes}")
    return mean_interval([x - y for x, y in zip(first, second, strict=True)], pieces)


def _half_width(scenes: Sequence[Array], labels: Sequence[Labels]) -> float:
    """Half the width of the bounds."""
    from scipy.stats import t

    # (variance, degrees of freedom) that pieces of each scene, and runs, add to the mean.
    parts = []
    for rows, of in zip(scenes, labels, strict=True):
        spread, freedom = _of_pieces(rows.mean(axis=0), of)
        parts.append((spread / len(scenes) ** 2, freedom))
    runs = len(scenes[0])
    if runs > 1:
        means = np.mean([rows.mean(axis=1) for rows in scenes], axis=0)
        parts.append((float(means.var(ddof=1)) / runs, runs - 1))
    variance = sum(part for part, _ in parts)
    if variance <= 1e-24:  # of values around one, that is rounding
        return 0.0
    freedom = variance**2 / sum(part**2 / freedom for part, freedom in parts)
    return float(t.ppf(0.975, freedom)) * variance**0.5


def _of_pieces(values: Array, labels: Labels) -> tuple[float, float]:
    """Variance (CR2) of the mean of (frames,) values in pieces, and its degrees of freedom.

    Pieces of equal length give the variance of the mean of their means, and one degree less than
    pieces. Otherwise a piece that makes up a share of all frames pulls the mean towards itself, by
    which its residual is too small; CR2 makes up for it, in full where frames are independent. The
    degrees of freedom are those of pieces whose means vary alike however long they are, as they do
    where what makes a run easy or hard lasts for the whole run: few where one piece dominates.
    """
    _, piece, counts = np.unique(labels, return_inverse=True, return_counts=True)
    share = counts / len(values)
    residual = np.bincount(piece, values - values.mean()) / len(values)
    spread = float((residual**2 / (1 - share)).sum())
    weight = np.sqrt(share**2 / (1 - share))
    products = np.eye(len(share)) - share[:, None] - share + (share**2).sum()
    matrix = weight[:, None] * products * weight
    return spread, float(np.trace(matrix) ** 2 / (matrix**2).sum())


def _scenes(values: ArrayLike | Sequence[ArrayLike]) -> list[Array]:
    """One float array (runs, frames) per scene, checked."""
    several = isinstance(values, (list, tuple)) and any(np.ndim(rows) for rows in values)
    arrays = values if several else [values]
    scenes = [np.atleast_2d(np.asarray(rows, dtype=np.float64)) for rows in arrays]  # pyright: ignore[reportGeneralTypeIssues]
    shapes = [rows.shape for rows in scenes]
    if any(len(shape) != 2 or 0 in shape for shape in shapes) or len({s[0] for s in shapes}) != 1:
        raise ValueError(
            f"values are (runs, frames) per scene, with as many runs in each, got {shapes}"
        )
    if not all(np.isfinite(rows).all() for rows in scenes):
        raise ValueError("values are finite, got inf or nan; give correctness, not errors")
    return scenes
