"""The paper's tables and their strategies (Li et al., arXiv 2604.15814).

Tables 1 to 3 have scenes down and strategies across. Table 4 adds SARS, then SPDD.
"""

from collections.abc import Mapping
from math import nan
from pathlib import Path

import pandas as pd

from evercal.continual.benchmark import comparison
from evercal.continual.benchmark.results import Table

ABLATIONS: Mapping[str, tuple[tuple[str, str], ...]] = {
    "as printed": (
        ("iCaRL", "icarl"),
        ("+ SARS", "sars_old_output"),
        ("+ SARS + SPDD", "sars_spdd"),
    ),
    "one change at a time": (
        ("random, reprojection", "er"),
        ("SARS, reprojection", "sars_reprojection"),
        ("SARS, SPDD", "sars_spdd"),
    ),
    "the penalty first": (
        ("random, reprojection", "er"),
        ("random, SPDD", "reservoir_spdd"),
        ("SARS, SPDD", "sars_spdd"),
    ),
}
"""Rows of Table 4 and their strategies.

As printed, the first step changes the selector and keeps iCaRL's penalty, which uses true poses.
The second step replaces it by a penalty without true poses.
"""
TABLE4 = (
    "icarl",
    "sars_old_output",
    "sars_spdd",
    "er",
    "sars_reprojection",
    "reservoir_spdd",
)
"""Strategies of `ABLATIONS`."""
_PUBLISHED = Path(__file__).with_name("published.csv")
"""The rows of Tables 1 to 4 of the paper, as printed."""
ACCURACY = "Acc, %"
"""Column of accuracy, and of TFR in its row."""


def published(suite: str) -> Table:
    """Read the paper's rows of a suite; those of its Sim data set for suites `sim*`."""
    rows = pd.read_csv(_PUBLISHED)
    name = suite
    if suite.startswith("sim"):
        name = "sim"
    return rows[rows["suite"] == name].drop(columns="suite")


def paper_table(results: Table, scores: Table, suite: str = "") -> Table:
    """Tabulate median errors and accuracies of complete runs by scene, then mean and TFR.

    Values are means over runs, after the last stage. Accuracy and TFR are at the threshold of the
    suite; `scores` are those of the runs. The published rows follow if there are any.
    """
    last = comparison.last_stage(results)
    threshold, _ = comparison.thresholds(suite)
    cells: Table = pd.DataFrame(
        {
            "t, cm": last["median_mm"] / 10,
            "r, deg": last["median_deg"],
            ACCURACY: 100 * last[threshold.column] / last["frames"],
        }
    )
    means = cells.groupby([last["scene"], last["strategy"]], sort=False).mean()
    table = _side_by_side(means)
    names = list(last["strategy"].unique())
    table = table.reindex(columns=pd.MultiIndex.from_product([names, cells.columns]))
    rates = scores[comparison.TFR].groupby("strategy")
    forgetting = rates.agg(lambda values: values.mean(skipna=False))
    totals = {"Mean": table.xs(ACCURACY, axis=1, level=1).mean(), "TFR": forgetting}
    for title, values in totals.items():
        table.loc[title] = nan
        for name in names:
            table.loc[title, (name, ACCURACY)] = values[name]
    theirs = _side_by_side(published(suite).set_index(["scene", "strategy"]))
    theirs.index += ", published"
    table = pd.concat([table, theirs.reindex(columns=table.columns)])
    table.index.name = None
    return table.rename_axis(columns=[None, None])


def _side_by_side(rows: Table) -> Table:
    """Put rows of a scene and a strategy side by side: strategies, then their columns, across."""
    return rows.unstack(sort=False).swaplevel(axis=1)


def ablation_table(scores: Table, suite: str = "") -> Table:
    """Tabulate Table 4: final accuracy, and the gain of each step with its 95 % interval.

    Steps that were not run are left out, and ablations with fewer than two. The accuracy at the
    other threshold is beside it, and the published one if there is any.
    """
    means = scores[comparison.finals(scores)].groupby("strategy").mean()
    theirs = published(suite).query("scene == 'Mean'").set_index("strategy")[ACCURACY]
    rows = []
    for title, steps in ABLATIONS.items():
        if means.index.isin(dict(steps).values()).sum() < 2:
            continue
        before = ""
        for label, name in steps:
            step = comparison.contrast_table(scores, [(name, before)]).iloc[0]
            before = name
            if name not in means.index:
                continue
            row = {
                "ablation": title,
                "": label,
                **means.loc[name].map("{:.1f}".format),
                "step": step["points"],
                "95 %": f"{step['low']} to {step['high']}".replace("- to -", "-"),
            }
            if "sars_old_output" in theirs:  # the paper has this table for the suite
                row["published %"] = ""
                if title == "as printed":
                    row["published %"] = f"{theirs[name]:.1f}"
            rows.append(row)
    return pd.DataFrame(rows)


def latex(table: Table, index: bool = True) -> str:
    """Format a table in LaTeX (needs booktabs); NaN becomes `--`."""
    return table.to_latex(
        index=index,
        na_rep="--",
        float_format="{:.1f}".format,
        escape=True,
        multicolumn_format="c",
    )
