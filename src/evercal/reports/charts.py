"""Charts as PNG bytes: error curves, histograms and trajectories.

The Okabe-Ito colours are distinguishable with colour blindness. No pyplot and no global state is
used.
"""

import io
import math
import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")
_MARKERS = "os^Dv<>P"
_LINES = ("-", "--", "-.", ":")


def new_figure(width: float, height: float) -> "Figure":
    """Create an empty white figure; width and height in inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=150, layout="constrained", facecolor="white")


def png_bytes(figure: "Figure") -> bytes:
    """Encode a figure as PNG. Equal figures give equal bytes."""
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # Names in scripts that the font lacks are drawn as boxes.
        warnings.filterwarnings("ignore", "Glyph .* missing from font")
        figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def tidy(panel: "Axes") -> None:
    """Apply the common style: light grid, small ticks, no frame at the top and right."""
    panel.grid(color="0.9", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.tick_params(labelsize=8)
    panel.xaxis.label.set_fontsize(9)
    panel.yaxis.label.set_fontsize(9)
    panel.spines[["top", "right"]].set_visible(False)


def line_style(index: int, name: str) -> dict[str, Any]:
    """Keywords of `plot` that distinguish lines by colour, marker and dashes."""
    return {
        "color": COLOURS[index % len(COLOURS)],
        "marker": _MARKERS[index % len(_MARKERS)],
        "linestyle": _LINES[index % len(_LINES)],
        "label": name,
        "linewidth": 1.5,
        "markersize": 3.5,
    }


def error_curve(
    groups: Mapping[str, ArrayLike], limit_mm: float = 200.0, threshold_mm: float | None = 50.0
) -> bytes:
    """Plot the share of frames below each translation error.

    Errors (frames,) are in metres, infinite without a pose.

    Raises:
        ValueError: A group is empty or contains NaN.
    """
    figure = new_figure(5.4, 3.4)
    panel = figure.subplots()
    for index, (name, values) in enumerate(groups.items()):
        errors = np.sort(_millimetres(name, values))
        shown = errors[errors <= limit_mm]
        share = 100.0 * np.arange(len(shown) + 1) / len(errors)
        x = np.concatenate([[0.0], shown, [limit_mm]])
        style = {**line_style(index, name), "marker": ""}
        panel.step(x, np.append(share, share[-1]), where="post", **style)
    if threshold_mm is not None:
        panel.axvline(threshold_mm, color="0.5", linewidth=1, linestyle=(0, (2, 2)), zorder=0)
    panel.set(xlim=(0, limit_mm), ylim=(-3, 103))
    panel.set(xlabel="translation error (mm)", ylabel="share of frames (%)")
    tidy(panel)
    panel.legend(loc="lower right", fontsize=9, frameon=False)
    return png_bytes(figure)


def error_histogram(
    groups: Mapping[str, ArrayLike], limit_mm: float = 5.0, bins: int = 20
) -> bytes:
    """Plot histograms of translation errors, one panel a group.

    Errors (frames,) are in metres, infinite without a pose. A separate grey bar counts errors above
    the limit.

    Raises:
        ValueError: A group is empty or contains NaN.
    """
    figure = new_figure(2.6 * len(groups) + 0.6, 2.6)
    panels = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
    width = limit_mm / bins
    for index, (panel, (name, values)) in enumerate(zip(panels, groups.items(), strict=True)):
        errors = _millimetres(name, values)
        counts, edges = np.histogram(errors[errors < limit_mm], bins, (0, limit_mm))
        colour = COLOURS[index % len(COLOURS)]
        panel.bar(edges[:-1], counts, 0.9 * width, align="edge", color=colour)
        beyond = int((errors >= limit_mm).sum())
        if beyond:
            panel.bar(limit_mm + width, beyond, 0.9 * width, align="edge", color="0.6")
            text = f"{beyond} larger\nor no pose"
            panel.annotate(text, (limit_mm + 2 * width, beyond), fontsize=7, ha="right")
        panel.set_title(f"{plain(name)} ({len(errors)})", fontsize=9)
        panel.set_xlim(0, limit_mm + 2.2 * width)
        tidy(panel)
    figure.supxlabel("translation error (mm)", fontsize=9)
    panels[0].set_ylabel("frames", fontsize=9)
    return png_bytes(figure)


def trajectory(truth_m: ArrayLike, estimated_m: ArrayLike) -> bytes:
    """Plot true and estimated positions along the two axes with the largest extent.

    The plot is limited to the true positions and a margin. The legend counts the estimates outside.
    Positions (n, 3) are in metres and recorded order, NaN without a pose.
    """
    truth, estimated = np.asarray(truth_m, np.float64), np.asarray(estimated_m, np.float64)
    located = np.isfinite(estimated).all(axis=1)
    axes = sorted(np.argsort(-np.ptp(truth, axis=0), kind="stable")[:2].tolist())
    true, guess = truth[:, axes], estimated[:, axes]
    low, high = true.min(axis=0), true.max(axis=0)
    margin = max(0.15 * float((high - low).max()), 0.05)
    inside = ((guess >= low - margin) & (guess <= high + margin)).all(axis=1)
    figure = new_figure(5.4, 4.6)
    panel = figure.subplots()
    panel.plot(*_split_at_jumps(true).T, color="0.6", linewidth=1, label=f"true ({len(true)})")
    gap = np.full((len(true), 1, 2), math.nan)
    links = np.concatenate([true[:, None], guess[:, None], gap], axis=1)[located]
    panel.plot(*links.reshape(-1, 2).T, color=COLOURS[1], linewidth=0.8, alpha=0.6)
    panel.plot(*guess[inside].T, ".", color=COLOURS[0], label=f"estimated ({int(located.sum())})")
    if not located.all():
        label = f"no pose ({int((~located).sum())})"
        panel.plot(*true[~located].T, "x", color=COLOURS[6], markersize=5, label=label)
    if (outside := int((located & ~inside).sum())) > 0:
        panel.plot([], [], color=COLOURS[1], label=f"estimated outside this plot ({outside})")
    xlim, ylim = np.stack([low - margin, high + margin], 1)
    panel.set(xlim=xlim, ylim=ylim, aspect="equal")
    panel.set(xlabel=f"{'xyz'[axes[0]]} (m)", ylabel=f"{'xyz'[axes[1]]} (m)")
    tidy(panel)
    figure.legend(loc="outside upper center", ncols=2, frameon=False, fontsize=9)
    return png_bytes(figure)


def plain(text: str) -> str:
    """Escape the dollar signs with which matplotlib marks formulas."""
    return text.replace("$", r"\$")


def _millimetres(name: str, errors_m: ArrayLike) -> Array:
    errors = 1000.0 * np.asarray(errors_m, dtype=np.float64).ravel()
    if not len(errors) or np.isnan(errors).any():
        raise ValueError(f"{name}: errors are at least one number (inf allowed), got {errors}")
    return errors


def _split_at_jumps(path: Array) -> Array:
    """Insert NaN into a path (n, 2) between recordings."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    typical = float(np.median(steps[steps > 0])) if (steps > 0).any() else math.inf
    return np.insert(path, 1 + np.flatnonzero(steps > 10 * typical), math.nan, axis=0)
