"""Tunes every method alike: five trials of its one setting, on held-out training frames.

Where the best trial is the first or the last, two more follow on that side. Few frames are held
out, and accuracy under one threshold varies from run to run. Trials are therefore compared by the
area under the curve of recall over position error (`recall_area`).
"""

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from evercal.continual.benchmark.rows import read_rows, strategy_from_row
from tabulate import tabulate
from tyro.conf import Positional

from evercal.continual.benchmark import results
from evercal.continual.benchmark.bench import BenchOptions, begin_bench, run_bench
from evercal.continual.benchmark.comparison import by_strategy, runs_of
from evercal.continual.benchmark.suites import load_suite, tuning_split
from evercal.continual.learning.presets import BACKBONES, Backbone
from evercal.continual.learning.presets import preset as preset_named
from evercal.continual.learning.stage import StageOptions
from evercal.continual.strategies import Strategy
from evercal.errors import InputError
from evercal.evaluation import recall_area
from evercal.recordings import Recording
from evercal.storage import write_json
from evercal.storage.settings import read_settings

Trials = Sequence[Mapping[str, object]]
WEIGHTS: Trials = [{"weight": w} for w in (0.1, 0.3, 1.0, 3.0, 10.0)]
STRENGTHS: Trials = [{"strength": s} for s in (1e4, 1e5, 1e6, 1e7, 1e8)]
ALPHAS: Trials = [{"alpha": a} for a in (8.0, 32.0, 128.0, 512.0, 2048.0)]
TRIALS: dict[str, Trials] = {
    **dict.fromkeys(("er", "hybrid", "gdr", "gss", "mir", "lwf"), WEIGHTS),
    **dict.fromkeys(("icarl", "buff_cs", "der", "co2l"), WEIGHTS),
    **dict.fromkeys(("ewc", "ewc_online", "si"), STRENGTHS),
    "mas": [{"strength": s} for s in (1e3, 1e4, 1e5, 1e6, 1e7)],
    "agem": [{"clamp_px": c} for c in (20.0, 50.0, 100.0, 200.0, 400.0)],
    "gem": [{"margin": m} for m in (0.1, 0.3, 1.0, 3.0, 10.0)],
    **dict.fromkeys(("gec", "gec_moving"), ALPHAS),
    "gpm": [{"kept_share": k} for k in (0.4, 0.6, 0.8, 0.9, 0.97)],
    "sars_spdd": [{"penalty": {"scale": s}} for s in (0.1, 0.3, 1.0, 3.0, 10.0)],
    "evercal_network": [{"weight": w} for w in (0.05, 0.17, 0.5, 1.5, 4.5)],
}
"""Trials of each method; `finetune`, `joint` and `isolation` have no setting."""
LARGEST = {"kept_share": 1.0}
"""Settings that have a bound; trials beyond it are omitted."""
MORE = 2
"""Trials that are added beside a best one at the end of the range."""
DERIVED = {"evercal_hybrid": "evercal_network", "sars_spdd_filled": "sars_spdd"}
"""Strategies that take the setting of another."""


def run(
    suite: Positional[str],
    file: Path,
    data: Path | None = None,
    scenes: int = 3,
    seeds: tuple[int, ...] = (102, 105),
    methods: tuple[str, ...] = (),
    rows: tuple[str, ...] = (),
    backbone: Backbone = "evercal",
    preset: str = "converged",
    steps: int | None = None,
    out: Path = Path("runs/tune"),
) -> None:
    """Run five trials of every method's setting on held-out training frames; resumes.

    The same command in a second terminal shares the runs with the first.

    Args:
        suite: Suite whose first scenes are learned.
        file: File for the best rows, for `evercal bench --rows`. All trials are written beside it.
        data: Folder of the suite's recordings.
        scenes: Number of its scenes.
        seeds: Seeds of every trial; tables use others. They decide the order of the scenes, as
            `evercal bench --order balanced` does: 102 keeps the order of three, 105 reverses it.
        methods: Methods to tune. Defaults to all.
        rows: Rows to write. Defaults to those of all tuned methods and their variants.
        backbone: Network to train, see `BACKBONES`.
        preset: Preset of the training effort.
        steps: Optimiser steps of a stage. Defaults to those of the preset.
        out: Folder for runs and results.
    """
    if scenes < 2:
        raise InputError(f"--scenes {scenes}: give 2 or more to measure forgetting")

    def stage(seed: int) -> StageOptions:
        options = preset_named(preset, seed)
        options = BACKBONES[backbone](options)
        iterations = options.fit.iterations if steps is None else steps
        return replace(options, fit=replace(options.fit, iterations=iterations))

    settings: dict[str, object] = {"suite": suite, "judged": "held-out training frames"}
    options = BenchOptions(stage, (), seeds, "balanced", settings=settings)
    split = [tuning_split(scene) for scene in load_suite(suite, data)[:scenes]]
    tune(split, options, methods, file, out / suite, rows)


def tune(
    scenes: Sequence[Recording],
    options: BenchOptions,
    methods: Sequence[str],
    file: Path,
    out: Path,
    wanted: Sequence[str] = (),
) -> None:
    """Run the trials, and write the best row of every method.

    Args:
        scenes: Scenes in order of learning; their test frames are held-out training frames.
        options: Options of the benchmark; its strategies are replaced by the trials.
        methods: Keys of `TRIALS`. Defaults to all.
        file: File for the best rows; `.outcomes.json` beside it gets all trials.
        out: Folder for runs and results.
        wanted: Rows to write. Defaults to those of all tuned methods and their variants.

    Raises:
        InputError: A method without trials.
    """
    unknown = [name for name in methods if name not in TRIALS]
    if unknown:
        raise InputError(f"--methods {' '.join(unknown)}: choose of {', '.join(TRIALS)}")
    trials = {name: list(TRIALS[name]) for name in methods or TRIALS}
    final = _run_trials(scenes, options, trials, out)
    for method, tried in trials.items():
        scores = [final[_name(method, changes)]["auc_20cm"] for changes in tried]
        more = beyond(tried, int(np.argmax(scores)))
        trials[method] = sorted([*tried, *more], key=lambda changes: _setting(changes)[1])
    final = _run_trials(scenes, options, trials, out)
    best = {
        method: max(tried, key=lambda changes: final[_name(method, changes)]["auc_20cm"])
        for method, tried in trials.items()
    }
    best |= {name: best[like] for name, like in DERIVED.items() if like in best}
    chosen = [{"name": name, "of": name, "with": changes} for name, changes in best.items()]
    for row in read_rows("table4"):
        if row["of"] in best and row["name"] not in best:
            chosen.append({**row, "with": {**best[row["of"]], **row["with"]}})
    chosen = [row for row in chosen if not wanted or row["name"] in wanted]
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


def _run_trials(
    scenes: Sequence[Recording],
    options: BenchOptions,
    trials: Mapping[str, Trials],
    out: Path,
) -> dict[str, dict[str, float]]:
    """Run the trials that are missing; return `final_scores` of all."""
    rows = [
        {"name": _name(method, changes), "of": method, "with": changes}
        for method, tried in trials.items()
        for changes in tried
    ]
    strategies = tuple(strategy_from_row("tuning", row) for row in rows)
    options = replace(options, strategies=strategies)
    while begin_bench(scenes, options, out):
        for step in run_bench(scenes, options, out):
            print(f"[{step.done}/{step.total}] {step.strategy}", flush=True)
        time.sleep(1)  # another process may still have a run
    return final_scores(out, strategies)


def beyond(tried: Trials, best: int) -> list[Mapping[str, object]]:
    """Return the trials beyond the end of a range at which the best one lies, in equal ratios."""
    if 0 < best < len(tried) - 1:
        return []
    inner = tried[1] if best == 0 else tried[-2]
    name, value = _setting(tried[best])
    ratio = value / _setting(inner)[1]
    values = [value * ratio**k for k in range(1, MORE + 1)]
    return [
        _with_value(tried[best], float(f"{v:.2g}"))
        for v in values
        if v < LARGEST.get(name, float("inf"))
    ]


def _with_value(changes: Mapping[str, object], value: float) -> dict[str, object]:
    """Return the changes of a trial with another value."""
    ((name, inner),) = changes.items()
    return {name: _with_value(inner, value) if isinstance(inner, Mapping) else value}


def _setting(changes: Mapping[str, object]) -> tuple[str, float]:
    """Return name and value of the one number that a trial changes."""
    ((name, value),) = changes.items()
    if isinstance(value, Mapping):
        return _setting(value)
    assert isinstance(value, float)
    return name, value


def _name(method: str, changes: Mapping[str, object]) -> str:
    return f"{method}_{_setting(changes)[1]:g}"


def final_scores(out: Path, strategies: Sequence[Strategy]) -> dict[str, dict[str, float]]:
    """Summarize each strategy after the last stage.

    Returns:
        By name, per cent, means over seeds. `auc_20cm` is the area under the recall curve up to
        20 cm, `auc_earlier` that of earlier scenes and `auc_newest` that of the newest.
        `accuracy_5cm_5deg` is the final accuracy.
    """
    names = {strategy.name for strategy in strategies}
    lines = [result for result in results.read(out) if result.strategy in names]
    groups = by_strategy(runs_of(lines))
    areas = {  # (seeds, scenes in the order of learning)
        name: np.array([[recall_area(end.translation_m) for end in run.last] for run in group])
        for name, group in groups.items()
    }
    finals = {
        name: np.mean([run.scores().final_accuracy for run in group])
        for name, group in groups.items()
    }
    return {
        name: {
            "auc_20cm": round(float(area.mean()), 2),
            "auc_earlier": round(float(area[:, :-1].mean()), 2),
            "auc_newest": round(float(area[:, -1].mean()), 2),
            "accuracy_5cm_5deg": round(float(finals[name]), 2),
        }
        for name, area in areas.items()
    }
