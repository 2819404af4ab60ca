"""The figures of a benchmark with matplotlib; no pyplot and no global state is used.

The Okabe-Ito colours are distinguishable with colour blindness.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from evercal.continual.benchmark import comparison
from evercal.continual.benchmark.comparison import Threshold
from evercal.continual.benchmark.results import Table
from evercal.typing import JsonObject, Strings

COLOURS = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
    "#000000",
    "#999999",
)
"""Colours of lines."""
_MARKERS = "os^Dv<>P"
"""Markers of lines."""
_LINES = ("-", "--", "-.", ":")
"""Dashes of lines."""
_HATCHES = ("", "///", "...", "xxx")
"""Patterns of bars whose colours repeat."""
_SIDE_BY_SIDE = 4
"""Panels in a row."""
_MEAN = "mean of scenes learned"
"""Title of the last panel."""
LINES = "figure.svg"
"""File of accuracies over stages."""
BARS = "bars.svg"
"""File of final accuracies."""


def new_figure(width: float, height: float) -> Figure:
    """Create an empty white figure; width and height in inches."""
    return Figure(
        figsize=(width, height), dpi=150, layout="constrained", facecolor="white"
    )


def tidy(panel: Axes) -> None:
    """Apply the common style: light grid, small ticks, no frame at the top and right."""
    panel.grid(color="0.9", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.tick_params(labelsize=8)
    panel.xaxis.label.set_fontsize(9)
    panel.yaxis.label.set_fontsize(9)
    panel.spines[["top", "right"]].set_visible(False)


def draw_figures(
    results: Table, strategies: Strings, threshold: Threshold, folder: Path
) -> None:
    """Draw the accuracy of every scene over the stages, and after the last, means over runs.

    Lines are Figures 4 to 6 of the paper, bars are Figure 3. With several orders of the scenes, a
    panel of lines is a place in the order.
    """
    lines = {}
    bars = {}
    orders = set()
    for name in strategies:
        runs = []
        for _, rows in results[results["strategy"] == name].groupby("seed"):
            accuracies = comparison.matrix(rows, threshold)
            accuracies[_MEAN] = accuracies.mean(axis=1)
            orders.add(tuple(accuracies))
            runs.append(accuracies)
        lines[name] = np.mean([run.to_numpy(float) for run in runs], axis=0)
        bars[name] = pd.DataFrame([run.iloc[-1] for run in runs]).mean()
    scenes = min(orders)
    places = scenes
    if len(orders) > 1:
        places = [f"scene {i + 1}" for i in range(len(scenes) - 1)] + [_MEAN]
    over_stages = _Panels(places, threshold)
    final = _Panels(scenes, threshold)
    for index, name in enumerate(strategies):
        style: JsonObject = {"color": COLOURS[index % len(COLOURS)], "label": name}
        turned = index + index // len(COLOURS)
        drawn = {
            "marker": _MARKERS[turned % len(_MARKERS)],
            "linestyle": _LINES[turned % len(_LINES)],
            "markersize": 3.5,
        }
        stages = np.arange(1, len(scenes))
        for panel, values in zip(over_stages.panels, lines[name].T, strict=True):
            panel.plot(stages, values, **style, **drawn)
        hatch = _HATCHES[index // len(COLOURS) % len(_HATCHES)]
        for panel, scene in zip(final.panels, scenes, strict=True):
            height = bars[name][scene]
            panel.bar(index, height, **style, hatch=hatch, edgecolor="white")
    over_stages.save(folder / LINES, "scenes learned", range(1, len(scenes)))
    final.save(folder / BARS, "", ())


class _Panels:
    """Panels in rows, with a common axis of accuracy and a legend."""

    def __init__(self, titles: Sequence[str], threshold: Threshold):
        rows = -(-len(titles) // _SIDE_BY_SIDE)
        columns = min(len(titles), _SIDE_BY_SIDE)
        self.figure = new_figure(2.6 * columns, 0.6 + 2.2 * rows)
        panels = self.figure.subplots(rows, columns, sharey=True, squeeze=False)
        self.panels = panels.ravel()[: len(titles)]
        for spare in panels.ravel()[len(titles) :]:
            spare.remove()
        for panel, title in zip(self.panels, titles, strict=True):
            panel.set_title(title, fontsize=9)
            panel.set_ylim(-3, 103)
            tidy(panel)
        self.figure.supylabel(f"accuracy at {threshold.text} (%)", fontsize=9)

    def save(self, path: Path, across: str, ticks: Sequence[int]) -> None:
        """Add the legend and write the file; `across` is the common label of the other axis."""
        for panel in self.panels:
            panel.set_xticks(ticks)
        self.figure.supxlabel(across, fontsize=9)
        handles, labels = self.panels[0].get_legend_handles_labels()
        self.figure.legend(
            handles,
            labels,
            loc="outside upper center",
            ncols=5,
            frameon=False,
            fontsize=8,
        )
        self.figure.savefig(path)
