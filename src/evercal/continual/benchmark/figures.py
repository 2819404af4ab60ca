"""The common style of figures with matplotlib; no pyplot and no global state is used.

The Okabe-Ito colours are distinguishable with colour blindness.
"""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from evercal.typing import JsonObject

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


def line_style(index: int, name: str) -> JsonObject:
    """Keywords of `plot` that distinguish lines by colour, marker and dashes."""
    return {
        "color": COLOURS[index % len(COLOURS)],
        "marker": _MARKERS[index % len(_MARKERS)],
        "linestyle": _LINES[index % len(_LINES)],
        "label": name,
        "linewidth": 1.5,
        "markersize": 3.5,
    }
