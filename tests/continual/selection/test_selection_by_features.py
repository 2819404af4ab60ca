"""Selectors of other methods, by hand and against slow references."""

import numpy as np
import pytest

from evercal.continual.selection.selectors import (
    leverage_scores,
    select_coverage,
    select_gradients,
    select_herding,
    select_reservoir,
)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_reservoir_is_uniform() -> None:
    runs = 4000
    selected = np.concatenate(
        [select_reservoir(20, 5, rng(seed)) for seed in range(runs)]
    )
    share = np.bincount(selected, minlength=20) / runs
    # Five standard deviations of a share of 1/4.
    assert np.abs(share - 0.25).max() < 5 * np.sqrt(0.25 * 0.75 / runs)


def test_herding_by_hand() -> None:
    # Unit vectors at 0, 90, 80 and 10 degrees. Their mean points at 45; the first pick is nearest
    # to it: 80 and 10 are at one distance, the earlier wins. The second brings the mean back.
    angles = np.deg2rad([0.0, 90.0, 80.0, 10.0])
    features = 7.0 * np.stack([np.cos(angles), np.sin(angles)], 1)
    assert select_herding(features, 1).tolist() == [2]
    assert select_herding(features, 2).tolist() == [2, 3]
    assert select_herding(features, 9).tolist() == [0, 1, 2, 3]


def test_herding_matches_a_slow_reference() -> None:
    features = rng(1).normal(size=(30, 6))
    unit = [row / np.linalg.norm(row) for row in features]
    mean = sum(unit) / 30
    selected: list[int] = []
    for _ in range(8):
        left = [i for i in range(30) if i not in selected]
        gaps = [
            np.linalg.norm(
                mean - sum(unit[k] for k in [*selected, i]) / (len(selected) + 1)
            )
            for i in left
        ]
        selected.append(left[int(np.argmin(gaps))])
    assert select_herding(features, 8).tolist() == sorted(selected)


def test_leverage_by_hand() -> None:
    # Three equal frames share the leverage of their direction.
    features = np.array([[2.0, 0.0], [2.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
    assert leverage_scores(features, 2) == pytest.approx([1 / 3, 1 / 3, 1 / 3, 1.0])
    # With rank one, only the strongest direction (norm sqrt 12) counts.
    assert leverage_scores(features, 1) == pytest.approx(
        [1 / 3, 1 / 3, 1 / 3, 0.0], abs=1e-12
    )


def test_leverage_sums_to_the_rank_and_is_rotation_invariant() -> None:
    features = rng(3).normal(size=(40, 12))
    rotation, _ = np.linalg.qr(rng(4).normal(size=(12, 12)))
    for rank in (1, 5, 12, 99):
        scores = leverage_scores(features, rank)
        assert scores.sum() == pytest.approx(min(rank, 12))
        np.testing.assert_allclose(
            leverage_scores(features @ rotation, rank), scores, atol=1e-9
        )


def test_coverage_selects_frames_with_new_parts() -> None:
    # Forty frames show part 0, one frame also part 1.
    visible = [np.array([0])] * 40 + [np.array([0, 1])]
    runs = 300
    covered = sum(40 in select_coverage(visible, 4, rng(s)) for s in range(runs))
    chance = sum(40 in select_reservoir(41, 4, rng(s)) for s in range(runs))
    assert chance < 0.2 * runs
    assert covered > 2 * chance


def test_opposed_gradient_replaces_a_frame() -> None:
    # An opposed gradient enters a full buffer, a repeated one does not.
    same = np.tile([1.0, 0.0], (30, 1))
    away = np.concatenate([same, [[-1.0, 0.0]]])
    assert select_gradients(same, 4, rng()).tolist() == [0, 1, 2, 3]
    entered = [30 in select_gradients(away, 4, rng(seed)) for seed in range(50)]
    # Its score is 0, so it always replaces the drawn frame.
    assert all(entered)
