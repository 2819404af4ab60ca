"""Intervals cover the truth on simulated data, and match closed forms."""

import numpy as np
import pytest
from benchmarks.intervals import METHODS, Errors, coverage, students
from evercal.continual.benchmark.statistics import (
    Interval,
    _of_pieces,
    blocks,
    frame_pieces,
    mean_interval,
    seeds_interval,
)
from scipy.stats import t


def numbered(*starts: int, frames: int = 40, step: int = 1) -> list[str]:
    return [f"frame-{first + step * i:06d}" for first in starts for i in range(frames)]


def lengths(names: list[str]) -> list[int]:
    return np.bincount(frame_pieces(names)).tolist()


def test_runs_end_where_sequence_or_number_changes() -> None:
    sequences = [f"seq-{s:02d}/frame-{i:06d}" for s in (3, 8, 13) for i in range(30)]
    assert lengths(sequences) == [30, 30, 30]
    assert lengths(numbered(0, 200, 400)) == [40, 40, 40]
    assert lengths([f"{name}.png" for name in numbered(0, 200)]) == [40, 40]
    assert lengths(numbered(100, 0)) == [40, 40]  # the number falls
    # Neither six lost frames nor another usual step end a run.
    assert lengths([n for n in numbered(0, 200) if n not in numbered(10, frames=6)]) == [34, 40]
    assert lengths(numbered(0, 2000, step=5)) == [40, 40]
    # TUM names images by seconds.
    seconds = [f"{1305031102 + s + i / 30:.6f}" for s in (0, 10) for i in range(30)]
    assert lengths(seconds) == [30, 30]


def test_single_run_is_cut_into_blocks() -> None:
    assert lengths(numbered(0, frames=39)) == [13, 13, 13]
    assert lengths(numbered(0, frames=39, step=7)) == [13, 13, 13]
    assert lengths(numbered(0, frames=300)) == [38, 37, 38, 37, 38, 37, 38, 37]
    assert lengths([f"view {'abc'[i % 3]}" for i in range(25)]) == [13, 12]
    assert lengths([f"seq-{i:02d}/frame-000000" for i in range(25)]) == [13, 12]
    assert lengths(numbered(0, frames=5)) == [3, 2]
    assert frame_pieces([]).tolist() == []
    assert (blocks(39) == frame_pieces(numbered(0, frames=39))).all()


@pytest.mark.parametrize("runs", [2, 4])
def test_intervals_cover_the_truth(runs: int) -> None:
    assert coverage(Errors(), (40,) * runs, 300, students)[0] >= 92


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [1, 3])
@pytest.mark.parametrize("runs", [2, 4, 8, 12])
def test_coverage_at_every_number_of_runs(runs: int, seeds: int) -> None:
    assert coverage(Errors(seeds=seeds), (40,) * runs, 1000, students)[0] >= 93


@pytest.mark.parametrize("lengths", [(100, 20, 20, 20), (140, 20), (100, *(10,) * 6)])
def test_intervals_cover_the_truth_with_unequal_runs(lengths: tuple[int, ...]) -> None:
    assert coverage(Errors(), lengths, 300, students)[0] >= 92


def test_bootstrap_of_few_runs_is_too_narrow() -> None:
    assert coverage(Errors(), (40,) * 2, 50, METHODS["bootstrap of runs, BCa"])[0] < 85


def test_blocks_of_one_long_run_cover_errors_that_fade() -> None:
    assert coverage(Errors(constant=0.0), (300,), 300, students)[0] >= 89


def test_equal_pieces_give_the_t_interval_of_their_means() -> None:
    values = np.random.default_rng(0).random((4, 40))
    interval = mean_interval([values.reshape(1, -1)], [np.repeat(np.arange(4), 40)])
    means = values.mean(axis=1)
    low, high = t.interval(0.95, 3, means.mean(), means.std(ddof=1) / 2)
    assert (interval.mean, interval.low, interval.high) == pytest.approx((means.mean(), low, high))


def test_constant_runs_give_the_t_interval_over_seeds() -> None:
    level = np.random.default_rng(6).normal(size=5)
    interval = mean_interval([np.repeat(level[:, None], 40, axis=1)])
    low, high = t.interval(0.95, 4, level.mean(), level.std(ddof=1) / np.sqrt(5))
    assert (interval.low, interval.high) == pytest.approx((low, high))


def test_pieces_weigh_by_their_frames() -> None:
    """Two pieces of 30 and 10 frames, all correct and all incorrect, by hand."""
    interval = mean_interval([[np.arange(40) < 30]], [np.arange(40) >= 30])
    # Residual 30 * 0.25 / 40 of each piece, shares 3/4 and 1/4, one degree of freedom.
    deviation = 0.1875 * np.sqrt(1 / 0.25 + 1 / 0.75)
    assert interval.mean == 0.75
    assert interval.high - interval.mean == pytest.approx(t.ppf(0.975, 1) * deviation)


def test_variance_is_unbiased_and_freedom_is_that_of_satterthwaite() -> None:
    labels, rng = np.repeat(np.arange(4), [50, 10, 10, 10]), np.random.default_rng(1)
    apart = [_of_pieces(rng.normal(size=80), labels)[0] for _ in range(10_000)]
    assert np.mean(apart) == pytest.approx(1 / 80, rel=0.05)
    alike = [_of_pieces(rng.normal(size=4)[labels], labels) for _ in range(10_000)]
    variance, freedom = np.array(alike).T
    # A multiple of chi square: twice its squared mean divided by its variance.
    assert freedom[0] == pytest.approx(2 * variance.mean() ** 2 / variance.var(), rel=0.05)
    assert freedom[0] < 1.5


def test_width_for_independent_frames_is_binomial() -> None:
    values = (np.random.default_rng(3).random(40_000) < 0.6).astype(float)
    interval = mean_interval([[values]], [np.arange(40_000) // 10])
    expected = 2 * 1.96 * np.sqrt(0.6 * 0.4 / 40_000)
    assert interval.high - interval.low == pytest.approx(expected, rel=0.05)


def test_correlated_frames_widen_the_interval() -> None:
    values = np.repeat(np.random.default_rng(4).random(20) < 0.5, 20).astype(float)
    shuffled = np.random.default_rng(5).permutation(values)
    wide, narrow = mean_interval([[values]]), mean_interval([[shuffled]])
    assert wide.mean == narrow.mean
    assert wide.high - wide.low > 2.0 * (narrow.high - narrow.low)


def test_constant_values_have_zero_width() -> None:
    assert mean_interval([np.ones((3, 47))]) == Interval(1.0, 1.0, 1.0)


def test_scenes_weigh_equally_and_share_runs() -> None:
    small, large = np.ones((2, 20)), np.zeros((2, 400))
    assert mean_interval([small, large]).mean == 0.5
    # Run 0 is good in one scene, run 1 in the other: both runs have the same mean.
    first = np.array([[1.0], [0.0]]) * np.ones((2, 30))
    interval = mean_interval([first, 1.0 - first])
    assert (interval.low, interval.high) == (0.5, 0.5)


def test_pairing_cancels_the_difficulty_of_frames() -> None:
    rng = np.random.default_rng(7)
    hard = [np.repeat(rng.random(20) < 0.6, 10) for _ in range(3)]
    base = [np.stack([rows] * 3).astype(float) for rows in hard]
    better = [np.maximum(rows, rng.random(rows.shape) < 0.1) for rows in base]
    gains = [x - y for x, y in zip(better, base, strict=True)]
    interval, alone = mean_interval(gains), mean_interval(better)
    assert interval.mean == pytest.approx(np.mean([rows.mean() for rows in gains]))
    assert interval.low > 0.0
    assert interval.high - interval.low < 0.5 * (alone.high - alone.low)


def test_unusable_scenes_are_refused() -> None:
    with pytest.raises(ValueError, match="one piece of 1 frames"):
        mean_interval([np.zeros((2, 1))])
    with pytest.raises(ValueError, match="shape"):
        mean_interval([np.zeros((2, 30)), np.zeros((3, 30))])


def test_seeds_interval_is_students() -> None:
    """By hand: mean 2, deviation 1, t(2) = 4.3027 at 97.5 %."""
    interval = seeds_interval([1.0, 2.0, 3.0])
    half = 4.3027 / 3**0.5
    assert interval == pytest.approx((2.0, 2.0 - half, 2.0 + half), abs=1e-4)


def test_seeds_interval_is_corrected_for_comparisons() -> None:
    values = np.random.default_rng(1).normal(size=(4000, 4, 5))
    covers = [
        all(low <= 0 <= high for _, low, high in (seeds_interval(each, 4) for each in trial))
        for trial in values
    ]
    assert 0.94 < np.mean(covers) < 0.965
    with pytest.raises(ValueError, match="two or more"):
        seeds_interval([1.0])
