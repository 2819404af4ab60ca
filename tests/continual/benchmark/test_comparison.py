"""Tables from outcomes, by hand: matrices, forgetting, pairs of seeds, joint training."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from evercal.continual.benchmark.comparison import (
    Run,
    as_text,
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


def result(strategy: str, seed: int, stage: int, scene: str, right: int) -> SceneResult:
    """`right` of 20 frames are 2 cm off, one is in another scene, the others are 30 cm off."""
    errors = [0.02] * right + [math.inf] + [0.3] * (FRAMES - right - 1)
    return SceneResult(
        strategy,
        seed,
        stage,
        scene,
        tuple(f"{i}" for i in range(FRAMES)),
        tuple(errors),
        tuple(0.01 if math.isfinite(e) else e for e in errors),
        tuple(not math.isfinite(e) for e in errors),
        (False,) * FRAMES,
        seconds=10.0 + stage,
        memory_bytes=2_000_000,
        head_bytes=3_000_000,
        frames_kept=2,
    )


def lines(strategy: str, seed: int, rows: Sequence[Sequence[int]]) -> list[SceneResult]:
    """A run over the scenes b, a: row i holds the right frames after stage i."""
    return [
        result(strategy, seed, stage, "ba"[i], right)
        for stage, row in enumerate(rows)
        for i, right in enumerate(row)
    ]


OURS = lines("ours", 0, [[16], [14, 12]]) + lines("ours", 1, [[18], [18, 10]])
THEIRS = lines("theirs", 0, [[16], [4, 14]])


def test_a_matrix_by_hand() -> None:
    run = runs_of(OURS)[0]
    assert run.scenes == ("b", "a")
    np.testing.assert_allclose(run.matrix()[np.tril_indices(2)], [80, 70, 60])
    assert math.isnan(run.matrix()[0, 1])
    found = run.scores()
    assert found.final_accuracy == pytest.approx(65)
    assert found.total_forgetting == found.forgetting == pytest.approx(10)
    assert found.backward_transfer == pytest.approx(-10)
    assert found.last_scene_accuracy == pytest.approx(60)


def test_a_run_under_way_does_not_count() -> None:
    begun = lines("late", 0, [[16]])
    assert [(r.strategy, r.seed) for r in runs_of(OURS + begun)] == [("ours", 0), ("ours", 1)]
    with pytest.raises(InputError, match="no run is done"):
        runs_of([])


def test_joint_training_has_a_last_row_and_nothing_to_forget() -> None:
    joint = [result("joint", 0, 1, scene, 18) for scene in "ba"]
    run = runs_of(OURS + joint)[-1]
    assert run.scores().final_accuracy == pytest.approx(90)
    assert math.isnan(run.scores().total_forgetting)
    _, row = method_rows([run])
    assert row[:8] == ["joint", "1", "90.0", "0.0", "-", "90.0", "-", "-"]


def test_the_method_table_shows_means_and_spread() -> None:
    header, ours, theirs = method_rows(runs_of(OURS + THEIRS))
    # Finals 65 and 70; last scene 60 and 50; forgetting 10 and 0; one of 20 frames is misplaced;
    # along the way (80 + 70 + 60) / 3 and (90 + 90 + 50) / 3.
    assert ours[:7] == ["ours", "2", "67.5 ± 3.5", "0.0", "73.3", "55.0", "5.0"]
    # Of the 38 frames in the right scene 26 and 28 are right.
    assert ours[9:] == ["5.0", "0.0", "-", "2.0", "71.1", "2.0", "3.0", "21.0"]
    assert theirs[2] == "45.0"
    text = as_text([header, ours, theirs], "markdown")
    assert [line.count("|") for line in text.splitlines()] == [18] * 4


def test_refused_frames_and_ellipsoids_are_counted() -> None:
    """Two of 20 frames are refused, and of 17 poses 3 lie outside their ellipsoid."""

    def told(outcome: SceneResult) -> SceneResult:
        errors = (*outcome.translation_m[:-2], math.inf, math.inf)
        squared = (*(20.0,) * 3, *(5.0,) * 14, *(math.nan,) * 3)
        return replace(outcome, translation_m=errors, squared_mahalanobis=squared)

    header, ours = method_rows(runs_of([told(o) for o in lines("ours", 0, [[16], [16, 16]])]))
    columns = dict(zip(header, ours, strict=True))
    assert columns["wrong scene %"] == "5.0"
    assert columns["refused %"] == "10.0"
    assert columns["in 95 % ellipsoid"] == f"{100 * 14 / 17:.1f}"


def test_intervals_resample_whole_runs_of_frames() -> None:
    """The same flags, their frames numbered as one run or as four: other pieces, other bounds."""
    runs = runs_of(OURS + THEIRS)

    def named(run: Run, names: list[str]) -> Run:
        results = {k: replace(o, frames=tuple(names)) for k, o in run.results.items()}
        return replace(run, results=results)

    sequences = [f"seq-{i // 5}/frame-{i:06d}" for i in range(FRAMES)]
    pieces = []
    for names in ([f"frame-{i:06d}" for i in range(FRAMES)], sequences):
        found = difference([named(runs[0], names)], [named(runs[2], names)])
        assert found is not None
        pieces.append(found.high - found.low)
    # Ours is right on 16 and 10 more frames of b: of two halves 2 and 8, of four fifths 0 0 5 5.
    assert pieces[0] != pytest.approx(pieces[1], rel=0.1)


def test_bounds_are_strict() -> None:
    header, ours = threshold_rows(runs_of(OURS))
    bounds = ["10 cm 10 deg", "5 cm 5 deg", "2 cm 2 deg", "1 cm 1 deg"]
    assert header == ["strategy", "area to 20 cm", *bounds]
    # Errors are 2 cm or 30 cm: each of the former has nine tenths of the area.
    assert ours == ["ours", "60.8", "67.5", "67.5", "0.0", "0.0"]


def test_selectors_are_told_by_how_their_frames_lie() -> None:
    kept = {
        "keyframe_positions_m": ((0.0, 0, 0), (1.0, 0, 0)),
        "covering_radius": 0.6,
        "min_spacing": 0.25,
    }
    tell = [replace(o, **kept) if o.stage == "ba".index(o.scene) else o for o in OURS]
    header, ours = selector_rows(runs_of(tell + THEIRS))
    assert header == ["strategy", "frames kept", "covering radius", "smallest pair"]
    assert ours == ["ours", "2.0", "0.60", "0.25"]


def test_the_scene_table_shows_learned_and_end() -> None:
    # b: (80 + 90) / 2 -> (70 + 90) / 2
    assert scene_rows(runs_of(OURS)) == [
        ["strategy", "a", "b"],
        ["ours", "55.0 -> 55.0", "85.0 -> 80.0"],
    ]


def test_differences_are_paired_by_seed_and_frame() -> None:
    runs = runs_of(OURS + THEIRS)
    ours, theirs = ([r for r in runs if r.strategy == s] for s in ("ours", "theirs"))
    found = difference(ours, theirs)
    assert found is not None
    # Seed 0 alone: b 14 against 4 of 20, a 12 against 14.
    assert 100 * found.mean == pytest.approx((50 - 10) / 2)
    assert found.low < found.mean < found.high
    assert difference_rows(runs, "ours")[1][:2] == ["ours - theirs", "+20.0"]
    other = runs_of(lines("other", 7, [[16], [4, 14]]))
    assert difference(ours, other) is None
    assert len(difference_rows([*ours, *other], "ours")) == 1


def test_the_summary_holds_whole_matrices_and_no_nan() -> None:
    joint = [result("joint", 0, 1, scene, 18) for scene in "ba"]
    found = summary(runs_of(OURS + joint))
    assert found["joint"][0]["accuracy_5cm_5deg"] == [[None, None], [90.0, 90.0]]  # pyright: ignore[reportIndexIssue]
    assert found["joint"][0]["total_forgetting"] is None  # pyright: ignore[reportIndexIssue]
    assert [run["seed"] for run in found["ours"]] == [0, 1]  # pyright: ignore[reportGeneralTypeIssues]


def test_runs_in_another_order_are_compared_by_name() -> None:
    flipped = [result("theirs", 0, 0, "a", 10)]
    flipped += [result("theirs", 0, 1, "a", 12), result("theirs", 0, 1, "b", 14)]
    found = difference(runs_of(OURS)[:1], runs_of(flipped))
    assert found is not None
    assert found.mean == pytest.approx(0)
    assert isinstance(runs_of(flipped)[0], Run)
