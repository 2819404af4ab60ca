"""Charts of a calibration as PNG bytes: its ellipsoid, error budget and residuals."""

import math
import textwrap
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evercal.reports.charts import COLOURS, new_figure, plain, png_bytes, tidy

Array = NDArray[np.float64]

_PLANES = ((0, 1), (0, 2), (1, 2))
_MAX_NUMBERED = 40
"""Largest number of bars that are numbered individually."""


def ellipsoid_outline(covariance: ArrayLike, plane: tuple[int, int], share: float) -> Array:
    """Project an error ellipsoid onto the plane of two axes.

    The outline (181, 2) about 0 has the unit of the errors. `share` is the probability of an error
    inside the ellipsoid.
    """
    from scipy import stats

    projected = np.asarray(covariance, dtype=np.float64)[np.ix_(plane, plane)]
    values, vectors = np.linalg.eigh(projected)
    half_axes = np.sqrt(stats.chi2.ppf(share, 3) * np.clip(values, 0.0, None))
    angle = np.linspace(0.0, 2 * math.pi, 181)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1) * half_axes @ vectors.T


def ellipsoid_projections(covariance_mm2: ArrayLike, frame: str, share: float = 0.95) -> bytes:
    """Plot an error ellipsoid along each axis, all at one scale.

    The covariance is (3, 3) of a position, square millimetres.
    """
    outlines = [ellipsoid_outline(covariance_mm2, plane, share) for plane in _PLANES]
    reach = 1.15 * max(float(np.abs(outlines).max()), 1e-3)
    figure = new_figure(9.0, 3.1)
    for panel, (a, b), outline in zip(figure.subplots(1, 3), _PLANES, outlines, strict=True):
        panel.fill(*outline.T, facecolor=COLOURS[5], alpha=0.35, edgecolor="none")
        panel.plot(*outline.T, color=COLOURS[0], linewidth=1.5)
        panel.plot(0, 0, "+", color=COLOURS[6], markersize=7)
        panel.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
        x, y = (plain(f"{'xyz'[axis]} of {frame[:24]} (mm)") for axis in (a, b))
        panel.set(xlabel=x, ylabel=y)
        panel.locator_params(nbins=7)
        tidy(panel)
    return png_bytes(figure)


def error_terms(
    names: Sequence[str], millimetres: Sequence[float], degrees: Sequence[float]
) -> bytes:
    """Plot the standard deviations that make up an error, position and rotation side by side.

    The last term is the total.
    """
    wrapped = [plain(textwrap.fill(textwrap.shorten(name, 130), 34)) for name in names]
    lines = sum(max(2, 1 + name.count("\n")) for name in wrapped)
    figure = new_figure(9.0, 0.9 + 0.2 * lines)
    rows = np.arange(len(names))
    colours = [COLOURS[0]] * (len(names) - 1) + ["0.45"]
    panels = figure.subplots(1, 2, sharey=True)
    for panel, values, unit in zip(panels, (millimetres, degrees), ("mm", "deg"), strict=True):
        panel.barh(rows, values, height=0.6, color=colours)
        largest = max(max(values), 1e-9)
        for y, value in zip(rows, values, strict=True):
            text = f"{value:.2f}" if unit == "mm" else f"{value:.3f}"
            panel.annotate(text, (value + 0.02 * largest, y), va="center", fontsize=8)
        panel.set(xlim=(0, 1.18 * largest), ylim=(len(names) - 0.4, -0.6))
        panel.set(xlabel=f"standard deviation per axis ({unit})")
        tidy(panel)
        panel.locator_params(axis="x", nbins=5)
        panel.grid(visible=False, axis="y")
    panels[0].set_yticks(rows, wrapped, fontsize=8)
    return png_bytes(figure)


def residual_bars(
    millimetres: Sequence[float | None], degrees: Sequence[float | None], used: Sequence[bool]
) -> bytes:
    """Plot the residual of each image, numbered from 1; rejected ones are hatched.

    Bars much larger than all bars of used images are cut and labelled with their length.
    """
    figure = new_figure(9.0, 3.9)
    selected = np.array(used, dtype=bool)
    numbers = np.arange(1, len(used) + 1)
    panels = figure.subplots(2, 1, sharex=True)
    for panel, values, unit in zip(panels, (millimetres, degrees), ("mm", "deg"), strict=True):
        heights = np.array([math.nan if v is None else v for v in values], dtype=np.float64)
        top = _axis_top(heights, selected)
        shown = np.minimum(np.nan_to_num(heights), top)
        if selected.any():
            panel.bar(numbers[selected], shown[selected], 0.8, color=COLOURS[0], label="used")
        if not selected.all():
            # Hatched, so that the two kinds differ in grey print as well.
            style = {"facecolor": "white", "edgecolor": COLOURS[1], "hatch": "////"}
            panel.bar(
                numbers[~selected], shown[~selected], 0.8, linewidth=0.8, label="rejected", **style
            )
        for x in numbers[np.nan_to_num(heights) > top]:
            text = f"cut, {heights[x - 1]:.3g}"
            panel.annotate(text, (x, top), va="bottom", ha="center", fontsize=7)
        panel.set(ylim=(0, 1.12 * top), ylabel=f"residual ({unit})")
        tidy(panel)
        panel.grid(visible=False, axis="x")
    panels[1].set_xlabel("number of the image in the table", fontsize=9)
    panels[1].set_xlim(0.4, max(len(used), 5) + 0.6)
    if len(used) <= _MAX_NUMBERED:
        panels[1].set_xticks(numbers)
    if not selected.all():
        panels[0].legend(fontsize=8, frameon=False, loc="upper left", ncols=2)
        panels[0].set_ylim(0, 1.25 * panels[0].get_ylim()[1])
    return png_bytes(figure)


def _axis_top(heights: Array, selected: NDArray[np.bool_]) -> float:
    """Upper end of an axis: the largest bar, or twice the largest selected bar if much smaller."""
    finite = np.isfinite(heights)
    highest = float(heights[finite].max(initial=0.0))
    typical = float(heights[finite & selected].max(initial=0.0))
    if highest > 4 * typical > 0:
        highest = 2 * typical
    return max(highest, 1e-6)
