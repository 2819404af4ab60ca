"""The paper's tables and their strategies (Li et al., arXiv 2604.15814).

Tables 1 to 3 have scenes down and strategies across. Table 4 adds SARS, then SPDD.
"""

from collections.abc import Mapping
from math import isinf, nan

import pandas as pd

from evercal.continual.benchmark import comparison
from evercal.continual.benchmark.results import Table
from evercal.typing import Pair

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
PUBLISHED: Mapping[str, Mapping[str, Pair]] = {
    "i7s": {
        "joint": (81.7, nan),
        "finetune": (1.1, nan),
        "icarl": (65.2, 11.37),
        "buff_cs": (66.1, 13.03),
        "gec": (26.5, 62.67),
        "gdr": (59.6, 12.25),
        "sars_old_output": (72.0, nan),
        "sars_spdd": (74.9, 6.65),
    },
    "i12s": {
        "joint": (96.9, nan),
        "finetune": (6.2, nan),
        "icarl": (66.0, 33.3),
        "buff_cs": (83.1, 15.7),
        "gec": (13.5, 88.9),
        "gdr": (78.7, 21.9),
        "sars_old_output": (90.9, nan),
        "sars_spdd": (91.8, 8.1),
    },
}
"""Published final accuracy and TFR in per cent, by suite and strategy."""


def paper_table(results: Table, suite: str = "") -> Table:
    """Tabulate final median errors and accuracies by scene, then mean and TFR, means over runs.

    Accuracy is at 1 cm and 1 deg for simulated suites, as in the paper, and at 5 cm and 5 deg for
    others. Published numbers of the suite are added if there are any.
    """
    results = comparison.complete_runs(results)
    last = comparison.last_stage(results)
    within = comparison.COARSE_COLUMN
    if suite.startswith("sim"):
        within = comparison.FINE_COLUMN
    cells: Table = pd.DataFrame(
        {
            "t, cm": last["median_mm"] / 10,
            "r, deg": last["median_deg"],
            "Acc, %": 100 * last[within] / last["frames"],
        }
    )
    means = cells.groupby([last["scene"], last["strategy"]], sort=False).mean()
    table = means.unstack(sort=False).swaplevel(axis=1)
    names = list(last["strategy"].unique())
    table = table.reindex(columns=pd.MultiIndex.from_product([names, cells.columns]))
    by_strategy = comparison.run_scores(results)["TFR"].groupby("strategy")
    forgetting = by_strategy.agg(lambda values: values.mean(skipna=False))
    totals = {
        "Mean": dict(table.xs("Acc, %", axis=1, level=1).mean()),
        "TFR": dict(forgetting),
    }
    published = pd.DataFrame(PUBLISHED.get(suite, {}), ["Mean", "TFR"])
    for title, values in published.iterrows():
        if len(values):
            totals[f"{title}, published"] = dict(values)
    for title, values in totals.items():
        table.loc[title] = nan
        for name in names:
            table.loc[title, (name, "Acc, %")] = values.get(name, nan)
    table.index.name = None
    return table.rename_axis(columns=[None, None])


def ablation_table(scores: Table, suite: str = "") -> Table:
    """Tabulate Table 4: final accuracy, and the gain of each step with its 95 % interval.

    Steps that were not run are left out, and ablations with fewer than two. Published numbers of
    the suite are added if there are any.
    """
    final = scores[comparison.FINAL].groupby("strategy").mean()
    rows = []
    published = PUBLISHED.get(suite)
    for title, steps in ABLATIONS.items():
        if final.index.isin(dict(steps).values()).sum() < 2:
            continue
        before = ""
        for label, name in steps:
            step = comparison.contrast_table(scores, [(name, before)]).iloc[0]
            before = name
            if name not in final:
                continue
            row = {
                "ablation": title,
                "": label,
                comparison.FINAL: f"{final[name]:.1f}",
                "step": step[comparison.FINAL],
                "95 %": step["bounds"].iloc[0],
            }
            if published:
                row["published %"] = ""
                if title == "as printed":
                    row["published %"] = f"{published[name][0]:.1f}"
            rows.append(row)
    return pd.DataFrame(rows)


def latex(table: Table, index: bool = True) -> str:
    """Format a table in LaTeX (needs booktabs); NaN becomes `--`."""

    def text(value: float) -> str:
        if isinf(value):
            return r"$\infty$"
        return f"{value:.1f}"

    return table.to_latex(
        index=index,
        na_rep="--",
        float_format=text,
        escape=True,
        multicolumn_format="c",
    )
