"""Draws final accuracy over forgetting, a point for each method, with intervals over seeds."""

from pathlib import Path

import numpy as np
from evercal.continual.benchmark.published import read_published
from evercal.continual.benchmark.statistics import seeds_interval
from tyro.conf import Positional

from benchmarks.publish import FOLDER
from benchmarks.tables import published_runs
from evercal.continual.benchmark.comparison import by_strategy
from evercal.reports.charts import COLOURS, new_figure, tidy

OUT = FOLDER.parent / "docs" / "networks.svg"
MARKERS = "osD^v<>PXph*"


def run(names: Positional[tuple[str, ...]], out: Path = OUT) -> None:
    """Draw a figure of the methods with two runs or more.

    Args:
        names: Files of `results/`, without their suffix.
        out: SVG to write.
    """
    runs = published_runs([read_published(FOLDER / f"{name}.jsonl") for name in names])
    points = []
    for name, group in by_strategy(runs).items():
        if len(group) > 1 and ":" not in name:
            scores = [run.scores() for run in group]
            accuracy = seeds_interval([score.final_accuracy for score in scores])
            # Joint training has no stages.
            forgetting = seeds_interval(np.nan_to_num([score.total_forgetting for score in scores]))
            points.append((accuracy, forgetting, name))
    figure = new_figure(7.2, 4.4)
    panel = figure.subplots()
    for number, (accuracy, forgetting, name) in enumerate(sorted(points, reverse=True)):
        panel.errorbar(
            forgetting.mean,
            accuracy.mean,
            xerr=forgetting.mean - forgetting.low,
            yerr=accuracy.mean - accuracy.low,
            fmt=MARKERS[number % len(MARKERS)],
            color=COLOURS[number % len(COLOURS)],
            # Colours repeat; the second time the markers are open.
            markerfacecolor="white" if number >= len(COLOURS) else None,
            elinewidth=0.7,
            label=f"{name}  {accuracy.mean:.0f}",
        )
    panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=8)
    panel.set_xlabel("total forgetting rate (points)")
    panel.set_ylabel("final accuracy, 5 cm and 5 deg (%)")
    panel.set_ylim(0, 103)
    panel.set_xlim(-3, 103)
    tidy(panel)
    figure.savefig(out)
    print(out)
