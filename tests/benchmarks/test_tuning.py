"""Which trial of a method is taken."""

import json
import math
from pathlib import Path

import pytest

from benchmarks import tuning
from evercal.continual.benchmark import results
from evercal.continual.benchmark.bench import BenchOptions
from evercal.continual.benchmark.results import SceneResult
from evercal.continual.benchmark.rows import load_rows, strategy_from_row
from evercal.errors import InputError
from evercal.storage import write_json


def result(strategy: str, stage: int, scene: str, errors_m: tuple[float, ...]) -> SceneResult:
    n = len(errors_m)
    return SceneResult(
        strategy,
        0,
        stage,
        scene,
        tuple(map(str, range(n))),
        errors_m,
        (0.0,) * n,
        (False,) * n,
        (False,) * n,
        1.0,
        0,
        0,
        0,
    )


def test_area_counts_every_centimetre_and_only_the_last_stage(tmp_path: Path) -> None:
    found = [
        result("er_0.1", 0, "a", (0.0, 0.0)),  # forgotten later
        result("er_0.1", 1, "a", (0.1, math.inf)),
        result("er_0.1", 1, "b", (0.04, 0.0)),
    ]
    results.append(tmp_path, found)
    row = {"name": "er_0.1", "of": "er", "with": {"weight": 0.1}}
    assert tuning.final_scores(tmp_path, [strategy_from_row("t", row)], 2) == {
        "er_0.1": {
            "auc_20cm": 57.5,
            "auc_earlier": 25.0,
            "auc_newest": 90.0,
            "accuracy_5cm_5deg": 50.0,
        }
    }


def test_the_best_trial_of_every_method_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors = {"er_0.1": 0.15, "er_0.3": 0.02, "er_1": 0.06, "er_3": 0.3}

    def bench(scenes: list[object], options: BenchOptions, out: Path) -> list[object]:
        out.mkdir()
        write_json(out / results.SETTINGS, {"suite": "sim-mini"})
        for scene in "ab":
            results.append(out, [result(k, 1, scene, (v,)) for k, v in errors.items()])
        assert options.settings["judged"] == "held-out training frames"
        return []

    monkeypatch.setattr(tuning, "TRIALS", {"er": tuning.WEIGHTS})
    monkeypatch.setattr(tuning, "load_suite", lambda *_: ["a", "b"])
    monkeypatch.setattr(tuning, "tuning_split", lambda scene: scene)
    monkeypatch.setattr(tuning, "run_bench", bench)
    file = tmp_path / "tuned.json"
    tuning.run("sim-mini", None, 2, tmp_path / "out", file)
    found, others = {"weight": 0.3}, {"weight": 0.3, "selector": "sars"}
    assert json.loads(file.read_text()) == [
        {"name": "er", "of": "er", "with": found},
        {"name": "sars_reprojection", "of": "er", "with": others},
    ]
    assert [strategy.name for strategy in load_rows(str(file))] == ["er", "sars_reprojection"]
    outcomes = json.loads(file.with_suffix(".outcomes.json").read_text())
    told = outcomes["rows"]
    assert outcomes["settings"] == {"suite": "sim-mini"}
    assert [(one["method"], one["setting"], one["value"]) for one in told] == [
        ("er", "weight", 0.1),
        ("er", "weight", 0.3),
        ("er", "weight", 1.0),
        ("er", "weight", 3.0),
    ]
    assert [one["auc_20cm"] for one in told] == [25.0, 90.0, 70.0, 0.0]
    assert [one["accuracy_5cm_5deg"] for one in told] == [0.0, 100.0, 0.0, 0.0]


def test_what_is_trained_can_be_the_papers_network_and_a_few_methods(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[BenchOptions] = []

    def bench(scenes: list[object], options: BenchOptions, out: Path) -> list[object]:
        asked.append(options)
        out.mkdir()
        write_json(out / results.SETTINGS, {"suite": "sim-mini"})
        results.append(
            out, [result(s.name, 1, at, (0.1,)) for s in options.strategies for at in "ab"]
        )
        return []

    monkeypatch.setattr(tuning, "load_suite", lambda *_: ["a", "b"])
    monkeypatch.setattr(tuning, "tuning_split", lambda scene: scene)
    monkeypatch.setattr(tuning, "run_bench", bench)
    where = ("sim-mini", None, 2, tmp_path / "out", tmp_path / "tuned.json")
    tuning.run(*where, methods=("er", "sars_spdd"), paper_backbone=True, steps=7)
    (options,) = asked
    assert {s.name.rpartition("_")[0] for s in options.strategies} == {"er", "sars_spdd"}
    stage = options.stage(0)
    assert stage.fit.iterations == 7
    assert stage.head.condition == "descriptor"
    assert stage.fit.loss.schedule == "circle"
    names = [row["name"] for row in json.loads((tmp_path / "tuned.json").read_text())]
    assert names == ["er", "sars_spdd", "sars_spdd_filled", "sars_reprojection", "reservoir_spdd"]
    with pytest.raises(InputError, match="--methods joint: choose of er, "):
        tuning.run(*where, methods=("joint",))
    with pytest.raises(InputError, match="--scenes 1: give 2 or more"):
        tuning.run("sim-mini", None, 1, tmp_path / "out", tmp_path / "tuned.json")
