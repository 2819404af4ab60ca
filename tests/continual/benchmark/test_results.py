"""Rows survive a round trip, and an interruption costs at most the last line."""

import math
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from evercal.continual.benchmark.results import (
    FRAMES,
    RESULTS,
    StageResults,
    append,
    frame_row,
    read,
    scene_row,
)
from evercal.errors import InputError
from evercal.evaluation.metrics import CHI2_6

from .results_by_hand import OURS, frame

RUN = {"strategy": "er", "seed": 0}
FIRST = OURS[:1]
LAST = OURS[1:3]
TESTS = pd.DataFrame(
    [{**RUN, **frame_row(frame("b", str(i), 0.01 * i))} for i in range(3)]
)


def frames_in(folder: Path) -> pd.DataFrame:
    return pd.read_csv(folder / FRAMES, dtype={"frame": str})


def stage(number: int) -> StageResults:
    return StageResults(number, (FIRST, LAST)[number], TESTS if number else TESTS[:0])


def test_results_round_trip(tmp_path: Path) -> None:
    assert read(tmp_path).empty
    append(tmp_path, stage(0))
    append(tmp_path, stage(1))
    whole: pd.DataFrame = pd.concat([FIRST, LAST], ignore_index=True)  # pyright: ignore
    pd.testing.assert_frame_equal(read(tmp_path), whole)
    pd.testing.assert_frame_equal(frames_in(tmp_path), TESTS)


def test_incomplete_last_line_is_removed_and_written_again(tmp_path: Path) -> None:
    append(tmp_path, stage(0))
    append(tmp_path, stage(1))
    whole = read(tmp_path)
    for name in (RESULTS, FRAMES):
        path = tmp_path / name
        path.write_bytes(path.read_bytes()[:-5])
    assert len(read(tmp_path)) == 2
    append(tmp_path, stage(1))
    pd.testing.assert_frame_equal(read(tmp_path).reset_index(drop=True), whole)
    frames = frames_in(tmp_path)
    assert len(frames) == 2 + 3
    again = frames.drop_duplicates(["scene", "frame"], keep="last", ignore_index=True)
    pd.testing.assert_frame_equal(again, TESTS)


def test_other_tables_are_refused(tmp_path: Path) -> None:
    (tmp_path / RESULTS).write_text("strategy,seed\ner,0\n")
    with pytest.raises(
        InputError, match=r"results\.csv: no columns environment, frames"
    ):
        read(tmp_path)


def test_frames_are_counted_strictly_below_both_thresholds() -> None:
    frames = [frame("a", "0", 0.049), frame("a", "1", 0.05), frame("a", "2", math.inf)]
    frames.append(replace(frame("a", "3", 0.001), rotation_error_rad=math.radians(5)))
    row = scene_row(frames)
    assert (row["frames"], row["within_5cm_5deg"], row["within_10cm_10deg"]) == (
        4,
        1,
        3,
    )
    assert row["median_mm"] == 50.0
    assert (row["wrong_scene"], row["refused"]) == (1, 0)
    # 75.5 %, 75 %, nothing and 99.5 % of the area to 20 cm
    assert row["area_20cm"] == pytest.approx(62.5)


def test_outcomes_of_frames_add_up_to_those_of_the_scene() -> None:
    refused = replace(
        frame("a", "3", math.inf), status="unknown_scene", found_scene=None
    )
    frames = [
        frame("a", "0", 0.01, CHI2_6 - 0.1),
        frame("a", "1", 0.01, CHI2_6 + 0.1),
        frame("a", "2", math.inf),
        refused,
        frame("a", "4", 0.01),
    ]
    outcomes = [frame_row(each)["outcome"] for each in frames]
    assert outcomes == ["inside", "outside", "wrong scene", "refused", "no covariance"]
    row = scene_row(frames)
    counts = [
        row[key] for key in ("wrong_scene", "refused", "with_covariance", "inside_95")
    ]
    assert counts == [1, 1, 2, 1]
    assert frame_row(refused)["error_mm"] == math.inf
