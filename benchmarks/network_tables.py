"""Tables and figure of the experiments on networks, from results/networks-*."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from evercal.continual.benchmark import results
from evercal.continual.benchmark.comparison import (
    AREA,
    FINAL,
    complete_runs,
    contrast_table,
    method_table,
    run_scores,
    seeds_interval,
)
from evercal.continual.benchmark.figures import COLOURS, new_figure, tidy
from evercal.continual.benchmark.results import Table

FOLDER = Path(__file__).resolve().parent.parent / "results"


def summary(name: str, single: bool = False) -> Callable[[], Table]:
    """Return the main columns of `method_table`, in the order of the runs.

    Args:
        name: Folder of `evercal bench`.
        single: Strategies with one run, instead of those with several.
    """
    columns = ["1 cm 1 deg %", AREA, "last scene %", "TFR", "memory MB", "s"]

    def table() -> Table:
        rows = _bench(name)
        names = rows["strategy"].unique()
        lines = method_table(run_scores(rows)).loc[names]
        # Seconds are means over the runs of one machine, the one with most runs.
        places = rows.groupby(["strategy", "seed"], sort=False)["environment"].first()
        common = rows[rows["environment"] == places.mode(dropna=False).iloc[0]]
        if len(common):
            lines["s"] = (
                method_table(run_scores(common))["s"].reindex(names).fillna("-")
            )
        lines = lines[(lines["runs"] == 1) == single]
        return lines[["runs", FINAL, *columns]].reset_index()

    return table


def _bench(name: str) -> Table:
    rows = complete_runs(results.read(FOLDER / name))
    return rows[~rows["strategy"].str.contains(":")]


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
    return contrast_table(run_scores(_bench("networks-a")), pairs).reset_index()


def environments() -> Table:
    """Where the runs were measured: a row per commit and machine."""
    rows = results.read(FOLDER / "networks-a").drop_duplicates(["strategy", "seed"])
    table = pd.DataFrame(results.read_environments(FOLDER / "networks-a")).T
    table["runs"] = rows.groupby("environment").size()
    return table[
        ["commit", "processor", "gpu", "precision", "torch", "threads", "runs"]
    ]


def memory() -> Table:
    """The same scenes with several shares of keyframes, means over runs."""
    wanted = (
        "er",
        "sars_reprojection",
        "reservoir_spdd",
        "sars_spdd",
        "sars_spdd_filled",
    )
    bounds = {
        "5 cm/5 deg": "within_5cm_5deg",
        "1 cm/1 deg": "within_1cm_1deg",
        "5 mm/0.5 deg": "within_5mm_05deg",
    }
    table = []
    for share in (1, 3, 30):
        folder = FOLDER / f"networks-memory-{share}"
        rows = _bench(folder.name)
        frames = results.read_frames(folder)
        last = rows[rows["stage"] == rows["stage"].max()]
        for name in rows["strategy"].unique():
            if name not in wanted:
                continue
            ends = last[last["strategy"] == name]
            cells = {"keyframes": f"{share} %", "strategy": name}
            for title, within in bounds.items():
                cells[title] = f"{(100 * ends[within] / ends['frames']).mean():.1f}"
            median = frames.loc[frames["strategy"] == name, "error_mm"].median()
            wrong = ends["wrong_scene"].sum() / ends["seed"].nunique()
            cells["median mm"] = f"{median:.1f}" if np.isfinite(median) else "-"
            size = (ends["memory_bytes"] + ends["head_bytes"]).iloc[0] / 1e6
            table.append(cells | {"wrong scene": f"{wrong:.0f}", "MB": f"{size:.1f}"})
    return pd.DataFrame(table)


def draw(name: str, path: Path) -> None:
    """Draw final accuracy over forgetting, a point per strategy, with intervals over seeds."""
    scores = run_scores(_bench(name)).fillna(0.0)  # joint training has no stages
    grouped = (
        scores.groupby("strategy")
        .filter(lambda runs: len(runs) > 1)
        .groupby("strategy")
    )
    order = grouped[FINAL].mean().sort_values(ascending=False).index
    figure = new_figure(7.2, 4.4)
    panel = figure.subplots()
    for number, strategy in enumerate(order):
        final, forgetting = (grouped.get_group(strategy)[key] for key in (FINAL, "TFR"))
        x = forgetting.mean()
        y = final.mean()
        panel.errorbar(
            x,
            y,
            xerr=x - seeds_interval(forgetting)[0],
            yerr=y - seeds_interval(final)[0],
            fmt="osD^v<>PXph*"[number % 12],
            color=COLOURS[number % len(COLOURS)],
            # Colours repeat; the second time the markers are open.
            markerfacecolor="white" if number >= len(COLOURS) else None,
            elinewidth=0.7,
            label=f"{strategy}  {y:.0f}",
        )
    panel.legend(
        loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=8
    )
    panel.set_xlabel("total forgetting rate (points)")
    panel.set_ylabel("final accuracy, 5 cm and 5 deg (%)")
    panel.set_ylim(0, 103)
    panel.set_xlim(-3, 103)
    tidy(panel)
    figure.savefig(path)
