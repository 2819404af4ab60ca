"""Tunes every method alike: four trials of its one setting, on held-out training frames.

Few frames are held out, and accuracy under one threshold varies from run to run. Trials are
therefore compared by the area under the curve of recall over position error (`recall_area`).
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from tabulate import tabulate
from tyro.conf import Positional

from evercal.continual.benchmark import results
from evercal.continual.benchmark.bench import BenchOptions, run_bench
from evercal.continual.benchmark.rows import read_rows, strategy_from_row
from evercal.continual.benchmark.suites import load_suite, tuning_split
from evercal.continual.learning.presets import on_paper_backbone, preset
from evercal.continual.learning.stage import StageOptions
from evercal.continual.strategies import Strategy
from evercal.errors import InputError
from evercal.evaluation import recall_area
from evercal.recordings import Recording
from evercal.storage import write_json
from evercal.storage.settings import read_settings

Trials = Sequence[Mapping[str, object]]
WEIGHTS: Trials = [{"weight": w} for w in (0.1, 0.3, 1.0, 3.0)]
STRENGTHS: Trials = [{"strength": s} for s in (1e4, 1e5, 1e6, 1e7)]
ALPHAS: Trials = [{"alpha": a} for a in (8.0, 32.0, 128.0, 512.0)]
TRIALS: dict[str, Trials] = {
    **dict.fromkeys(("er", "hybrid", "gdr", "gss", "mir", "lwf"), WEIGHTS),
    **dict.fromkeys(("icarl", "buff_cs", "der", "co2l"), WEIGHTS),
    **dict.fromkeys(("ewc", "ewc_online", "si"), STRENGTHS),
    "mas": [{"strength": s} for s in (1e3, 1e4, 1e5, 1e6)],
    "agem": [{"clamp_px": c} for c in (20.0, 50.0, 100.0, 200.0)],
    "gem": [{"margin": m} for m in (0.3, 1.0, 3.0, 10.0)],
    **dict.fromkeys(("gec", "gec_moving"), ALPHAS),
    "gpm": [{"kept_share": k} for k in (0.6, 0.8, 0.9, 0.97)],
    "sars_spdd": [{"penalty": {"scale": s}} for s in (0.3, 1.0, 3.0, 10.0)],
    "evercal_network": [{"weight": w} for w in (0.17, 0.5, 1.5, 4.5)],
}
"""Trials of each method; `finetune`, `joint` and `isolation` have no setting."""
DERIVED = {"evercal_hybrid": "evercal_network", "sars_spdd_filled": "sars_spdd"}
"""Strategies that take the setting of another."""


def run(
    suite: Positional[str],
    file: Path,
    data: Path | None = None,
    scenes: int = 3,
    methods: tuple[str, ...] = (),
    backbone: Literal["evercal", "paper"] = "evercal",
    steps: int | None = None,
    out: Path = Path("runs/tune"),
) -> None:
    """Run four trials of every method's setting on held-out training frames; resumes.

    Args:
        suite: Suite whose first scenes are learned.
        file: File for the best rows, for `evercal bench --rows`. All trials are written beside it.
        data: Folder of the suite's recordings.
        scenes: Number of its scenes.
        methods: Methods to tune. Defaults to all.
        backbone: Network to train: ours, or the paper's.
        steps: Optimiser steps of a stage. Defaults to that of preset `bench`.
        out: Folder for runs and results.
    """
    if scenes < 2:
        raise InputError(f"--scenes {scenes}: give 2 or more to measure forgetting")

    def stage(seed: int) -> StageOptions:
        options = preset("bench", seed)
        options = on_paper_backbone(options) if backbone == "paper" else options
        iterations = options.fit.iterations if steps is None else steps
        return replace(options, fit=replace(options.fit, iterations=iterations))

    settings: dict[str, object] = {"suite": suite, "judged": "held-out training frames"}
    options = BenchOptions(stage, (), (0,), settings=settings)
    split = [tuning_split(scene) for scene in load_suite(suite, data)[:scenes]]
    tune(split, options, methods, file, out / suite)


def tune(
    scenes: Sequence[Recording],
    options: BenchOptions,
    methods: Sequence[str],
    file: Path,
    out: Path,
) -> None:
    """Run the trials, and write the best row of every method.

    Args:
        scenes: Scenes in order of learning; their test frames are held-out training frames.
        options: Options of the benchmark; its strategies are replaced by the trials.
        methods: Keys of `TRIALS`. Defaults to all.
        file: File for the best rows; `.outcomes.json` beside it gets all trials.
        out: Folder for runs and results.

    Raises:
        InputError: A method without trials.
    """
    unknown = [name for name in methods if name not in TRIALS]
    if unknown:
        raise InputError(f"--methods {' '.join(unknown)}: choose of {', '.join(TRIALS)}")
    trials = {name: TRIALS[name] for name in methods or TRIALS}
    rows = [
        {"name": _name(method, changes), "of": method, "with": changes}
        for method, tried in trials.items()
        for changes in tried
    ]
    strategies = tuple(strategy_from_row("tuning", row) for row in rows)
    for step in run_bench(scenes, replace(options, strategies=strategies), out):
        print(f"[{step.done}/{step.total}] {step.strategy}", flush=True)
    final = final_scores(out, strategies, len(scenes))
    best = {
        method: max(tried, key=lambda changes: final[_name(method, changes)]["auc_20cm"])
        for method, tried in trials.items()
    }
    best |= {name: best[like] for name, like in DERIVED.items() if like in best}
    chosen = [{"name": name, "of": name, "with": changes} for name, changes in best.items()]
    for row in read_rows("table4"):
        if row["of"] in best and row["name"] not in best:
            chosen.append({**row, "with": {**best[row["of"]], **row["with"]}})
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("[\n" + ",\n".join(f"  {json.dumps(row)}" for row in chosen) + "\n]\n")
    outcomes = [
        {"method": method, "setting": setting, "value": value, **final[_name(method, changes)]}
        for method, tried in trials.items()
        for changes in tried
        for setting, value in [_setting(changes)]
    ]
    settings = read_settings(out / results.SETTINGS)
    write_json(file.with_suffix(".outcomes.json"), {"settings": settings, "rows": outcomes})
    print(tabulate(outcomes, headers="keys", floatfmt=".1f"))


def _setting(changes: object) -> tuple[str, object]:
    """Return name and value of the one number that a trial changes."""
    name = ""
    while isinstance(changes, Mapping):
        ((name, changes),) = changes.items()
    return name, changes


def _name(method: str, changes: Mapping[str, object]) -> str:
    return f"{method}_{_setting(changes)[1]:g}"


def final_scores(
    out: Path, strategies: Sequence[Strategy], stages: int
) -> dict[str, dict[str, float]]:
    """Summarize each strategy after the last stage.

    Returns:
        By name, per cent: area under the recall curve up to 20 cm as the mean over scenes
        (`auc_20cm`), over earlier scenes (`auc_earlier`) and for the newest (`auc_newest`), and the
        accuracy at 5 cm and 5 deg (`accuracy_5cm_5deg`).
    """
    areas: dict[str, list[float]] = {strategy.name: [] for strategy in strategies}
    shares: dict[str, list[float]] = {strategy.name: [] for strategy in strategies}
    for result in results.read(out):
        if result.stage == stages - 1 and result.strategy in areas:
            areas[result.strategy].append(recall_area(result.translation_m))
            shares[result.strategy].append(100 * result.accuracy())
    return {
        name: {
            "auc_20cm": round(float(np.mean(area)), 2),
            "auc_earlier": round(float(np.mean(area[:-1])), 2),
            "auc_newest": round(area[-1], 2),
            "accuracy_5cm_5deg": round(float(np.mean(shares[name])), 2),
        }
        for name, area in areas.items()
    }
