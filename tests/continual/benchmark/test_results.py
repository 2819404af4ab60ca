"""Lines of results: nothing is lost on the way, and a kill costs at most the last one."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from evercal.continual.benchmark.results import RESULTS, SceneResult, append, read
from evercal.errors import InputError


def result(stage: int = 0, scene: str = "a", **changed: object) -> SceneResult:
    made: dict[str, object] = {
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
    return SceneResult(**{**made, **changed})  # pyright: ignore[reportArgumentType]


def test_what_is_written_is_read(tmp_path: Path) -> None:
    assert read(tmp_path) == []
    first, second = result(), result(1, "b")
    append(tmp_path, [first])
    append(tmp_path, [second, result(1, "a")])
    assert read(tmp_path) == [first, second, result(1, "a")]


def test_what_was_kept_is_told_where_it_is_known(tmp_path: Path) -> None:
    told = result(
        keyframe_positions_m=((0.5, 1.0, -2.0), (1.5, 0.0, 0.25)),
        covering_radius=0.75,
        min_spacing=math.inf,
    )
    append(tmp_path, [told, result(1)])
    first, second = read(tmp_path)
    assert first == result(
        keyframe_positions_m=told.keyframe_positions_m, covering_radius=0.75
    )  # one frame has no pair
    assert math.isnan(first.min_spacing)
    assert math.isnan(second.covering_radius)
    # Lines of before these fields.
    path = tmp_path / RESULTS
    record = json.loads(path.read_text().splitlines()[1])
    for name in ("keyframe_positions_m", "covering_radius", "min_spacing"):
        del record[name]
    path.write_text(json.dumps(record) + "\n")
    assert read(tmp_path) == [result(1)]


def test_squared_errors_and_refusals(tmp_path: Path) -> None:
    told = result(squared_mahalanobis=(3.25, math.nan, math.nan), wrong_scene=(False, False, False))
    append(tmp_path, [told, result()])
    first, second = read(tmp_path)
    assert first.squared_mahalanobis[0] == 3.25
    assert np.isnan(first.squared_mahalanobis[1:]).all()
    assert first.refused.tolist() == [False, True, False]
    assert second.squared_mahalanobis == ()
    assert "squared" not in (tmp_path / RESULTS).read_text().splitlines()[1]


@pytest.mark.parametrize("cut", [1, 40])
def test_a_line_cut_short_is_taken_away(tmp_path: Path, cut: int) -> None:
    append(tmp_path, [result(), result(1)])
    path = tmp_path / RESULTS
    path.write_bytes(path.read_bytes()[:-cut])
    assert read(tmp_path) == [result()]
    append(tmp_path, [result(1)])
    assert read(tmp_path) == [result(), result(1)]


@pytest.mark.parametrize("line", ["nonsense", "[1]", '{"strategy": "evercal"}'])
def test_a_line_that_is_no_result_is_named(tmp_path: Path, line: str) -> None:
    append(tmp_path, [result()])
    with open(tmp_path / RESULTS, "a", encoding="utf-8") as file:
        file.write(line + "\n")
    with pytest.raises(InputError, match=r"results\.jsonl: line 2 is not a result"):
        read(tmp_path)


def test_correct_is_strictly_below_both() -> None:
    assert result().correct((0.05, 1.0)).tolist() == [True, False, False]
    assert result().correct((0.06, 1.0)).tolist() == [True, False, True]
    assert result().correct((0.06, 0.01)).tolist() == [False, False, True]
    assert not np.any(result().correct((math.inf, 0.0)))
