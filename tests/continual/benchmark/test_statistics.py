"""Bounds hold what they promise on data whose truth is known."""

import numpy as np
import pytest
from scipy.stats import t

from benchmarks.intervals import METHODS, NOW, Errors, coverage, plain_students, students
from evercal.continual.benchmark.statistics import _of_pieces, blocks
from evercal.evaluation import Interval, frame_pieces, mean_interval, paired_difference

FIRST = "blocks of ten, percentiles (at first)"


def numbered(*starts: int, frames: int = 40, step: int = 1) -> list[str]:
    return [f"frame-{first + step * i:06d}" for first in starts for i in range(frames)]


def lengths(names: list[str]) -> list[int]:
    return np.bincount(frame_pieces(names)).tolist()


def test_runs_of_frames_are_found_by_sequence_and_number() -> None:
    sequences = [f"seq-{s:02d}/frame-{i:06d}" for s in (3, 8, 13) for i in range(30)]
    assert lengths(sequences) == [30, 30, 30]
    assert lengths(numbered(0, 200, 400)) == [40, 40, 40]
    assert lengths([f"{name}.png" for name in numbered(0, 200)]) == [40, 40]
    assert lengths(numbered(100, 0)) == [40, 40]  # the number falls
    # Six frames that a tracker lost do not end a run, nor does another usual step.
    assert lengths([n for n in numbered(0, 200) if n not in numbered(10, frames=6)]) == [34, 40]
    assert lengths(numbered(0, 2000, step=5)) == [40, 40]
    # Seconds, as TUM names images.
    seconds = [f"{1305031102 + s + i / 30:.6f}" for s in (0, 10) for i in range(30)]
    assert lengths(seconds) == [30, 30]


def test_one_run_is_cut_into_blocks() -> None:
    assert lengths(numbered(0, frames=39)) == [13, 13, 13]
    assert lengths(numbered(0, frames=39, step=7)) == [13, 13, 13]
    assert lengths(numbered(0, frames=300)) == [38, 37, 38, 37, 38, 37, 38, 37]
    assert lengths([f"view {'abc'[i % 3]}" for i in range(25)]) == [13, 12]
    assert lengths([f"seq-{i:02d}/frame-000000" for i in range(25)]) == [13, 12]
    assert lengths(numbered(0, frames=5)) == [3, 2]
    assert frame_pieces([]).tolist() == []
    assert (blocks(39) == frame_pieces(numbered(0, frames=39))).all()


@pytest.mark.parametrize("runs", [2, 4])
def test_bounds_hold_the_truth_about_as_often_as_they_say(runs: int) -> None:
    held, _ = coverage(Errors(), (40,) * runs, 300, METHODS[NOW])
    assert held >= 92
    # What the audit found of blocks of ten: 80 to 92 %.
    before, _ = coverage(Errors(), (40,) * runs, 100, METHODS[FIRST])
    assert before < 90


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [1, 3])
@pytest.mark.parametrize("runs", [2, 4, 8, 12])
def test_coverage_at_every_number_of_runs(runs: int, seeds: int) -> None:
    assert coverage(Errors(seeds=seeds), (40,) * runs, 1000, METHODS[NOW])[0] >= 93
    assert coverage(Errors(seeds=seeds), (40,) * runs, 200, METHODS[FIRST])[0] < 90


@pytest.mark.parametrize("lengths", [(100, 20, 20, 20), (140, 20), (100, *(10,) * 6)])
def test_a_long_run_beside_short_ones_is_not_taken_for_many(lengths: tuple[int, ...]) -> None:
    assert coverage(Errors(), lengths, 300, students)[0] >= 92
    assert coverage(Errors(), lengths, 300, plain_students)[0] < 92


def test_one_long_run_is_cut_into_few_blocks() -> None:
    errors = Errors(lasting=0.0)
    held, _ = coverage(errors, (300,), 300, students)
    assert held > coverage(errors, (300,), 300, plain_students)[0] + 2
    assert held >= 89


def test_pieces_of_equal_length_give_the_t_interval_of_their_means() -> None:
    values = np.random.default_rng(0).random((4, 40))
    found = mean_interval(values.ravel(), [np.repeat(np.arange(4), 40)])
    means = values.mean(axis=1)
    low, high = t.interval(0.95, 3, means.mean(), means.std(ddof=1) / 2)
    assert (found.mean, found.low, found.high) == pytest.approx((means.mean(), low, high))


def test_seeds_alone_give_the_t_interval_of_theirs() -> None:
    level = np.random.default_rng(6).normal(size=5)
    found = mean_interval(np.repeat(level[:, None], 40, axis=1))
    low, high = t.interval(0.95, 4, level.mean(), level.std(ddof=1) / np.sqrt(5))
    assert (found.low, found.high) == pytest.approx((low, high))


def test_pieces_weigh_by_their_frames() -> None:
    """Two pieces of 30 and 10 frames, all right and all wrong: a ratio of sums, by hand."""
    found = mean_interval(np.arange(40) < 30, [np.arange(40) >= 30])
    # Each piece is 30 * 0.25 / 40 from its expected part, a share of 3/4 and 1/4; one freedom.
    deviation = 0.1875 * np.sqrt(1 / 0.25 + 1 / 0.75)
    assert found.mean == 0.75
    assert found.high - found.mean == pytest.approx(t.ppf(0.975, 1) * deviation)


def test_the_variance_that_pieces_give_and_its_degrees_of_freedom() -> None:
    """Unbiased for independent frames; Satterthwaite's freedom where pieces vary alike."""
    labels, rng = np.repeat(np.arange(4), [50, 10, 10, 10]), np.random.default_rng(1)
    apart = [_of_pieces(rng.normal(size=80), labels)[0] for _ in range(10_000)]
    assert np.mean(apart) == pytest.approx(1 / 80, rel=0.05)
    alike = [_of_pieces(rng.normal(size=4)[labels], labels) for _ in range(10_000)]
    variance, freedom = np.array(alike).T
    # That of a multiple of chi square: twice its squared mean by its variance.
    assert freedom[0] == pytest.approx(2 * variance.mean() ** 2 / variance.var(), rel=0.05)
    assert freedom[0] < 1.5


def test_for_independent_frames_the_width_is_that_of_the_binomial() -> None:
    values = (np.random.default_rng(3).random(40_000) < 0.6).astype(float)
    found = mean_interval(values, [np.arange(40_000) // 10])
    expected = 2 * 1.96 * np.sqrt(0.6 * 0.4 / 40_000)
    assert found.high - found.low == pytest.approx(expected, rel=0.05)


def test_frames_that_stay_alike_widen_the_bounds() -> None:
    values = np.repeat(np.random.default_rng(4).random(20) < 0.5, 20).astype(float)
    shuffled = np.random.default_rng(5).permutation(values)
    wide, narrow = mean_interval(values), mean_interval(shuffled)
    assert wide.mean == narrow.mean
    assert wide.high - wide.low > 2.0 * (narrow.high - narrow.low)


def test_a_constant_has_no_spread() -> None:
    assert mean_interval(np.ones((3, 47))) == Interval(1.0, 1.0, 1.0)


def test_scenes_weigh_alike_and_share_their_runs() -> None:
    small, large = np.ones((2, 20)), np.zeros((2, 400))
    assert mean_interval([small, large]).mean == 0.5
    # Run 0 is good in the one scene exactly where run 1 is good in the other: both runs are alike.
    first = np.array([[1.0], [0.0]]) * np.ones((2, 30))
    found = mean_interval([first, 1.0 - first])
    assert (found.low, found.high) == (0.5, 0.5)


def test_a_method_against_itself_differs_by_exactly_nothing() -> None:
    scenes = [np.random.default_rng(i).random((3, 50)) < 0.5 for i in range(4)]
    assert paired_difference(scenes, scenes) == Interval(0.0, 0.0, 0.0)


def test_pairing_cancels_what_both_find_hard() -> None:
    rng = np.random.default_rng(7)
    hard = [np.repeat(rng.random(20) < 0.6, 10) for _ in range(3)]
    base = [np.stack([rows] * 3).astype(float) for rows in hard]
    better = [np.maximum(rows, rng.random(rows.shape) < 0.1) for rows in base]
    found = paired_difference(better, base)
    expected = np.mean([(x - y).mean() for x, y in zip(better, base, strict=True)])
    assert found.mean == pytest.approx(expected)
    assert found.low > 0.0
    alone = mean_interval(better)
    assert found.high - found.low < 0.5 * (alone.high - alone.low)
    back = paired_difference(base, better)
    assert (back.mean, back.low, back.high) == pytest.approx((-found.mean, -found.high, -found.low))


def test_one_scene_may_be_given_in_any_form() -> None:
    values = (np.random.default_rng(9).random(60) < 0.5).astype(float)
    plain = mean_interval(values)
    assert plain == mean_interval(values[None]) == mean_interval([values])
    assert plain == mean_interval(values.tolist()) == mean_interval(values.astype(bool))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros((2, 1)), "scene 0 is one piece of recording of 1 frames"),
        ([np.zeros((2, 30)), np.zeros((3, 30))], "as many runs in each"),
        (np.zeros((0, 30)), "runs, frames"),
        (np.zeros((2, 2, 30)), "runs, frames"),
        ([], "runs, frames"),
        (np.full((2, 30), np.inf), "finite"),
    ],
)
def test_what_cannot_be_judged_is_refused(values: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        mean_interval(values)  # pyright: ignore[reportArgumentType]


def test_what_does_not_belong_together_is_refused() -> None:
    with pytest.raises(ValueError, match="same scenes, runs and frames"):
        paired_difference(np.zeros((2, 30)), np.zeros((1, 30)))
    with pytest.raises(ValueError, match="pieces are"):
        mean_interval(np.zeros((2, 30)), [np.zeros(29)])
    with pytest.raises(ValueError, match="one piece"):
        mean_interval(np.zeros((2, 30)), [np.zeros(30)])
