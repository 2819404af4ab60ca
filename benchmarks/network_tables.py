"""Tables and figure of the experiments on networks, from results/networks-*."""

from collections.abc import Callable
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes

from evercal.continual.benchmark import results
from evercal.continual.benchmark.comparison import (
    AREA,
    FINAL,
    NEWEST,
    TFR,
    complete_runs,
    contrast_table,
    method_table,
    run_scores,
    seeds_interval,
    thresholds,
)
from evercal.continual.benchmark.figures import COLOURS, new_figure, tidy
from evercal.continual.benchmark.results import Table
from evercal.storage.settings import read_settings

FOLDER = Path(__file__).resolve().parent.parent / "results"


_SHOWN = (FINAL, NEWEST, TFR, AREA, "memory MB")
"""Columns of `run_scores` that pages have, the first three at either threshold."""
FILLED = (
    "er",
    "sars_reprojection",
    "reservoir_spdd",
    "sars_spdd",
    "sars_spdd_filled",
)
"""Strategies whose memory is varied."""


def summary(name: str, single: bool = False) -> Callable[[], Table]:
    """Return the main columns of `method_table`, in the order of the runs.

    Args:
        name: Folder of `evercal bench`.
        single: Strategies with one run, instead of those with several.
    """

    def table() -> Table:
        rows = _bench(name)
        lines = _methods(name)
        names = lines.index
        # Seconds are means over the runs of one machine, the one with most runs.
        places = rows.groupby(["strategy", "seed"], sort=False)["environment"].first()
        common = rows[rows["environment"] == places.mode(dropna=False).iloc[0]]
        if not len(common):  # environments were not recorded
            common = rows
        seconds = method_table(run_scores(common))["s"]
        lines["s"] = seconds.reindex(names).fillna("-")
        return lines[(lines["runs"] == 1) == single].reset_index()

    return table


def _methods(name: str) -> Table:
    """The shown columns of `method_table`, a row per strategy in the order of the runs."""
    rows = _bench(name)
    scores = _scores(name)
    shown = [title for title in scores if title.split(",")[0] in _SHOWN]
    return method_table(scores).loc[rows["strategy"].unique(), ["runs", *shown]]


def _bench(name: str) -> Table:
    rows = complete_runs(results.read(FOLDER / name))
    return rows[~rows["strategy"].str.contains(":")]


def _scores(name: str) -> Table:
    """Scores of all runs, those of the suite's threshold first."""
    return run_scores(_bench(name), _suite(name))


def _suite(name: str) -> str:
    return str(read_settings(FOLDER / name / results.SETTINGS)["suite"])


def contrasts() -> Table:
    """The contrasts that were named before the runs."""
    others = (
        "icarl",
        "sars_old_output",
        "sars_reprojection",
        "reservoir_spdd",
        "buff_cs",
    )
    pairs = [("sars_spdd", other) for other in others]
    return contrast_table(_scores("networks-a"), pairs)


def environments() -> Table:
    """Where the runs were measured: a row per commit and machine."""
    rows = results.read(FOLDER / "networks-a").drop_duplicates(["strategy", "seed"])
    table = pd.DataFrame(
        results.read_records(FOLDER / "networks-a" / results.ENVIRONMENTS)
    ).T
    table["runs"] = rows.groupby("environment").size()
    return table[
        ["commit", "processor", "gpu", "precision", "torch", "threads", "runs"]
    ]


def memory() -> Table:
    """The same scenes with several shares of keyframes, means over runs."""
    tables = []
    for share in (1, 3, 30):
        lines = _methods(f"networks-memory-{share}").reset_index()
        lines.insert(0, "keyframes", f"{share} %")
        tables.append(lines[lines["strategy"].isin(FILLED)])
    return pd.concat(tables)


def draw(name: str, path: Path) -> None:
    """Draw final accuracy over forgetting, a point per strategy, with intervals over seeds.

    The threshold of the suite is on the left, the other one on the right.
    """
    scores = _scores(name).fillna(0.0)  # joint training has no stages
    several = scores.groupby("strategy").filter(lambda runs: len(runs) > 1)
    limits = thresholds(_suite(name))
    suffixes = ("", f", {limits[1].length}")
    figure = new_figure(9.6, 4.4)
    panels = figure.subplots(1, 2, sharey=True)
    for panel, limit, suffix in zip(panels, limits, suffixes, strict=True):
        _scatter(panel, several, suffix)
        panel.set_title(limit.text, fontsize=9)
        panel.set_xlabel("total forgetting rate (points)")
        panel.set_ylim(0, 103)
        panel.set_xlim(-3, 103)
        tidy(panel)
    panels[0].set_ylabel("final accuracy (%)")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside right center", frameon=False, fontsize=8
    )
    figure.savefig(path)


def _scatter(panel: Axes, scores: Table, suffix: str) -> None:
    """Draw the points at one threshold, the columns of which end in `suffix`."""
    for number, strategy in enumerate(scores.index.unique("strategy")):
        runs = scores.loc[strategy]
        final = runs[f"{FINAL}{suffix}"]
        forgetting = runs[f"{TFR}{suffix}"]
        panel.errorbar(
            forgetting.mean(),
            final.mean(),
            xerr=forgetting.mean() - seeds_interval(forgetting)[0],
            yerr=final.mean() - seeds_interval(final)[0],
            fmt="osD^v<>PXph*"[number % 12],
            color=COLOURS[number % len(COLOURS)],
            # Colours repeat; the second time the markers are open.
            markerfacecolor="white" if number >= len(COLOURS) else None,
            elinewidth=0.7,
            label=strategy,
        )
