"""Result lines survive a round trip, and an interruption costs at most the last line."""

import math
from pathlib import Path

import numpy as np
import pytest

from evercal.continual.benchmark.results import RESULTS, SceneResult, append, read
from evercal.errors import InputError


def result(stage: int = 0, scene: str = "a", **changed: object) -> SceneResult:
    fields: dict[str, object] = {
        "strategy": "evercal",
        "seed": 0,
        "stage": stage,
        "scene": scene,
        "frames": ("f1", "f2", "f3"),
        "translation_m": (0.01, math.inf, 0.05),
        "rotation_rad": (0.02, math.inf, 0.001),
        "wrong_scene": (False, True, False),
        "near_training_frame": (True, False, False),
        "seconds": 1.5,
        "memory_bytes": 10,
        "head_bytes": 20,
        "frames_kept": 3,
    }
    return SceneResult(**{**fields, **changed})  # pyright: ignore[reportArgumentType]


def test_results_round_trip(tmp_path: Path) -> None:
    assert read(tmp_path) == []
    covered = result(
        keyframe_positions_m=((0.5, 1.0, -2.0), (1.5, 0.0, 0.25)), covering_radius=0.75
    )
    append(tmp_path, [result()])
    append(tmp_path, [result(1, "b"), covered])
    assert read(tmp_path) == [result(), result(1, "b"), covered]


def test_squared_errors_round_trip_if_there_are_any(tmp_path: Path) -> None:
    squared = (3.25, math.nan, math.nan)
    with_squared = result(squared_mahalanobis=squared, wrong_scene=(False, False, False))
    append(tmp_path, [with_squared, result()])
    first, second = read(tmp_path)
    assert first.squared_mahalanobis[0] == 3.25
    assert np.isnan(first.squared_mahalanobis[1:]).all()
    assert first.refused.tolist() == [False, True, False]
    assert second.squared_mahalanobis == ()
    assert "squared" not in (tmp_path / RESULTS).read_text().splitlines()[1]


@pytest.mark.parametrize("cut", [1, 40])
def test_incomplete_last_line_is_removed(tmp_path: Path, cut: int) -> None:
    append(tmp_path, [result(), result(1)])
    path = tmp_path / RESULTS
    path.write_bytes(path.read_bytes()[:-cut])
    assert read(tmp_path) == [result()]
    append(tmp_path, [result(1)])
    assert read(tmp_path) == [result(), result(1)]


@pytest.mark.parametrize("line", ["nonsense", "[1]", '{"strategy": "evercal"}'])
def test_invalid_line_is_refused(tmp_path: Path, line: str) -> None:
    append(tmp_path, [result()])
    with open(tmp_path / RESULTS, "a", encoding="utf-8") as file:
        file.write(line + "\n")
    with pytest.raises(InputError, match=r"results\.jsonl: line 2 is not a result"):
        read(tmp_path)


def test_correct_frames_are_strictly_below_both_thresholds() -> None:
    assert result().correct((0.05, 1.0)).tolist() == [True, False, False]
    assert result().correct((0.06, 1.0)).tolist() == [True, False, True]
    assert result().correct((0.06, 0.01)).tolist() == [False, False, True]
    assert not np.any(result().correct((math.inf, 0.0)))
