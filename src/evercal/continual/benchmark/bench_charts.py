"""Charts of a benchmark as PNG bytes: forgetting, accuracy by scene and by memory, keyframes."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from evercal.reports.charts import COLOURS, line_style, new_figure, png_bytes, tidy

_ACCURACY = "accuracy (%)"


def forgetting_curves(methods: Mapping[str, ArrayLike], scenes: Sequence[str]) -> bytes:
    """Plot the accuracy on each scene while later ones are learned, one panel a scene.

    Args:
        methods: By name (N, N) accuracies in per cent: row i after stage i, column j the scene
            learned in stage j. Entries above the diagonal are ignored.
        scenes: N names in order of learning.
    """
    matrices = {name: np.asarray(rows, dtype=np.float64) for name, rows in methods.items()}
    count = len(scenes)
    columns = min(4, count + 1)
    rows = -(-(count + 1) // columns)
    figure = new_figure(2.6 * columns + 0.4, 2.1 * rows + 0.7)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    stages = np.arange(1, count + 1)
    panels = grid.ravel()
    for index, (name, matrix) in enumerate(matrices.items()):
        style = line_style(index, name)
        for j in range(count):
            panels[j].plot(stages[j:], matrix[j:, j], **style)
        panels[count].plot(stages, [matrix[i, : i + 1].mean() for i in range(count)], **style)
    for panel, title in zip(panels, [*scenes, "mean of scenes learned"], strict=False):
        panel.set_title(title, fontsize=9)
        panel.set_ylim(-3, 103)
        tidy(panel)
    for panel in panels[count + 1 :]:
        panel.set_visible(False)
    panels[0].set_xlim(0.7, count + 0.3)
    panels[0].set_xticks(stages if count <= 8 else stages[::2])
    for column in range(columns):  # the lowest visible panel of each column carries the ticks
        lowest = grid[max(r for r in range(rows) if r * columns + column <= count), column]
        lowest.tick_params(labelbottom=True)
    figure.supxlabel("scenes learned", fontsize=9)
    figure.supylabel(_ACCURACY, fontsize=9)
    handles, labels = panels[count].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=5, frameon=False, fontsize=9)
    return png_bytes(figure)


def scene_bars(methods: Mapping[str, ArrayLike], scenes: Sequence[str]) -> bytes:
    """Plot a group of bars for each scene, one bar a method.

    Args:
        methods: By name (N,) accuracies in per cent.
        scenes: N names.
    """
    figure = new_figure(max(5.4, 1.6 + 0.22 * len(scenes) * (len(methods) + 1)), 3.2)
    panel = figure.subplots()
    width = 1.0 / (len(methods) + 1)
    for index, (name, values) in enumerate(methods.items()):
        heights = np.asarray(values, dtype=np.float64)
        left = np.arange(len(scenes)) + index * width
        colour = COLOURS[index % len(COLOURS)]
        hatch = ("", "//", "..", "xx")[index // len(COLOURS) % 4]
        panel.bar(left, heights, 0.9 * width, align="edge", color=colour, hatch=hatch, label=name)
    middle = np.arange(len(scenes)) + 0.5 * len(methods) * width
    panel.set_xticks(middle, scenes, rotation=30 if len(scenes) > 4 else 0)
    panel.set_ylabel(_ACCURACY, fontsize=9)
    panel.set_ylim(-3, 103)
    tidy(panel)
    figure.legend(loc="outside upper center", ncols=5, frameon=False, fontsize=9)
    return png_bytes(figure)


def accuracy_against_memory(methods: Mapping[str, tuple[float, float]]) -> bytes:
    """Plot one point a method: accuracy over memory.

    Args:
        methods: By name (megabytes, accuracy in per cent). Methods with NaN megabytes are omitted.
    """
    figure = new_figure(5.4, 3.4)
    panel = figure.subplots()
    drawn = [
        (index, name, megabytes, accuracy)
        for index, (name, (megabytes, accuracy)) in enumerate(methods.items())
        if not math.isnan(megabytes)
    ]
    lowest = -math.inf
    for index, name, megabytes, accuracy in sorted(drawn, key=lambda point: point[3]):
        style = {**line_style(index, name), "markersize": 6, "linestyle": ""}
        panel.plot(megabytes, accuracy, **style)
        lowest = max(lowest + 5, accuracy)  # labels of close points are stacked
        panel.annotate(
            name,
            (megabytes, accuracy),
            xytext=(9, (lowest - accuracy) * 2.1 - 3),
            textcoords="offset points",
            fontsize=8,
            arrowprops={"arrowstyle": "-", "color": "0.7", "linewidth": 0.6},
        )
    panel.set_xlim(left=0)
    panel.margins(x=0.2)
    panel.set_ylim(-3, 103)
    panel.set_xlabel("memory (MB)", fontsize=9)
    panel.set_ylabel(_ACCURACY, fontsize=9)
    tidy(panel)
    return png_bytes(figure)


def keyframe_positions(methods: Mapping[str, ArrayLike]) -> bytes:
    """Plot the camera positions of the keyframes, one panel a method.

    Args:
        methods: By name (n, 3) metres, n >= 1.
    """
    positions = {name: np.asarray(values, dtype=np.float64) for name, values in methods.items()}
    every = np.concatenate(list(positions.values()))
    middle, reach = (every.max(0) + every.min(0)) / 2, max(float(np.ptp(every, axis=0).max()), 0.1)
    columns = min(4, len(positions))
    rows = -(-len(positions) // columns)
    figure = new_figure(2.6 * columns, 2.3 * rows)
    for index, (name, points) in enumerate(positions.items()):
        panel = figure.add_subplot(rows, columns, index + 1, projection="3d")
        panel.scatter(*points.T, s=12, color=COLOURS[0])  # pyright: ignore[reportArgumentType]
        for axis, centre in zip("xyz", middle, strict=True):
            getattr(panel, f"set_{axis}lim")(centre - reach / 2, centre + reach / 2)
            getattr(panel, f"set_{axis}label")(f"{axis} (m)", fontsize=7, labelpad=-8)
        panel.tick_params(labelsize=6, pad=-3)
        panel.set_title(f"{name} ({len(points)})", fontsize=9)
    return png_bytes(figure)
