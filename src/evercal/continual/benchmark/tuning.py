"""Tuning: every method with a weight is tried with several, on held-out training frames.

    OUT/tuned.csv    a row per trial: the area under the recall curve to 20 cm, mean over runs

A trial is a strategy of its own, called NAME@WEIGHT.
"""

from collections.abc import Generator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import pandas as pd

from evercal.continual.benchmark import comparison, results
from evercal.continual.benchmark.bench import CompletedStage, run_bench
from evercal.continual.benchmark.results import Table
from evercal.continual.benchmark.strategy_run import BenchOptions
from evercal.continual.strategies import Strategy
from evercal.errors import InputError
from evercal.recordings import Recording
from evercal.storage import write_bytes

TUNED = "tuned.csv"
"""File of the trials."""
TRIALS: Mapping[str, Sequence[float]] = {
    "weight": (0.1, 0.3, 1.0, 3.0, 10.0),
    "alpha": (8.0, 32.0, 128.0, 512.0, 2048.0),
    "strength": (1e4, 1e5, 1e6, 1e7, 1e8),
}
"""Weights that are tried, by the field of the method. Beyond the end of a row two more follow."""


def run_tuning(
    scenes: Sequence[Recording], options: BenchOptions, out: Path
) -> Generator[CompletedStage, None, None]:
    """Run all trials of the strategies, and those beyond an end that is best; write the table.

    `scenes` have held-out training frames in place of test frames. Resumes as `run_bench`.
    """
    weights = {}
    for strategy in options.strategies:
        if strategy.method and strategy.method.weight_field:
            weights[strategy] = TRIALS[strategy.method.weight_field]
    if not weights:
        raise InputError(
            "no strategy to tune; give `strategies` with a weight, such as er"
        )
    yield from run_bench(scenes, replace(options, strategies=_trials(weights)), out)
    table = tuned(out)
    for strategy, tried in weights.items():
        weights[strategy] = beyond(table.loc[strategy.name, "auc_20cm"].reindex(tried))
    yield from run_bench(scenes, replace(options, strategies=_trials(weights)), out)
    write_bytes(out / TUNED, tuned(out).to_csv().encode())


def _trials(weights: Mapping[Strategy, Sequence[float]]) -> tuple[Strategy, ...]:
    trials = []
    for strategy, tried in weights.items():
        for weight in tried:
            name = f"{strategy.name}@{weight:g}"
            trials.append(replace(strategy.weighted(weight), name=name))
    return tuple(trials)


def beyond(areas: Table) -> Sequence[float]:
    """Two weights beyond the best one, if it is the least or the greatest; areas by weight."""
    ordered = areas.sort_values(ascending=False)
    best = float(ordered.index[0])
    inside = areas.index[1:-1]
    if best in inside:
        return ()
    ratio = best / min(inside, key=lambda weight: abs(weight - best))
    return best * ratio, best * ratio**2


def tuned(folder: Path) -> Table:
    """Tabulate the trials: areas to 20 cm of all, earlier and newest scenes, and accuracy."""
    last = comparison.last_stage(results.read(folder))
    parts = last["strategy"].str.rpartition("@")
    trials = [parts[0].rename("method"), parts[2].astype(float).rename("value")]
    is_newest = ~last.duplicated(["strategy", "seed"], keep="last")
    areas = last["area_20cm"]
    columns = {
        "auc_20cm": areas,
        "auc_earlier": areas.mask(is_newest),
        "auc_newest": areas.where(is_newest),
        "accuracy_5cm_5deg": 100 * last["within_5cm_5deg"] / last["frames"],
    }
    table: Table = pd.DataFrame(columns)
    return table.groupby(trials).mean().round(2)
