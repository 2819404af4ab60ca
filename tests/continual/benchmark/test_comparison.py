"""Tables from results by hand: matrices, forgetting, pairs of seeds, joint training."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from evercal.continual.benchmark.comparison import (
    AREA,
    Run,
    as_text,
    contrast_rows,
    difference,
    difference_rows,
    method_rows,
    runs_of,
    scene_rows,
    selector_rows,
    summary,
    threshold_rows,
)
from evercal.continual.benchmark.results import SceneResult
from evercal.errors import InputError

FRAMES = 20


def result(strategy: str, seed: int, stage: int, scene: str, correct: int) -> SceneResult:
    """`correct` of 20 frames are off by 2 cm, one is in another scene, the others by 30 cm."""
    errors = [0.02] * correct + [math.inf] + [0.3] * (FRAMES - correct - 1)
    return SceneResult(
        strategy=strategy,
        seed=seed,
        stage=stage,
        scene=scene,
        frames=tuple(f"{i}" for i in range(FRAMES)),
        translation_m=tuple(errors),
        rotation_rad=tuple(0.01 if math.isfinite(e) else e for e in errors),
        wrong_scene=tuple(not math.isfinite(e) for e in errors),
        near_training_frame=(False,) * FRAMES,
        seconds=10.0 + stage,
        memory_bytes=2_000_000,
        head_bytes=3_000_000,
        frames_kept=2,
    )


def lines(strategy: str, seed: int, rows: Sequence[Sequence[int]]) -> list[SceneResult]:
    """A run over the scenes b, a: row i has the correct frames after stage i."""
    return [
        result(strategy, seed, stage, "ba"[i], correct)
        for stage, row in enumerate(rows)
        for i, correct in enumerate(row)
    ]


OURS = lines("ours", 0, [[16], [14, 12]]) + lines("ours", 1, [[18], [18, 10]])
THEIRS = lines("theirs", 0, [[16], [4, 14]])
JOINT = [result("joint", 0, 1, scene, 18) for scene in "ba"]


def test_accuracy_matrix_and_its_scores() -> None:
    run = runs_of(OURS)[0]
    assert run.scenes == ("b", "a")
    np.testing.assert_allclose(run.matrix()[np.tril_indices(2)], [80, 70, 60])
    assert math.isnan(run.matrix()[0, 1])
    scores = run.scores()
    assert scores.final_accuracy == pytest.approx(65)
    assert scores.total_forgetting == scores.forgetting == pytest.approx(10)
    assert scores.backward_transfer == pytest.approx(-10)
    assert scores.last_scene_accuracy == pytest.approx(60)


def test_incomplete_runs_are_ignored() -> None:
    incomplete = lines("late", 0, [[16]])
    assert [(r.strategy, r.seed) for r in runs_of(OURS + incomplete)] == [("ours", 0), ("ours", 1)]
    with pytest.raises(InputError, match="no run is complete"):
        runs_of([])


def test_joint_training_has_no_forgetting() -> None:
    run = runs_of(OURS + JOINT)[-1]
    assert run.scores().final_accuracy == pytest.approx(90)
    assert math.isnan(run.scores().total_forgetting)
    _, row = method_rows([run])
    assert [*row[:4], *row[5:9]] == ["joint", "1", "90.0", "0.0", "-", "90.0", "-", "-"]


def test_method_table_shows_means_and_spread() -> None:
    header, ours, theirs = method_rows(runs_of(OURS + THEIRS))
    # Finals 65 and 70; last scene 60 and 50; forgetting 10 and 0;
    # ACC (80 + 70 + 60) / 3 and (90 + 90 + 50) / 3.
    assert [*ours[:4], *ours[5:8]] == ["ours", "2", "67.5 ± 3.5", "0.0", "73.3", "55.0", "5.0"]
    # A frame off by 2 cm has 90 % of the area to 20 cm, other frames nothing.
    assert float(ours[4]) == pytest.approx(0.9 * 67.5, abs=0.06)
    # One of 20 frames is in the wrong scene. Of the other 38, 26 and 28 are correct.
    assert ours[10:] == ["5.0", "0.0", "-", "2.0", "71.1", "2.0", "3.0", "21.0"]
    assert theirs[2] == "45.0"
    text = as_text([header, ours, theirs], "markdown")
    assert [line.count("|") for line in text.splitlines()] == [19] * 4


def test_refused_frames_and_ellipsoids_are_counted() -> None:
    """Two of 20 frames are refused; of 17 poses, 3 are outside their ellipsoid."""

    def with_covariance(line: SceneResult) -> SceneResult:
        errors = (*line.translation_m[:-2], math.inf, math.inf)
        squared = (*(20.0,) * 3, *(5.0,) * 14, *(math.nan,) * 3)
        return replace(line, translation_m=errors, squared_mahalanobis=squared)

    results = [with_covariance(line) for line in lines("ours", 0, [[16], [16, 16]])]
    columns = dict(zip(*method_rows(runs_of(results)), strict=True))
    assert columns["wrong scene %"] == "5.0"
    assert columns["refused %"] == "10.0"
    assert columns["in 95 % ellipsoid"] == f"{100 * 14 / 17:.1f}"


def test_threshold_table_uses_strict_bounds() -> None:
    header, ours = threshold_rows(runs_of(OURS))
    bounds = ["10 cm 10 deg", "5 cm 5 deg", "2 cm 2 deg", "1 cm 1 deg"]
    assert header == ["strategy", "area to 20 cm", *bounds]
    # Errors are 2 cm or 30 cm; an error of 2 cm gives nine tenths of the area.
    assert ours == ["ours", "60.8", "67.5", "67.5", "0.0", "0.0"]


def test_selector_table_shows_coverage() -> None:
    covered = [
        replace(line, covering_radius=0.6, min_spacing=0.25)
        for line in OURS
        if line.stage == "ba".index(line.scene)
    ]
    others = [line for line in OURS if line.stage != "ba".index(line.scene)]
    assert selector_rows(runs_of(covered + others + THEIRS)) == [
        ["strategy", "frames kept", "covering radius", "smallest pair"],
        ["ours", "2.0", "0.60", "0.25"],
    ]
    assert len(selector_rows(runs_of(THEIRS))) == 1


def test_scene_table_shows_accuracy_when_learned_and_at_the_end() -> None:
    # b: (80 + 90) / 2 -> (70 + 90) / 2
    assert scene_rows(runs_of(OURS)) == [
        ["strategy", "a", "b"],
        ["ours", "55.0 -> 55.0", "85.0 -> 80.0"],
    ]


def test_differences_are_paired_by_seed_and_frame() -> None:
    runs = runs_of(OURS + THEIRS)
    ours, theirs = ([r for r in runs if r.strategy == s] for s in ("ours", "theirs"))
    interval = difference(ours, theirs)
    assert interval is not None
    # Seed 0 is common: b has 14 against 4 of 20, a has 12 against 14.
    assert 100 * interval.mean == pytest.approx((50 - 10) / 2)
    assert interval.low < interval.mean < interval.high
    assert difference_rows(runs, "ours")[1][:2] == ["ours - theirs", "+20.0"]
    other = runs_of(lines("other", 7, [[16], [4, 14]]))
    assert difference(ours, other) is None
    assert len(difference_rows([*ours, *other], "ours")) == 1


def test_differences_match_scenes_by_name() -> None:
    flipped = [result("theirs", 0, 0, "a", 10)]
    flipped += [result("theirs", 0, 1, "a", 12), result("theirs", 0, 1, "b", 14)]
    interval = difference(runs_of(OURS)[:1], runs_of(flipped))
    assert interval is not None
    assert interval.mean == pytest.approx(0)


def test_intervals_depend_on_runs_of_frames() -> None:
    runs = runs_of(OURS + THEIRS)

    def renamed(run: Run, names: list[str]) -> Run:
        results = {k: replace(o, frames=tuple(names)) for k, o in run.results.items()}
        return replace(run, results=results)

    widths = []
    for names in (
        [f"frame-{i:06d}" for i in range(FRAMES)],
        [f"seq-{i // 5}/frame-{i:06d}" for i in range(FRAMES)],
    ):
        interval = difference([renamed(runs[0], names)], [renamed(runs[2], names)])
        assert interval is not None
        widths.append(interval.high - interval.low)
    assert widths[0] != pytest.approx(widths[1], rel=0.1)


def test_summary_has_whole_matrices_and_no_nan() -> None:
    strategies = summary(runs_of(OURS + JOINT))
    assert strategies["joint"][0]["accuracy_5cm_5deg"] == [[None, None], [90.0, 90.0]]
    assert strategies["joint"][0]["total_forgetting"] is None
    assert [run["seed"] for run in strategies["ours"]] == [0, 1]


def test_contrasts_pair_seeds_and_name_missing_runs() -> None:
    """Ours ends at 65 and 70 %, theirs at 45 and 55 %: 20 and 15 points; t(1) = 25.452 at 99 %."""
    theirs = THEIRS + lines("theirs", 1, [[16], [10, 12]])
    header, row, none = contrast_rows(
        runs_of(OURS + theirs), [("ours", "theirs"), ("ours", "joint")]
    )
    scores = [head for name in ("final %", AREA) for head in (name, "bounds", "better in")]
    assert header == ["contrast, points", "runs", *scores]
    half = 25.452 * 2.5
    bounds = f"{17.5 - half:+.1f} to {17.5 + half:+.1f}"
    assert row[:5] == ["ours - theirs", "2", "+17.5", bounds, "2"]
    assert float(row[5]) == pytest.approx(0.9 * 17.5, abs=0.06)
    assert row[7] == "2"
    assert none == ["ours - joint", "0", *["-"] * 6]
