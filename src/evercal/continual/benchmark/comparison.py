"""Comparison of strategies: scores of every run, and tables with one row per strategy."""

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd

from evercal.classes import frozen
from evercal.continual.benchmark.results import Table
from evercal.evaluation.metrics import continual_scores
from evercal.typing import Pair

FINAL = "final %"
"""Column of `run_scores`: accuracy after the last stage."""
NEWEST = "newest %"
"""Column of `run_scores`: accuracy on the scene learned last."""
TFR = "TFR"
"""Column of `run_scores`: total forgetting rate."""
AREA = "area to 20 cm"
"""Column of `run_scores`: area under the curve of recall over position error."""
GATES = {"code": 95.0, "descriptor": 90.0}
"""Accuracy of joint training, per cent, below which a budget is too small for a verdict; by
`HeadOptions.condition`, which is `descriptor` on the paper's network (research/protocol.md)."""
LEGEND = """\
Accuracy: share of all test frames with both errors strictly below the threshold, mean over scenes.
The threshold is 1 cm and 1 deg for suites sim*, 5 cm and 5 deg for others, as in the paper. Columns
that end in a length are at the other threshold.
final: accuracy after the last stage. newest: accuracy on the scene learned last.
area to 20 cm: area under the curve of recall over position error, up to 20 cm, per cent.
ACC: mean accuracy over all stages and the scenes learned by then.
TFR (total forgetting rate): mean drop from the best accuracy of a scene to its final one.
forgetting: the same drop, with the best taken before the last stage; negative is a gain.
BWT (backward transfer): mean change from the accuracy just after learning a scene to the end.
published: the paper's numbers; for suites sim* those of its Sim data set, whose rooms are others.
s: seconds of learning, all stages. Encoding and depths count in the run that needs them first."""
"""Definitions of the columns of the tables."""


@frozen
class Threshold:
    """Errors strictly below which a pose is correct."""

    length: str
    """The length alone, the suffix of columns."""
    text: str
    """Both errors."""
    column: str
    """Column of results.csv that counts correct frames."""


_COARSE = Threshold("5 cm", "5 cm and 5 deg", "within_5cm_5deg")
_FINE = Threshold("1 cm", "1 cm and 1 deg", "within_1cm_1deg")


def thresholds(suite: str) -> tuple[Threshold, Threshold]:
    """Return the threshold of a suite as in the paper, and the other one."""
    if suite.startswith("sim"):
        return _FINE, _COARSE
    return _COARSE, _FINE


def complete_runs(results: Table) -> Table:
    """Return the rows of runs whose last stage is complete."""
    if results.empty:
        return results
    last = results["stage"].max()
    at_end = results["stage"].eq(last)
    evaluated = at_end.groupby([results["strategy"], results["seed"]]).transform("sum")
    return results[evaluated == last + 1]


def run_scores(results: Table, suite: str = "") -> Table:
    """Score every complete run: a row per strategy and seed, with the columns of `LEGEND`.

    Forgetting and memory of joint training are NaN.
    """
    runs = complete_runs(results).groupby(["strategy", "seed"], sort=False)
    scores = {key: _scores(run, suite) for key, run in runs}
    table = pd.DataFrame.from_dict(scores, orient="index")
    return table.rename_axis(["strategy", "seed"])


def last_stage(results: Table) -> Table:
    """Return the rows of the last stage."""
    return results[results["stage"] == results["stage"].max()]


def _scores(run: Table, suite: str) -> dict[str, float]:
    last = last_stage(run)
    inside = math.nan
    with_covariance = last["with_covariance"].sum()
    if with_covariance:
        inside = 100 * last["inside_95"].sum() / with_covariance
    threshold, other = thresholds(suite)
    judged = continual_scores(matrix(run, threshold))
    beside = continual_scores(matrix(run, other))
    memory_mb = last["memory_bytes"].iloc[0] / 1e6
    if math.isnan(judged.total_forgetting):  # joint training needs all frames again
        memory_mb = math.nan
    return {
        FINAL: judged.final_accuracy,
        NEWEST: judged.last_scene_accuracy,
        TFR: judged.total_forgetting,
        f"{FINAL}, {other.length}": beside.final_accuracy,
        f"{NEWEST}, {other.length}": beside.last_scene_accuracy,
        f"{TFR}, {other.length}": beside.total_forgetting,
        AREA: float(last["area_20cm"].mean()),
        "ACC": judged.accuracy_along,
        "forgetting": judged.forgetting,
        "BWT": judged.backward_transfer,
        "wrong scene %": 100 * float((last["wrong_scene"] / last["frames"]).mean()),
        "refused %": 100 * float((last["refused"] / last["frames"]).mean()),
        "in 95 % ellipsoid": inside,
        "memory MB": memory_mb,
        "heads MB": last["head_bytes"].iloc[0] / 1e6,
        "s": float(run.groupby("stage")["seconds"].last().sum()),
    }


def matrix(run: Table, threshold: Threshold) -> Table:
    """Return accuracies of a run, per cent: a row per stage, a column per scene as learned."""
    scenes = list(last_stage(run)["scene"])
    percent = 100 * run[threshold.column] / run["frames"]
    shares = run.assign(share=percent)
    accuracies = shares.pivot_table(index="stage", columns="scene", values="share")
    return accuracies.reindex(index=range(len(scenes)), columns=scenes)


def method_table(scores: Table) -> Table:
    """Average `run_scores` over runs, best strategy first, with the spread of the final accuracy.

    A mean is NaN if one of its values is.
    """
    grouped = scores.groupby(level="strategy", sort=False)
    means = grouped.mean().where(grouped.count().eq(grouped.size(), axis=0))
    table = formatted(means)
    for name in finals(scores):
        spread = grouped[name].std()
        several = table[name] + " ± " + formatted(spread)
        table[name] = table[name].where(spread.isna(), several)
    table.insert(0, "runs", grouped.size())
    best_first = means[FINAL].sort_values(ascending=False, kind="stable")
    return table.loc[best_first.index]


def finals(scores: Table) -> list[str]:
    """Return the columns of final accuracies, that of the suite's threshold first."""
    return [name for name in scores if name.startswith(FINAL)]


def contrast_table(scores: Table, pairs: Sequence[tuple[str, str]]) -> Table:
    """Tabulate differences of pairs of strategies on common seeds, in points; see `run_scores`.

    Final accuracies and area, each with the ends of `seeds_interval`, which hold for all pairs
    together, and the number of runs in which the first strategy is better.
    """
    names = {name for pair in pairs for name in pair}
    rows = []
    for score in (*finals(scores), AREA):
        by_seed = scores[score].unstack("seed").reindex(sorted(names))
        for ours, theirs in pairs:
            gains = (by_seed.loc[ours] - by_seed.loc[theirs]).dropna()
            low, high = seeds_interval(gains, len(pairs))
            row = {"score": score, "contrast": f"{ours} - {theirs}"}
            ends = {"points": gains.mean(), "low": low, "high": high}
            counts = {"runs": len(gains), "better in": (gains > 0).sum()}
            rows.append(row | ends | counts)
    table = pd.DataFrame(rows)
    if rows:
        signed = ["points", "low", "high"]
        table[signed] = formatted(table[signed], "{:+.1f}")
    return table


def gate(scores: Table, suite: str, least: float = GATES["code"]) -> str:
    """Say at which thresholds joint training, which has all frames, passes the gate."""
    joint = scores.groupby("strategy").mean().reindex(["joint"]).iloc[0]
    if math.isnan(joint[FINAL]):
        return "Joint training was not run; it shows whether the budget suffices."
    threshold, other = thresholds(suite)
    verdicts = []
    for where, column in ((threshold, FINAL), (other, f"{FINAL}, {other.length}")):
        verdict = "which suffices for a verdict"
        if joint[column] < least:
            verdict = f"below {least:.0f} %: more steps are needed for a verdict"
        verdicts.append(f"{joint[column]:.1f} % at {where.text}, {verdict}")
    return f"Joint training has {'; '.join(verdicts)}."


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


def formatted(table: Table, number: str = "{:.1f}") -> Table:
    """Format numbers, by default with one digit; NaN becomes `-`."""
    return table.map(number.format).where(table.notna(), "-")
