"""Bounds hold what they promise on data whose truth is known."""

import numpy as np
import pytest

from evercal.evaluation import Interval, block_bootstrap, paired_difference


def blocky(generator: np.random.Generator, blocks: int, share: float, length: int = 10):
    """Correctness that stays the same for `length` frames, with mean `share`."""
    return np.repeat(generator.random(blocks) < share, length).astype(float)


def coverage(block: int, trials: int = 150, share: float = 0.7) -> float:
    generator = np.random.default_rng(0)
    held = 0
    for trial in range(trials):
        values = blocky(generator, 60, share)
        found = block_bootstrap(values, block=block, samples=300, seed=trial)
        held += found.low <= share <= found.high
    return held / trials


def test_bounds_hold_the_truth_about_as_often_as_they_say() -> None:
    # Blocks twice as long as the runs of equal frames are honest; single frames are not: their
    # bounds are narrower by the square root of ten.
    assert 0.88 <= coverage(block=20) <= 0.99
    assert coverage(block=1) < 0.65


def test_for_independent_frames_the_width_is_that_of_the_binomial() -> None:
    generator = np.random.default_rng(3)
    values = (generator.random(2000) < 0.6).astype(float)
    found = block_bootstrap(values, block=10)
    expected = 2 * 1.96 * np.sqrt(0.6 * 0.4 / 2000)
    assert found.high - found.low == pytest.approx(expected, rel=0.12)
    assert found.low < found.mean < found.high
    assert found.mean == pytest.approx(values.mean())


def test_frames_that_stay_alike_widen_the_bounds() -> None:
    values = blocky(np.random.default_rng(4), 100, 0.5, length=10)
    shuffled = np.random.default_rng(5).permutation(values)
    wide, narrow = block_bootstrap(values), block_bootstrap(shuffled)
    assert wide.mean == narrow.mean
    assert wide.high - wide.low > 2.0 * (narrow.high - narrow.low)


@pytest.mark.parametrize("place", [0, 23, 46])
def test_every_frame_counts_alike_even_when_blocks_do_not_fit(place: int) -> None:
    """The recording is closed to a ring; else its ends would be drawn less often than its middle.

    A frame is in each of the four full blocks with probability 10 / 47 and in the last with 7 / 47,
    so it is drawn three times or more in 5.7 % of samples and four times or more in 0.7 %.
    """
    found = block_bootstrap(np.eye(47)[place], block=10, samples=20000)
    assert (found.mean, found.low, found.high) == pytest.approx((1 / 47, 0.0, 3 / 47))


def test_a_constant_has_no_spread() -> None:
    assert block_bootstrap(np.ones((3, 47)), block=10) == Interval(1.0, 1.0, 1.0)


def test_runs_that_differ_widen_the_bounds_as_their_spread_says() -> None:
    """Constant within a run: only which runs are drawn matters, a plain bootstrap of n things."""
    level = np.random.default_rng(6).normal(size=30)
    found = block_bootstrap(np.repeat(level[:, None], 40, axis=1), samples=4000)
    expected = 2 * 1.96 * level.std() / np.sqrt(len(level))
    assert found.high - found.low == pytest.approx(expected, rel=0.1)


def test_scenes_weigh_alike_and_share_their_runs() -> None:
    small, large = np.ones((2, 20)), np.zeros((2, 400))
    assert block_bootstrap([small, large]).mean == 0.5
    # Run 0 is good in the one scene exactly where run 1 is good in the other: drawing whole runs
    # leaves the mean over scenes alone, drawing them apart would not.
    first = np.array([[1.0], [0.0]]) * np.ones((2, 30))
    found = block_bootstrap([first, 1.0 - first])
    assert (found.low, found.high) == (0.5, 0.5)


def test_a_method_against_itself_differs_by_exactly_nothing() -> None:
    scenes = [np.random.default_rng(i).random((3, 50)) < 0.5 for i in range(4)]
    assert paired_difference(scenes, scenes) == Interval(0.0, 0.0, 0.0)


def test_pairing_cancels_what_both_find_hard() -> None:
    generator = np.random.default_rng(7)
    base = [np.stack([blocky(generator, 20, 0.6)] * 3) for _ in range(3)]
    better = [np.maximum(rows, generator.random(rows.shape) < 0.1) for rows in base]
    found = paired_difference(better, base)
    expected = np.mean([(x - y).mean() for x, y in zip(better, base, strict=True)])
    assert found.mean == pytest.approx(expected)
    assert found.low > 0.0
    alone = block_bootstrap(better)
    assert found.high - found.low < 0.5 * (alone.high - alone.low)
    back = paired_difference(base, better)
    assert (back.mean, back.low, back.high) == pytest.approx((-found.mean, -found.high, -found.low))


def test_the_same_seed_gives_the_same_bounds() -> None:
    values = np.random.default_rng(8).random((2, 60))
    assert block_bootstrap(values) == block_bootstrap(values)
    assert block_bootstrap(values) != block_bootstrap(values, seed=1)


def test_one_scene_may_be_given_in_any_form() -> None:
    values = (np.random.default_rng(9).random(60) < 0.5).astype(float)
    plain = block_bootstrap(values)
    assert plain == block_bootstrap(values[None]) == block_bootstrap([values])
    assert plain == block_bootstrap(values.tolist()) == block_bootstrap(values.astype(bool))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros((2, 19)), r"scene 0 has 19 frames; .* at least 20"),
        ([np.zeros((2, 30)), np.zeros((3, 30))], "as many runs in each"),
        (np.zeros((0, 30)), "runs, frames"),
        (np.zeros((2, 2, 30)), "runs, frames"),
        ([], "runs, frames"),
        (np.full((2, 30), np.inf), "finite"),
    ],
)
def test_what_cannot_be_resampled_is_refused(values: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        block_bootstrap(values)  # pyright: ignore[reportArgumentType]


def test_methods_on_different_frames_are_refused() -> None:
    with pytest.raises(ValueError, match="same scenes, runs and frames"):
        paired_difference(np.zeros((2, 30)), np.zeros((1, 30)))
    with pytest.raises(ValueError, match="at least 1"):
        block_bootstrap(np.zeros((2, 30)), block=0)
