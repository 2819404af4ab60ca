"""Tunes every method alike: four trials of its one setting, judged on held-out training frames.

Few frames are held out, and the share within one bound jumps from run to run; so the judge is the
area under the curve of recall over position error (`evaluation.recall_area`).
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from tabulate import tabulate

from evercal.continual.benchmark import results
from evercal.continual.benchmark.bench import BenchOptions, run_bench
from evercal.continual.benchmark.rows import read_rows, strategy_from_row
from evercal.continual.benchmark.suites import load_suite, tuning_split
from evercal.continual.presets import on_paper_backbone, preset
from evercal.continual.stage import StageOptions
from evercal.continual.strategies import Strategy
from evercal.errors import InputError
from evercal.evaluation import recall_area
from evercal.storage import read_settings, write_json

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
"""The setting of each method that is tuned; `finetune`, `joint` and `isolation` have none."""
ALIKE = {"evercal_hybrid": "evercal_network", "sars_spdd_filled": "sars_spdd"}
"""Strategies that take the setting of another: the same method beside a map, or other frames."""


def run(
    suite: str,
    data: Path | None,
    scenes: int,
    out: Path,
    file: Path,
    methods: Sequence[str] = (),
    paper_backbone: bool = False,
    steps: int | None = None,
) -> None:
    """Runs what is missing, and writes the best row of every method, best first in a table.

    Args:
        suite: whose first scenes are learned.
        data: folder of its recordings.
        scenes: how many of them.
        out: folder of results; the same command goes on there.
        file: JSON of `evercal bench --rows`; `.outcomes.json` beside it gets all trials.
        methods: keys of `TRIALS`; all when empty.
        paper_backbone: on the paper's network instead of ours.
        steps: optimiser steps of a stage; those of preset `bench` when None.

    Raises:
        InputError: a method that has no setting to tune, or fewer than two scenes.
    """
    if scenes < 2:
        raise InputError(f"--scenes {scenes}: give 2 or more; an earlier one must be forgotten")
    unknown = [name for name in methods if name not in TRIALS]
    if unknown:
        raise InputError(f"--methods {' '.join(unknown)}: choose of {', '.join(TRIALS)}")
    tried = {name: trials for name, trials in TRIALS.items() if not methods or name in methods}

    def stage(seed: int) -> StageOptions:
        of = preset("bench", seed)
        of = on_paper_backbone(of) if paper_backbone else of
        return of if steps is None else replace(of, fit=replace(of.fit, iterations=steps))

    recorded = load_suite(suite, data, (), None)[:scenes]
    split = [tuning_split(scene) for scene in recorded]
    rows = [row for name in tried for row in _rows(name)]
    strategies = tuple(strategy_from_row("tuning", row) for row in rows)
    judged: dict[str, object] = {"suite": suite, "judged": "held-out training frames"}
    options = BenchOptions(stage, strategies, (0,), settings=judged)
    for step in run_bench(split, options, out):
        print(f"[{step.done}/{step.total}] {step.strategy}", flush=True)
    final = final_scores(out, strategies, len(split))
    file.parent.mkdir(parents=True, exist_ok=True)
    settings = {
        of: max(trials, key=lambda changes: final[_name(of, changes)]["auc_20cm"])
        for of, trials in tried.items()
    }
    settings |= {name: settings[like] for name, like in ALIKE.items() if like in settings}
    chosen = [{"name": name, "of": name, "with": changes} for name, changes in settings.items()]
    for row in read_rows("table4"):
        if row["of"] in settings and row["name"] not in settings:
            chosen.append({**row, "with": {**settings[row["of"]], **row["with"]}})
    file.write_text("[\n" + ",\n".join(f"  {json.dumps(row)}" for row in chosen) + "\n]\n")
    told = [
        {"method": row["of"], **_setting(row["with"]), **final[str(row["name"])]} for row in rows
    ]
    outcomes = {"settings": read_settings(out / results.SETTINGS), "rows": told}
    write_json(file.with_suffix(".outcomes.json"), outcomes)
    print(tabulate(told, headers="keys", floatfmt=".1f"))


def _setting(changes: object) -> dict[str, object]:
    """The one number that a trial changes, by the name of its field."""
    name = ""
    while isinstance(changes, dict):
        ((name, changes),) = changes.items()
    return {"setting": name, "value": changes}


def _rows(name: str) -> list[dict[str, object]]:
    """The trials of a method, named by their values so that a range may be moved later."""
    return [{"name": _name(name, changes), "of": name, "with": changes} for changes in TRIALS[name]]


def _name(method: str, changes: Mapping[str, object]) -> str:
    return f"{method}_{_setting(changes)['value']:g}"


def final_scores(
    out: Path, strategies: Sequence[Strategy], stages: int
) -> dict[str, dict[str, float]]:
    """How well each strategy knows all scenes at the end.

    Returns:
        By name, per cent: area under the curve of recall over position error up to 20 cm, mean over
        scenes (`auc_20cm`), over the earlier ones (`auc_earlier`) and of the last (`auc_newest`);
        share of frames within 5 cm and 5 deg, mean over scenes (`accuracy_5cm_5deg`).
    """
    areas: dict[str, list[float]] = {strategy.name: [] for strategy in strategies}
    shares: dict[str, list[float]] = {strategy.name: [] for strategy in strategies}
    for result in results.read(out):
        if result.stage == stages - 1 and result.strategy in areas:
            areas[result.strategy].append(recall_area(result.translation_m))
            shares[result.strategy].append(100 * result.accuracy())
    return {
        name: {
            "auc_20cm": round(float(np.mean(of)), 2),
            "auc_earlier": round(float(np.mean(of[:-1])), 2),
            "auc_newest": round(of[-1], 2),
            "accuracy_5cm_5deg": round(float(np.mean(shares[name])), 2),
        }
        for name, of in areas.items()
    }
