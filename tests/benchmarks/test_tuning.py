"""The best trial of every method is selected on held-out frames."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks import tuning
from evercal.continual.benchmark import results
from evercal.continual.benchmark.bench import BenchOptions
from evercal.continual.benchmark.results import SceneResult
from evercal.continual.benchmark.rows import load_rows, strategy_from_row
from evercal.continual.learning.stage import StageOptions
from evercal.errors import InputError
from evercal.recordings import Recording


def result(
    strategy: str, stage: int, scene: str, errors_m: tuple[float, ...], seed: int = 0
) -> SceneResult:
    n = len(errors_m)
    return SceneResult(
        strategy=strategy,
        seed=seed,
        stage=stage,
        scene=scene,
        frames=tuple(map(str, range(n))),
        translation_m=errors_m,
        rotation_rad=(0.0,) * n,
        wrong_scene=(False,) * n,
        near_training_frame=(False,) * n,
        seconds=1.0,
        memory_bytes=0,
        head_bytes=0,
        frames_kept=0,
    )


def test_final_scores_use_the_last_stage(tmp_path: Path) -> None:
    results.append(
        tmp_path,
        [
            result("er_0.1", 0, "a", (0.0, 0.0)),
            result("er_0.1", 1, "a", (0.1, math.inf)),
            result("er_0.1", 1, "b", (0.04, 0.0)),
            # The second seed learns the scenes in the other order.
            result("er_0.1", 0, "b", (0.0, 0.0), 1),
            result("er_0.1", 1, "b", (0.0, 0.0), 1),
            result("er_0.1", 1, "a", (0.0, math.inf), 1),
        ],
    )
    row = {"name": "er_0.1", "of": "er", "with": {"weight": 0.1}}
    assert tuning.final_scores(tmp_path, [strategy_from_row("t", row)]) == {
        "er_0.1": {
            "auc_20cm": 66.25,
            "auc_earlier": 62.5,
            "auc_newest": 70.0,
            "accuracy_5cm_5deg": 62.5,
        }
    }


@pytest.fixture
def options(arc_stage: StageOptions) -> BenchOptions:
    def stage(seed: int) -> StageOptions:
        fit = replace(arc_stage.fit, iterations=4, batch=64, replay_batch=32)
        encode = replace(arc_stage.encode, views_per_frame=1, seed=seed)
        return replace(arc_stage, fit=fit, encode=encode, replay_views_per_frame=1, seed=seed)

    return BenchOptions(stage, (), (0,), short_side=120, settings={"suite": "arcs"})


def test_best_trial_and_rows_derived_from_it_are_written(
    arcs: tuple[Recording, Recording], options: BenchOptions, tmp_path: Path
) -> None:
    scenes = [replace(arc, train=arc.train[:18], test=arc.test[:3]) for arc in arcs]
    file = tmp_path / "tuned" / "arcs.json"
    tuning.tune(scenes, options, ("er",), file, tmp_path / "out")
    outcomes = json.loads(file.with_suffix(".outcomes.json").read_text())
    assert outcomes["settings"]["suite"] == "arcs"
    trials = [(row["method"], row["setting"], row["value"]) for row in outcomes["rows"]]
    values = [value for _, _, value in trials]
    assert {(method, setting) for method, setting, _ in trials} == {("er", "weight")}
    assert values == sorted(values)
    assert set(values) >= {0.1, 0.3, 1.0, 3.0, 10.0}
    assert len(values) in (5, 7)
    best = max(outcomes["rows"], key=lambda row: row["auc_20cm"])["value"]
    assert json.loads(file.read_text()) == [
        {"name": "er", "of": "er", "with": {"weight": best}},
        {"name": "sars_reprojection", "of": "er", "with": {"weight": best, "selector": "sars"}},
    ]
    assert [strategy.name for strategy in load_rows(str(file))] == ["er", "sars_reprojection"]


def test_a_best_trial_at_the_end_of_a_range_has_more_beyond_it() -> None:
    weights = [{"weight": w} for w in (0.1, 0.3, 1.0)]
    assert tuning.beyond(weights, 1) == []
    assert tuning.beyond(weights, 0) == [{"weight": 0.033}, {"weight": 0.011}]
    scales = [{"penalty": {"scale": s}} for s in (1.0, 3.0)]
    assert tuning.beyond(scales, 1) == [{"penalty": {"scale": 9.0}}, {"penalty": {"scale": 27.0}}]
    assert tuning.beyond([{"kept_share": k} for k in (0.9, 0.97)], 1) == []


def test_unusable_arguments_are_refused(options: BenchOptions, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--methods joint: choose of er, "):
        tuning.tune([], options, ("joint",), tmp_path / "f.json", tmp_path)
    with pytest.raises(InputError, match="--scenes 1: give 2 or more"):
        tuning.run("sim-mini", tmp_path / "tuned.json", scenes=1)
