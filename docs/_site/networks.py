"""Draw docs/networks.svg: python docs/_site/networks.py NAME... with files of `results/`."""

import sys
from pathlib import Path

import numpy as np

from benchmarks.publish import FOLDER
from evercal.continual.benchmark.comparison import by_strategy, runs_of
from evercal.continual.benchmark.published import read_published
from evercal.continual.benchmark.statistics import seeds_interval
from evercal.reports.charts import COLOURS, new_figure, tidy

OUT = Path(__file__).parents[1] / "networks.svg"
OURS = ("evercal", "evercal_network")


def main(names: list[str]) -> None:
    """Draw final accuracy over forgetting, one point a method, with intervals over seeds."""
    published = [read_published(FOLDER / f"{name}.jsonl") for name in names]
    runs = runs_of([result for part in published for result in part.results()], {})
    figure = new_figure(7.2, 4.4)
    panel = figure.subplots()
    for name, group in by_strategy(runs).items():
        if len(group) < 2 or ":" in name:
            continue
        scores = [run.scores() for run in group]
        accuracy = seeds_interval([score.final_accuracy for score in scores])
        # Joint training has no stages.
        forgetting = seeds_interval(np.nan_to_num([score.forgetting for score in scores]))
        panel.errorbar(
            forgetting.mean,
            accuracy.mean,
            xerr=forgetting.mean - forgetting.low,
            yerr=accuracy.mean - accuracy.low,
            fmt="o",
            color=COLOURS[1] if name in OURS else COLOURS[0],
            elinewidth=0.7,
        )
        place = (forgetting.mean, accuracy.mean)
        panel.annotate(name, place, xytext=(6, 4), textcoords="offset points", fontsize=8)
    panel.set_xlabel("forgetting (points)")
    panel.set_ylabel("final accuracy, 5 cm and 5 deg (%)")
    panel.set_ylim(0, 103)
    tidy(panel)
    figure.savefig(OUT)


if __name__ == "__main__":
    main(sys.argv[1:])
