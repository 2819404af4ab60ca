"""The figures of a benchmark with matplotlib; no pyplot and no global state is used.

The Okabe-Ito colours are distinguishable with colour blindness.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from evercal.continual.benchmark import comparison
from evercal.continual.benchmark.comparison import Threshold
from evercal.continual.benchmark.results import Table
from evercal.continual.learning.checkpoint import CURVE
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
_DASHES = ("-", "--", "-.", ":")
"""Dashes of lines whose colours repeat."""
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
CURVES = "training.svg"
"""File of loss and inliers of every training."""


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
    stages = range(1, len(scenes))
    over_stages, panels = _panels(places, threshold)
    over_stages.supxlabel("scenes learned", fontsize=9)
    final, bar_panels = _panels(scenes, threshold)
    for index, name in enumerate(strategies):
        style: JsonObject = {"color": COLOURS[index % len(COLOURS)], "label": name}
        again = index // len(COLOURS)
        dashes = _DASHES[again % len(_DASHES)]
        marker = _MARKERS[index % len(_MARKERS)]
        for panel, values in zip(panels, lines[name].T, strict=True):
            panel.plot(stages, values, dashes, marker=marker, markersize=3.5, **style)
            panel.set_xticks(stages)
        hatch = _HATCHES[again % len(_HATCHES)]
        for panel, scene in zip(bar_panels, scenes, strict=True):
            height = bars[name][scene]
            panel.bar(index, height, hatch=hatch, edgecolor="white", **style)
            panel.set_xticks([])
    _save(over_stages, panels[0], folder / LINES)
    _save(final, bar_panels[0], folder / BARS)


def draw_curves(folder: Path) -> bool:
    """Draw loss and inliers over the steps of every training; False if none has a curve."""
    curves = sorted(folder.glob(f"training/*/{CURVE}"))
    figure = new_figure(9.0, 3.4)
    panels = [figure.add_subplot(1, 2, number) for number in (1, 2)]
    numbers: dict[str, int] = {}
    for path in curves:
        curve = pd.read_csv(path)
        # Folders are STRATEGY-SEED-SCENE, and names may have hyphens.
        strategy = re.split(r"-\d+(?:-|$)", path.parent.name)[0]
        label = f"_{strategy}" if strategy in numbers else strategy
        again, colour = divmod(numbers.setdefault(strategy, len(numbers)), len(COLOURS))
        style: JsonObject = {"color": COLOURS[colour], "label": label}
        dashes = _DASHES[again % len(_DASHES)]
        for panel, column in zip(panels, ("loss", "inlier_share"), strict=True):
            panel.plot(curve["step"], curve[column], dashes, linewidth=0.8, **style)
    for panel, title in zip(panels, ("loss (px)", "inliers (share)"), strict=True):
        panel.set_title(title, fontsize=9)
        panel.set_xlabel("step")
        tidy(panel)
    panels[0].set_yscale("log")
    if curves:
        _save(figure, panels[0], folder / CURVES)
    return bool(curves)


def _panels(titles: Sequence[str], threshold: Threshold) -> tuple[Figure, list[Axes]]:
    """Panels in rows, with a common axis of accuracy."""
    rows = -(-len(titles) // _SIDE_BY_SIDE)
    columns = min(len(titles), _SIDE_BY_SIDE)
    figure = new_figure(2.6 * columns, 0.6 + 2.2 * rows)
    figure.supylabel(f"accuracy at {threshold.text} (%)", fontsize=9)
    panels = []
    for number, title in enumerate(titles, start=1):
        panel = figure.add_subplot(rows, columns, number, ylim=(-3, 103))
        panel.set_title(title, fontsize=9)
        tidy(panel)
        panels.append(panel)
    return figure, panels


def _save(figure: Figure, panel: Axes, path: Path) -> None:
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="outside upper center",
        ncols=5,
        frameon=False,
        fontsize=8,
    )
    figure.savefig(path)
