"""Procedural pictures: reproducible pixels and documented statistics."""

import numpy as np
import pytest

from evercal.simulation.textures import dead_leaves, one_over_f


@pytest.mark.parametrize("exponent", [0.0, 1.0, 1.7])
def test_amplitude_falls_as_one_over_f_to_the_exponent(exponent: float) -> None:
    rng = np.random.default_rng(1)
    noise = one_over_f(64, exponent, np.random.default_rng(0))
    assert noise.dtype == np.float32
    assert abs(noise.mean()) < 1e-5
    assert noise.std() == pytest.approx(1.0, abs=1e-5)
    power = np.mean(
        [np.abs(np.fft.fft2(one_over_f(128, exponent, rng))) ** 2 for _ in range(8)], 0
    )
    frequency = np.hypot(np.fft.fftfreq(128)[:, None], np.fft.fftfreq(128)[None])
    band = (frequency > 0.03) & (frequency < 0.5)
    slope, _ = np.polyfit(np.log(frequency[band]), 0.5 * np.log(power[band]), 1)
    assert slope == pytest.approx(-exponent, abs=0.06)


def test_pictures_repeat_with_the_generator_and_not_with_earlier_calls() -> None:
    first, other, again = (
        dead_leaves(40, 60, np.random.default_rng(seed)) for seed in (3, 4, 3)
    )
    assert first.shape == (40, 60, 3)
    assert first.dtype == np.uint8
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.5


def test_pictures_have_contrast_and_edges() -> None:
    pictures = [
        dead_leaves(128, 128, np.random.default_rng(seed)).mean(-1)
        for seed in range(12)
    ]
    assert np.std(pictures, axis=(1, 2)).min() > 10
    assert np.ptp(np.mean(pictures, axis=(1, 2))) > 30
    # Overlapping shapes have many small steps and some large ones, unlike noise.
    steps = np.abs(np.diff(pictures, axis=2))
    assert np.median(steps) < 10
    assert np.mean(steps > 40) > 0.01


def test_few_leaves_give_a_calm_picture() -> None:
    def edges(leaves: int) -> float:
        rng = np.random.default_rng
        pictures = [
            dead_leaves(96, 96, rng(seed), leaves).mean(-1) for seed in range(8)
        ]
        return float(np.mean(np.abs(np.diff(pictures, axis=2)) > 30))

    assert edges(0) < edges(20) < edges(200)
