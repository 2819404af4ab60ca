"""Charts as PNG bytes: forgetting, accuracy by scene and by size, error curves, trajectories.

Colours are those of Okabe and Ito, which the colour-blind can tell apart; line styles and markers
differ as well. Nothing global is touched: no pyplot, no style, no backend setting.
"""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evercal.reports.canvas import COLOURS, new_figure, png_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MARKERS = "os^Dv<>P"
_LINES = ("-", "--", "-.", ":")


def forgetting_curves(
    methods: Mapping[str, ArrayLike], scenes: Sequence[str], quantity: str = "accuracy (%)"
) -> bytes:
    """What became of each scene as later ones were learned: one panel per scene and their mean.

    Args:
        methods: Per method (N, N): row i after stage i, column j the scene learned in stage j.
            What stands above the diagonal is not drawn, nor what is NaN.
        scenes: The N names in order of learning.
        quantity: What the numbers are.

    Raises:
        ValueError: A matrix that is not (N, N), or no scene.
    """
    matrices = {name: np.asarray(rows, dtype=np.float64) for name, rows in methods.items()}
    count = len(scenes)
    for name, matrix in matrices.items():
        if matrix.shape != (count, count) or not count:
            raise ValueError(f"{name}: {count} scenes need ({count}, {count}), got {matrix.shape}")
    columns = min(4, count + 1)
    rows = -(-(count + 1) // columns)
    figure = new_figure(2.6 * columns + 0.4, 2.1 * rows + 0.7)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    stages = np.arange(1, count + 1)
    panels = grid.ravel()
    for index, (name, matrix) in enumerate(matrices.items()):
        for j in range(count):
            panels[j].plot(stages[j:], matrix[j:, j], **_style(index, name))
        seen = [matrix[i, : i + 1].mean() for i in range(count)]
        panels[count].plot(stages, seen, **_style(index, name))
    for panel, title in zip(panels, [*scenes, "mean of scenes seen"], strict=False):
        panel.set_title(title, fontsize=9)
        _finish(panel)
    for panel in panels[count + 1 :]:
        panel.set_visible(False)
    panels[0].set_xlim(0.7, count + 0.3)
    panels[0].set_xticks(stages if count <= 8 else stages[::2])
    for column in range(columns):  # the lowest panel of each column carries the ticks
        lowest = grid[max(r for r in range(rows) if r * columns + column <= count), column]
        lowest.tick_params(labelbottom=True)
    figure.supxlabel("scenes learned", fontsize=9)
    figure.supylabel(quantity, fontsize=9)
    handles, labels = panels[count].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=5, frameon=False, fontsize=9)
    return png_bytes(figure)


def error_curve(
    methods: Mapping[str, ArrayLike], limit_cm: float = 20.0, threshold_cm: float | None = 5.0
) -> bytes:
    """Share of frames whose translation error is at most so much.

    Args:
        methods: Per method (frames,) errors in metres; infinite without a pose, so that a curve
            ends below 100 % by as many.
        limit_cm: Right end of the axis.
        threshold_cm: Marked by a vertical line; None for none.

    Raises:
        ValueError: A method without errors, or with one that is not a number.
    """
    figure = new_figure(5.4, 3.4)
    axes = figure.subplots()
    for index, (name, values) in enumerate(methods.items()):
        errors = np.sort(100.0 * np.asarray(values, dtype=np.float64).ravel())
        if not len(errors) or np.isnan(errors).any():
            raise ValueError(f"{name}: errors are at least one number (inf allowed), got {errors}")
        shown = errors[errors <= limit_cm]
        x = np.concatenate([[0.0], shown, [limit_cm]])
        share = 100.0 * np.arange(len(shown) + 1) / len(errors)
        style: dict[str, Any] = {**_style(index, name), "marker": ""}
        axes.step(x, np.append(share, share[-1]), where="post", **style)
    if threshold_cm is not None:
        axes.axvline(threshold_cm, color="0.5", linewidth=1, linestyle=(0, (2, 2)), zorder=0)
    axes.set_xlim(0, limit_cm)
    axes.set_xlabel("translation error (cm)", fontsize=9)
    axes.set_ylabel("share of frames (%)", fontsize=9)
    _finish(axes)
    axes.legend(loc="lower right", fontsize=9, frameon=False)
    return png_bytes(figure)


def error_histogram(
    groups: Mapping[str, ArrayLike], limit_mm: float = 5.0, bins: int = 20
) -> bytes:
    """How many frames have which translation error, one panel per group.

    Args:
        groups: Per group (frames,) errors in metres; infinite without a pose.
        limit_mm: Right end of the axis; what lies beyond, or has no pose, is one bar of its own.
        bins: Bars up to there.

    Raises:
        ValueError: No group, or one with an error that is not a number.
    """
    if not groups:
        raise ValueError("a histogram takes at least one group of errors")
    figure = new_figure(2.6 * len(groups) + 0.6, 2.6)
    panels = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
    width = limit_mm / bins
    for index, (panel, (name, values)) in enumerate(zip(panels, groups.items(), strict=True)):
        errors = 1000.0 * np.asarray(values, dtype=np.float64).ravel()
        if np.isnan(errors).any():
            raise ValueError(f"{name}: errors are numbers (inf allowed), got nan")
        counts, edges = np.histogram(errors[errors < limit_mm], bins, (0, limit_mm))
        colour = COLOURS[index % len(COLOURS)]
        panel.bar(edges[:-1], counts, 0.9 * width, align="edge", color=colour)
        beyond = int((errors >= limit_mm).sum())
        if beyond:
            panel.bar(limit_mm + width, beyond, 0.9 * width, align="edge", color="0.6")
            words = f"{beyond} beyond\nor no pose"
            panel.annotate(words, (limit_mm + 2 * width, beyond), fontsize=7, ha="right")
        panel.set_title(f"{name} ({len(errors)})", fontsize=9)
        panel.set_xlim(0, limit_mm + 2.2 * width)
        panel.grid(color="0.9", linewidth=0.6)
        panel.set_axisbelow(True)
        panel.tick_params(labelsize=8)
        panel.spines[["top", "right"]].set_visible(False)
    figure.supxlabel("translation error (mm)", fontsize=9)
    panels[0].set_ylabel("frames", fontsize=9)
    return png_bytes(figure)


def scene_bars(
    methods: Mapping[str, ArrayLike], scenes: Sequence[str], quantity: str = "accuracy (%)"
) -> bytes:
    """A group of bars for each scene, one bar per method.

    Args:
        methods: Per method (N,) numbers, 0 to 100.
        scenes: The N names.
        quantity: What the numbers are.

    Raises:
        ValueError: Not as many numbers as scenes, or no scene.
    """
    figure = new_figure(1.6 + 0.22 * len(scenes) * (len(methods) + 1), 3.2)
    axes = figure.subplots()
    width = 1.0 / (len(methods) + 1)
    for index, (name, values) in enumerate(methods.items()):
        heights = np.asarray(values, dtype=np.float64)
        if heights.shape != (len(scenes),) or not len(scenes):
            raise ValueError(f"{name}: {len(scenes)} scenes need as many numbers, got {heights}")
        left = np.arange(len(scenes)) + index * width
        colour = COLOURS[index % len(COLOURS)]
        hatch = ("", "//", "..", "xx")[index // len(COLOURS) % 4]
        axes.bar(left, heights, 0.9 * width, align="edge", color=colour, hatch=hatch, label=name)
    middle = np.arange(len(scenes)) + 0.5 * len(methods) * width
    axes.set_xticks(middle, scenes, rotation=30 if len(scenes) > 4 else 0)
    axes.set_ylabel(quantity, fontsize=9)
    _finish(axes)
    figure.legend(loc="outside upper center", ncols=5, frameon=False, fontsize=9)
    return png_bytes(figure)


def accuracy_against_size(methods: Mapping[str, tuple[float, float]], quantity: str) -> bytes:
    """One point per method: what it reaches, and how many megabytes it keeps for that.

    Args:
        methods: Per method (megabytes, accuracy in per cent); without a point where the first is
            NaN.
        quantity: What takes the megabytes.
    """
    figure = new_figure(5.4, 3.4)
    axes = figure.subplots()
    lowest = -math.inf
    drawn = [i for i, (size, _) in enumerate(methods.values()) if not math.isnan(size)]
    names, values = list(methods), list(methods.values())
    for index in sorted(drawn, key=lambda i: values[i][1]):
        name, (size, accuracy) = names[index], values[index]
        axes.plot(size, accuracy, **{**_style(index, name), "markersize": 6, "linestyle": ""})
        lowest = max(lowest + 5, accuracy)  # one name above the other where points lie together
        axes.annotate(
            name,
            (size, accuracy),
            xytext=(9, (lowest - accuracy) * 2.1 - 3),
            textcoords="offset points",
            fontsize=8,
            arrowprops={"arrowstyle": "-", "color": "0.7", "linewidth": 0.6},
        )
    axes.set_xlim(left=0)
    axes.margins(x=0.2)
    axes.set_xlabel(f"{quantity} (MB)", fontsize=9)
    axes.set_ylabel("accuracy (%)", fontsize=9)
    _finish(axes)
    return png_bytes(figure)


def trajectory(
    truth_m: ArrayLike, estimated_m: ArrayLike, ok: ArrayLike, axes: tuple[int, int] = (0, 1)
) -> bytes:
    """Where the camera was and where it was found, seen along the third axis.

    The view holds the true positions and a margin; how many estimates lie outside is written down.

    Args:
        truth_m: (n, 3) metres, n >= 1, in recorded order.
        estimated_m: (n, 3) metres; anything where there is no pose.
        ok: (n,) whether there is one.
        axes: Which two axes are drawn to the right and up; (0, 1) is the top view where z is up.

    Raises:
        ValueError: Shapes that do not belong together.
    """
    truth, estimated = np.asarray(truth_m, dtype=np.float64), np.asarray(estimated_m, np.float64)
    found = np.asarray(ok, dtype=np.bool_)
    if truth.shape != (len(found), 3) or estimated.shape != truth.shape or not len(found):
        raise ValueError(
            f"truth and estimates are (n, 3) with n >= 1 and ok (n,), got {truth.shape},"
            f" {estimated.shape} and {found.shape}"
        )
    true, guess = truth[:, list(axes)], estimated[:, list(axes)]
    low, high = true.min(axis=0), true.max(axis=0)
    margin = max(0.15 * float((high - low).max()), 0.05)
    inside = found.copy()
    inside[found] = ((guess[found] >= low - margin) & (guess[found] <= high + margin)).all(axis=1)
    figure = new_figure(5.4, 4.6)
    panel = figure.subplots()
    panel.plot(*_without_leaps(true).T, color="0.6", linewidth=1, label=f"true ({len(true)})")
    links = np.stack([true, guess], axis=1)[found]
    panel.plot(*_with_gaps(links).T, color=COLOURS[1], linewidth=0.8, alpha=0.6)
    panel.plot(*guess[inside].T, ".", color=COLOURS[0], label=f"found ({int(found.sum())})")
    if not found.all():
        label = f"not found ({int((~found).sum())})"
        panel.plot(*true[~found].T, "x", color=COLOURS[6], markersize=5, label=label)
    if (outside := int((found & ~inside).sum())) > 0:
        panel.plot([], [], color=COLOURS[1], label=f"found outside this view ({outside})")
    panel.set_xlim(low[0] - margin, high[0] + margin)
    panel.set_ylim(low[1] - margin, high[1] + margin)
    panel.set_aspect("equal")
    panel.set_xlabel(f"{'xyz'[axes[0]]} (m)", fontsize=9)
    panel.set_ylabel(f"{'xyz'[axes[1]]} (m)", fontsize=9)
    panel.grid(color="0.9", linewidth=0.6)
    panel.tick_params(labelsize=8)
    figure.legend(loc="outside upper center", ncols=2, frameon=False, fontsize=9)
    return png_bytes(figure)


def kept_places(methods: Mapping[str, ArrayLike]) -> bytes:
    """Where the cameras of remembered frames stood, one panel per method, seen obliquely.

    Args:
        methods: Per method (n, 3) metres, n >= 1.

    Raises:
        ValueError: No method, or positions that are not (n, 3).
    """
    places = {name: np.asarray(where, dtype=np.float64) for name, where in methods.items()}
    wrong = [where.shape for where in places.values() if where.ndim != 2 or where.shape[1] != 3]
    if wrong or not places:
        raise ValueError(f"positions are (n, 3) for one method or more, got {wrong or 'none'}")
    every = np.concatenate(list(places.values()))
    middle, reach = (every.max(0) + every.min(0)) / 2, max(float(np.ptp(every, axis=0).max()), 0.1)
    columns = min(4, len(places))
    rows = -(-len(places) // columns)
    figure = new_figure(2.6 * columns, 2.3 * rows)
    for index, (name, where) in enumerate(places.items()):
        panel = figure.add_subplot(rows, columns, index + 1, projection="3d")
        panel.scatter(*where.T, s=12, color=COLOURS[0])  # pyright: ignore[reportArgumentType]
        for axis, centre in zip("xyz", middle, strict=True):
            getattr(panel, f"set_{axis}lim")(centre - reach / 2, centre + reach / 2)
            getattr(panel, f"set_{axis}label")(f"{axis} (m)", fontsize=7, labelpad=-8)
        panel.tick_params(labelsize=6, pad=-3)
        panel.set_title(f"{name} ({len(where)})", fontsize=9)
    return png_bytes(figure)


def _without_leaps(path: NDArray[np.float64]) -> NDArray[np.float64]:
    """A path (n, 2) with gaps where one recording ends and the next begins somewhere else."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    typical = float(np.median(steps[steps > 0])) if (steps > 0).any() else math.inf
    return np.insert(path, 1 + np.flatnonzero(steps > 10 * typical), math.nan, axis=0)


def _with_gaps(links: NDArray[np.float64]) -> NDArray[np.float64]:
    """(m, 2, 2) segments as one line (3 m, 2) with a gap after each."""
    gap = np.full((len(links), 1, 2), math.nan)
    return np.concatenate([links, gap], axis=1).reshape(-1, 2)


def _style(index: int, name: str) -> dict[str, Any]:
    return {
        "color": COLOURS[index % len(COLOURS)],
        "marker": _MARKERS[index % len(_MARKERS)],
        "linestyle": _LINES[index % len(_LINES)],
        "label": name,
        "linewidth": 1.5,
        "markersize": 3.5,
    }


def _finish(axes: "Axes") -> None:
    axes.set_ylim(-3, 103)
    axes.grid(color="0.9", linewidth=0.6)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
