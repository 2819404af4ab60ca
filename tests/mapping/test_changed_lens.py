"""A focal length that changes while a recording is made."""

import numpy as np
import pytest

from evercal.mapping.changed_lens import LensChange

FRAMES = 30
SIGMA = 0.001


def measured(true: np.ndarray, seed: int) -> np.ndarray:
    """(n, 2) changes of the focal length as frames show them."""
    rng = np.random.default_rng(seed)
    sigma = SIGMA * rng.uniform(0.5, 3, len(true))
    return np.stack([true + sigma * rng.normal(size=len(true)), sigma], 1)


@pytest.mark.parametrize("first", [5, 13, 15, 25])
@pytest.mark.parametrize("size", [0.02, -0.006])
def test_a_step_is_named_with_its_frame(first: int, size: float) -> None:
    true = np.where(np.arange(FRAMES) >= first, size, 0.0)
    change = LensChange.of(measured(true, first))
    assert change.size == pytest.approx(size, abs=0.0015)
    assert abs(change.first - first) <= 1


@pytest.mark.parametrize("seed", range(3))
def test_autofocus_is_a_scatter(seed: int) -> None:
    true = np.random.default_rng(seed).uniform(-0.015, 0.015, FRAMES)
    change = LensChange.of(measured(true, seed))
    assert change.first == -1
    assert change.size == pytest.approx(0.0087, rel=0.3)


@pytest.mark.parametrize("seed", range(20))
def test_one_lens_is_no_change(seed: int) -> None:
    assert LensChange.of(measured(np.zeros(FRAMES), seed)) == LensChange()


def test_a_small_change_and_few_frames_are_none() -> None:
    step = np.where(np.arange(FRAMES) >= 15, 0.002, 0.0)
    assert LensChange.of(measured(step, 0)) == LensChange()
    assert LensChange.of(measured(step[:6], 0)) == LensChange()
    unknown = np.full((FRAMES, 2), np.nan)
    assert LensChange.of(unknown) == LensChange()


def test_two_frames_with_wrong_poses_are_no_autofocus() -> None:
    focal = measured(np.zeros(FRAMES), 1)
    focal[3] = 0.15, 0.026
    focal[0] = 0.29, 0.055
    assert LensChange.of(focal) == LensChange()
