"""How sure a mean or a difference is, when frames follow one another and runs differ by seed.

Neighbouring frames of a recording see nearly the same, so they are right or wrong together and
count for less than as many independent ones. Resampling blocks of consecutive frames keeps that
(circular block bootstrap, Politis and Romano 1992); resampling runs adds what the seed does.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Interval:
    """A mean and the bounds that hold it in 95 % of all repetitions; in the unit of the values."""

    mean: float
    low: float
    high: float


def block_bootstrap(
    values: ArrayLike | Sequence[ArrayLike], block: int = 10, samples: int = 2000, seed: int = 0
) -> Interval:
    """The mean over scenes of the mean over runs and frames, with 95 % bounds.

    Each sample draws runs with replacement, the same for all scenes, since a run is one network
    for them all, and blocks of consecutive frames within each scene, the same for all runs,
    since a hard image is hard for every run. With one run the bounds tell of the choice of frames
    alone; with few they are somewhat narrow, as the bootstrap of few things is.

    Args:
        values: (runs, frames) or (frames,) for one scene, or a list of such arrays, one per scene;
            frames in recorded order. Typically per-frame correctness.
        block: Frames in a block; about as many as stay alike.
        samples: How often to resample.
        seed: Of the resampling.

    Raises:
        ValueError: Shapes that do not fit, values that are not finite, scenes with different
            numbers of runs, or a scene of fewer than two blocks, whose spread nobody can tell.
    """
    scenes = _scenes(values)
    if block < 1 or samples < 1:
        raise ValueError(f"block and samples are at least 1, got {block} and {samples}")
    short = next((i for i, rows in enumerate(scenes) if rows.shape[1] < 2 * block), None)
    if short is not None:
        raise ValueError(
            f"scene {short} has {scenes[short].shape[1]} frames; bounds from blocks of {block}"
            f" frames take at least {2 * block}, so give more frames or a smaller block"
        )
    generator = np.random.default_rng(seed)
    runs = len(scenes[0])
    weights = generator.multinomial(runs, np.full(runs, 1.0 / runs), size=samples) / runs
    drawn = np.zeros(samples)
    for rows in scenes:
        drawn += (weights * _block_means(rows, block, samples, generator)).sum(axis=1)
    low, high = np.percentile(drawn / len(scenes), [2.5, 97.5])
    return Interval(float(np.mean([rows.mean() for rows in scenes])), float(low), float(high))


def paired_difference(
    a: ArrayLike | Sequence[ArrayLike],
    b: ArrayLike | Sequence[ArrayLike],
    block: int = 10,
    samples: int = 2000,
    seed: int = 0,
) -> Interval:
    """How much better method `a` is than `b` on the same frames, with 95 % bounds.

    What both find easy or hard cancels, so the bounds are tighter than those of either mean. The
    difference is real, at that level, if zero lies outside.

    Args:
        a: Per-frame correctness, as `block_bootstrap` takes it.
        b: The same scenes, runs and frames in the same order.
        block: Frames in a block.
        samples: How often to resample.
        seed: Of the resampling.

    Raises:
        ValueError: As `block_bootstrap`, or `a` and `b` of different shapes.
    """
    first, second = _scenes(a), _scenes(b)
    shapes = [rows.shape for rows in first], [rows.shape for rows in second]
    if shapes[0] != shapes[1]:
        raise ValueError(f"a and b hold the same scenes, runs and frames, got {shapes}")
    differences = [x - y for x, y in zip(first, second, strict=True)]
    return block_bootstrap(differences, block, samples, seed)


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


def _block_means(rows: Array, block: int, samples: int, generator: np.random.Generator) -> Array:
    """(samples, runs) means over resampled frames, exactly as many as there are in each sample."""
    frames = rows.shape[1]
    # The recording is closed to a ring, so that every frame is drawn equally often.
    ring = np.concatenate([np.zeros((len(rows), 1)), rows, rows[:, :block]], axis=1)
    before = np.cumsum(ring, axis=1)
    lengths = np.full(-(-frames // block), block)
    lengths[-1] = frames - block * (len(lengths) - 1)
    starts = generator.integers(frames, size=(samples, len(lengths)))
    sums = np.stack([(run[starts + lengths] - run[starts]).sum(axis=1) for run in before], axis=1)
    return sums / frames
