"""Comparison of strategies: scores of every run, and tables with one row per strategy."""

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd

from evercal.continual.benchmark.results import Table
from evercal.errors import InputError
from evercal.evaluation.metrics import ContinualScores, continual_scores

COARSE_COLUMN = "within_5cm_5deg"
FINE_COLUMN = "within_1cm_1deg"
FINAL = "final %"
AREA = "area to 20 cm"
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
    scores = {key: _scores(run) for key, run in _runs(complete_runs(results)).items()}
    return pd.DataFrame.from_dict(scores, orient="index").rename_axis(
        ["strategy", "seed"]
    )


def _runs(results: Table) -> dict[tuple[str, int], Table]:
    grouped = results.groupby(["strategy", "seed"], sort=False)
    return {(str(name), int(seed)): run for (name, seed), run in grouped}


def _scores(run: Table) -> dict[str, float]:
    coarse, fine = (
        continual(matrix(run, name)) for name in (COARSE_COLUMN, FINE_COLUMN)
    )
    last = run[run["stage"] == run["stage"].max()]
    located = last["with_covariance"].sum()
    jointly = math.isnan(coarse.total_forgetting)
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
        "in 95 % ellipsoid": 100 * last["inside_95"].sum() / located
        if located
        else math.nan,
        # Joint training needs all frames again.
        "memory MB": math.nan if jointly else last["memory_bytes"].iloc[0] / 1e6,
        "heads MB": last["head_bytes"].iloc[0] / 1e6,
        "s": float(run.groupby("stage")["seconds"].last().sum()),
    }


def matrix(run: Table, column: str = COARSE_COLUMN) -> Table:
    """Return accuracies of a run, per cent: a row per stage, a column per scene as learned.

    `column` is one of `WITHIN`.
    """
    scenes = run.loc[run["stage"] == run["stage"].max(), "scene"]
    shares = run.assign(share=100 * run[column] / run["frames"])
    accuracies = shares.pivot_table(index="stage", columns="scene", values="share")
    return accuracies.reindex(index=range(len(scenes)), columns=list(scenes))


def continual(accuracies: Table) -> ContinualScores:
    """Return final accuracy and forgetting; forgetting is NaN for joint training."""
    values = accuracies.to_numpy(float)
    if np.isfinite(values[np.tril_indices(len(values))]).all():
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
    table[FINAL] = [
        mean if np.isnan(deviation) else f"{mean} ± {deviation:.1f}"
        for mean, deviation in zip(table[FINAL], spread, strict=True)
    ]
    table.insert(0, "runs", runs)
    return table.loc[means[FINAL].sort_values(ascending=False, kind="stable").index]


def scene_table(results: Table) -> Table:
    """Tabulate the accuracy of each scene: just after learning it -> at the end, means of runs."""
    rows = []
    for (name, _), run in _runs(complete_runs(results)).items():
        accuracies = matrix(run)
        ends = zip(
            accuracies.columns, np.diag(accuracies), accuracies.iloc[-1], strict=True
        )
        rows += [(name, scene, first, end) for scene, first, end in ends]
    cells = pd.DataFrame(rows, columns=["strategy", "scene", "learned", "end"])
    means = cells.groupby(["strategy", "scene"], sort=False)[["learned", "end"]].mean()
    text = formatted(means)
    return (text["learned"] + " -> " + text["end"]).unstack(sort=False)


def contrast_table(scores: Table, pairs: Sequence[tuple[str, str]]) -> Table:
    """Tabulate differences of pairs of strategies on common seeds, in points; see `run_scores`.

    Final accuracy and area, each with the bounds of `seeds_interval`, which hold for all pairs
    together, and the number of runs in which the first strategy is better.
    """
    scores = scores[[FINAL, AREA]]
    by_name = dict(list(scores.groupby(level="strategy")))
    heads = [head for name in (FINAL, AREA) for head in (name, "bounds", "better in")]
    rows = {}
    for ours, theirs in pairs:
        a, b = (
            by_name.get(name, scores[:0]).droplevel("strategy")
            for name in (ours, theirs)
        )
        gains = (a - b).dropna()
        cells: list[object] = [len(gains)]
        for name in (FINAL, AREA):
            low, high = seeds_interval(gains[name], len(pairs))
            bounds = "-" if math.isnan(low) else f"{low:+.1f} to {high:+.1f}"
            mean = f"{gains[name].mean():+.1f}" if len(gains) else "-"
            cells += [mean, bounds, int((gains[name] > 0).sum()) if len(gains) else "-"]
        rows[f"{ours} - {theirs}"] = cells
    index = pd.Index(rows, name="contrast, points")
    return pd.DataFrame(list(rows.values()), index, columns=["runs", *heads])


def seeds_interval(
    values: Sequence[float], comparisons: int = 1
) -> tuple[float, float]:
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
    return table.map(lambda value: "-" if math.isnan(value) else f"{value:.1f}")


def summary(results: Table) -> dict[str, list[dict[str, object]]]:
    """Summarize every complete run for JSON, by strategy; NaN becomes None."""
    strategies: dict[str, list[dict[str, object]]] = {}
    for (name, seed), run in _runs(complete_runs(results)).items():
        last = run[run["stage"] == run["stage"].max()].iloc[0]
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
                "seconds": float(run.groupby("stage")["seconds"].last().sum()),
            }
        )
    return strategies


def _plain(accuracies: Table) -> list[list[float | None]]:
    known = accuracies.notna()
    return accuracies.round(3).astype(object).where(known, None).to_numpy().tolist()
