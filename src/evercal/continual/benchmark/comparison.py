"""Comparison of strategies: scores of every run, and tables with one row per strategy."""

import math
from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd

from evercal.continual.benchmark.results import Table
from evercal.errors import InputError
from evercal.evaluation.metrics import ContinualScores, continual_scores
from evercal.typing import JsonObject, Pair

COARSE_COLUMN = "within_5cm_5deg"
"""Column of results.csv that counts frames within 5 cm and 5 deg."""
FINE_COLUMN = "within_1cm_1deg"
"""Column of results.csv that counts frames within 1 cm and 1 deg."""
FINAL = "final %"
"""Column of `run_scores`: accuracy after the last stage."""
AREA = "area to 20 cm"
"""Column of `run_scores`: area under the curve of recall over position error."""
LEGEND = """\
Accuracy: share of all test frames strictly below 5 cm and 5 deg, mean over scenes.
final: accuracy after the last stage. last scene: accuracy on the scene learned last.
area to 20 cm: area under the curve of recall over position error, up to 20 cm, per cent.
ACC: mean accuracy over all stages and the scenes learned by then.
TFR (total forgetting rate): mean drop from the best accuracy of a scene to its final one.
forgetting: the same drop, with the best taken before the last stage; negative is a gain.
BWT (backward transfer): mean change from the accuracy just after learning a scene to the end.
s: seconds of learning, all stages.
NAME:unaligned is the pose from matched keyframes, before landmarks are aligned."""
"""Definitions of the columns of `run_scores`."""


def complete_runs(results: Table) -> Table:
    """Return the rows of runs whose last stage is complete."""
    last = results["stage"].max()
    at_end = results["stage"].eq(last)
    evaluated = at_end.groupby([results["strategy"], results["seed"]]).transform("sum")
    complete = results[evaluated == last + 1]
    if complete.empty:
        raise InputError("no run is complete; continue with 'evercal bench'")
    return complete


def run_scores(results: Table) -> Table:
    """Score every complete run: a row per strategy and seed, with the columns of `LEGEND`.

    Forgetting and memory of joint training are NaN.
    """
    scores = {(name, seed): _scores(run) for name, seed, run in _runs(results)}
    table = pd.DataFrame.from_dict(scores, orient="index")
    return table.rename_axis(["strategy", "seed"])


def _runs(results: Table) -> Iterator[tuple[str, int, Table]]:
    """Strategy, seed and rows of every complete run."""
    complete = complete_runs(results)
    for (name, seed), run in complete.groupby(["strategy", "seed"], sort=False):
        yield str(name), int(seed), run


def last_stage(results: Table) -> Table:
    """Return the rows of the last stage."""
    return results[results["stage"] == results["stage"].max()]


def _scores(run: Table) -> dict[str, float]:
    coarse = continual(matrix(run))
    fine = continual(matrix(run, FINE_COLUMN))
    last = last_stage(run)
    inside = math.nan
    with_covariance = last["with_covariance"].sum()
    if with_covariance:
        inside = 100 * last["inside_95"].sum() / with_covariance
    memory_mb = last["memory_bytes"].iloc[0] / 1e6
    if math.isnan(coarse.total_forgetting):  # joint training needs all frames again
        memory_mb = math.nan
    return {
        FINAL: coarse.final_accuracy,
        "1 cm 1 deg %": fine.final_accuracy,
        AREA: float(last["area_20cm"].mean()),
        "ACC": coarse.accuracy_along,
        "last scene %": coarse.last_scene_accuracy,
        "TFR": coarse.total_forgetting,
        "forgetting": coarse.forgetting,
        "BWT": coarse.backward_transfer,
        "wrong scene %": 100 * float((last["wrong_scene"] / last["frames"]).mean()),
        "refused %": 100 * float((last["refused"] / last["frames"]).mean()),
        "in 95 % ellipsoid": inside,
        "memory MB": memory_mb,
        "heads MB": last["head_bytes"].iloc[0] / 1e6,
        "s": _seconds(run),
    }


def _seconds(run: Table) -> float:
    """Seconds of learning, all stages."""
    return float(run.groupby("stage")["seconds"].last().sum())


def matrix(run: Table, column: str = COARSE_COLUMN) -> Table:
    """Return accuracies of a run, per cent: a row per stage, a column per scene as learned.

    `column` is one of `WITHIN`.
    """
    scenes = list(last_stage(run)["scene"])
    percent = 100 * run[column] / run["frames"]
    shares = run.assign(share=percent)
    accuracies = shares.pivot_table(index="stage", columns="scene", values="share")
    return accuracies.reindex(index=range(len(scenes)), columns=scenes)


def continual(accuracies: Table) -> ContinualScores:
    """Return final accuracy and forgetting; forgetting is NaN for joint training."""
    values = accuracies.to_numpy(float)
    measured = values[np.tril_indices(len(values))]
    if np.isfinite(measured).all():
        return continual_scores(values)
    nan = math.nan
    last = values[-1]
    return ContinualScores(float(last.mean()), nan, nan, nan, float(last[-1]), nan)


def method_table(scores: Table) -> Table:
    """Average `run_scores` over runs, best strategy first, with the spread of the final accuracy.

    A mean is NaN if one of its values is.
    """
    grouped = scores.groupby(level="strategy", sort=False)
    means = grouped.mean().where(grouped.count().eq(grouped.size(), axis=0))
    runs = grouped.size()
    spread = grouped[FINAL].std()
    table = formatted(means)
    several = table[FINAL] + " ± " + formatted(spread)
    table[FINAL] = table[FINAL].where(spread.isna(), several)
    table.insert(0, "runs", runs)
    best_first = means[FINAL].sort_values(ascending=False, kind="stable")
    return table.loc[best_first.index]


def scene_table(results: Table) -> Table:
    """Tabulate the accuracy of each scene: just after learning it -> at the end, means of runs."""
    runs = []
    for name, _, run in _runs(results):
        accuracies = matrix(run)
        columns = {
            "strategy": name,
            "scene": accuracies.columns,
            "learned": np.diag(accuracies),
            "end": accuracies.iloc[-1].to_numpy(),
        }
        runs.append(pd.DataFrame(columns))
    means = pd.concat(runs).groupby(["strategy", "scene"], sort=False).mean()
    text = formatted(means)
    return (text["learned"] + " -> " + text["end"]).unstack(sort=False)


def contrast_table(scores: Table, pairs: Sequence[tuple[str, str]]) -> Table:
    """Tabulate differences of pairs of strategies on common seeds, in points; see `run_scores`.

    Final accuracy and area, each with the bounds of `seeds_interval`, which hold for all pairs
    together, and the number of runs in which the first strategy is better.
    """
    by_name = dict(list(scores[[FINAL, AREA]].groupby(level="strategy")))
    none = scores[:0][[FINAL, AREA]]
    rows = {}
    for ours, theirs in pairs:
        first = by_name.get(ours, none).droplevel("strategy")
        second = by_name.get(theirs, none).droplevel("strategy")
        gains = (first - second).dropna()
        cells: list[object] = [len(gains)]
        for name in (FINAL, AREA):
            cells += _contrast_cells(gains[name], len(pairs))
        rows[f"{ours} - {theirs}"] = cells
    columns = ["runs"]
    for name in (FINAL, AREA):
        columns += [name, "bounds", "better in"]
    index = pd.Index(rows, name="contrast, points")
    return pd.DataFrame(list(rows.values()), index, columns=columns)


def _contrast_cells(gains: Table, comparisons: int) -> list[object]:
    """Mean, bounds and number of positive ones of gains (runs,); `-` where there are too few."""
    if not len(gains):
        return ["-", "-", "-"]
    bounds = "-"
    low, high = seeds_interval(gains, comparisons)
    if not math.isnan(low):
        bounds = f"{low:+.1f} to {high:+.1f}"
    return [f"{gains.mean():+.1f}", bounds, int((gains > 0).sum())]


def seeds_interval(values: Sequence[float], comparisons: int = 1) -> Pair:
    """Estimate a 95 % interval of a mean over runs with other seeds and orders, on the same rooms.

    Student's t over the runs. It covers the choice of seed and order, not that of rooms, paths or
    frames. With several comparisons all their intervals hold together (Bonferroni).

    Returns:
        Low and high, NaN for fewer than two runs.
    """
    from scipy.stats import sem, t

    if len(values) < 2:
        return math.nan, math.nan
    mean = float(np.mean(values))
    half = float(t.ppf(1 - 0.025 / comparisons, len(values) - 1) * sem(values))
    return mean - half, mean + half


def formatted(table: Table) -> Table:
    """Format numbers with one digit; NaN becomes `-`."""
    return table.map("{:.1f}".format).where(table.notna(), "-")


def summary(results: Table) -> dict[str, list[JsonObject]]:
    """Summarize every complete run for JSON, by strategy; NaN becomes None."""
    strategies = {}
    for name, seed, run in _runs(results):
        last = last_stage(run).iloc[0]
        coarse = matrix(run)
        strategies.setdefault(name, []).append(
            {
                "seed": seed,
                "scenes": list(coarse.columns),
                "accuracy_5cm_5deg": _plain(coarse),
                "accuracy_1cm_1deg": _plain(matrix(run, FINE_COLUMN)),
                **continual(coarse).to_dict(),
                "memory_bytes": int(last["memory_bytes"]),
                "head_bytes": int(last["head_bytes"]),
                "seconds": _seconds(run),
            }
        )
    return strategies


def _plain(accuracies: Table) -> list[list[float | None]]:
    values = accuracies.round(3).astype(object)
    return values.where(accuracies.notna(), None).to_numpy().tolist()
