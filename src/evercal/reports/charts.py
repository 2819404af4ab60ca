"""Charts as PNG bytes: their common style, and the curve of errors.

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
    """
    figure = new_figure(5.4, 3.4)
    panel = figure.subplots()
    for index, (name, values) in enumerate(groups.items()):
        errors = np.sort(1000.0 * np.asarray(values, np.float64))
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


def plain(text: str) -> str:
    """Escape the dollar signs with which matplotlib marks formulas."""
    return text.replace("$", r"\$")
