"""Charts of how sure an answer is, as PNG bytes: its ellipsoid, its error terms, its residuals."""

import math
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evercal.reports.canvas import COLOURS, new_figure, plain, png_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

_PLANES = ((0, 1), (0, 2), (1, 2))
_MOST_NUMBERED = 40
"""More bars than this are not numbered one by one."""


def ellipsoid_shadow(covariance: ArrayLike, plane: tuple[int, int], share: float) -> Array:
    """The outline that an ellipsoid of errors throws onto a plane of two axes.

    Args:
        covariance: (3, 3) of Gaussian errors, any unit squared.
        plane: numbers of the two axes.
        share: of all errors that lie inside the ellipsoid, 0 to 1.

    Returns:
        (181, 2) closed outline about 0, in the unit of the errors.
    """
    from scipy import stats

    both = np.asarray(covariance, dtype=np.float64)[np.ix_(plane, plane)]
    values, vectors = np.linalg.eigh(both)
    half_axes = np.sqrt(stats.chi2.ppf(share, 3) * np.clip(values, 0.0, None))
    turn = np.linspace(0.0, 2 * math.pi, 181)
    return np.stack([np.cos(turn), np.sin(turn)], axis=1) * half_axes @ vectors.T


def ellipsoid_shadows(covariance_mm2: ArrayLike, frame: str, share: float = 0.95) -> bytes:
    """An ellipsoid of errors seen along each axis, all at one scale.

    Args:
        covariance_mm2: (3, 3) of a position, square millimetres.
        frame: what the axes belong to.
        share: of all errors that lie inside, 0 to 1.

    Raises:
        ValueError: A covariance of another shape.
    """
    covariance = np.asarray(covariance_mm2, dtype=np.float64)
    if covariance.shape != (3, 3):
        raise ValueError(f"the covariance of a position is (3, 3), got {covariance.shape}")
    outlines = [ellipsoid_shadow(covariance, plane, share) for plane in _PLANES]
    reach = 1.15 * max(float(np.abs(outlines).max()), 1e-3)
    figure = new_figure(9.0, 3.1)
    for panel, (a, b), outline in zip(figure.subplots(1, 3), _PLANES, outlines, strict=True):
        panel.fill(*outline.T, facecolor=COLOURS[5], alpha=0.35, edgecolor="none")
        panel.plot(*outline.T, color=COLOURS[0], linewidth=1.5)
        panel.plot(0, 0, "+", color=COLOURS[6], markersize=7)
        panel.set_xlim(-reach, reach)
        panel.set_ylim(-reach, reach)
        panel.set_aspect("equal")
        panel.set_xlabel(plain(f"{'xyz'[a]} of {_short(frame)} (mm)"), fontsize=9)
        panel.set_ylabel(plain(f"{'xyz'[b]} of {_short(frame)} (mm)"), fontsize=9)
        panel.set_title(f"{'xyz'[a]}{'xyz'[b]}", fontsize=9)
        panel.locator_params(nbins=7)
        _quiet(panel)
    return png_bytes(figure)


def error_terms(
    names: Sequence[str], millimetres: Sequence[float], degrees: Sequence[float]
) -> bytes:
    """Bars side by side: what the error of a position and of a rotation is made of.

    Args:
        names: of the terms; the last is the sum of them all, which stands apart.
        millimetres: one for each.
        degrees: one for each.

    Raises:
        ValueError: Not as many numbers as names, or none.
    """
    if not names or not len(names) == len(millimetres) == len(degrees):
        raise ValueError(
            f"error terms take a number of each kind for each name; got {len(names)},"
            f" {len(millimetres)} and {len(degrees)}"
        )
    wrapped = [plain(textwrap.fill(textwrap.shorten(name, 130), 34)) for name in names]
    lines = sum(max(2, 1 + name.count("\n")) for name in wrapped)
    figure = new_figure(9.0, 0.9 + 0.2 * lines)
    place = np.arange(len(names))
    colours = [COLOURS[0]] * (len(names) - 1) + ["0.45"]
    panels = figure.subplots(1, 2, sharey=True)
    for panel, values, unit in zip(panels, (millimetres, degrees), ("mm", "deg"), strict=True):
        panel.barh(place, values, height=0.6, color=colours)
        largest = max(max(values), 1e-9)
        for y, value in zip(place, values, strict=True):
            text = f"{value:.2f}" if unit == "mm" else f"{value:.3f}"
            panel.annotate(text, (value + 0.02 * largest, y), va="center", fontsize=8)
        panel.set_xlim(0, 1.18 * largest)
        panel.set_ylim(len(names) - 0.4, -0.6)
        panel.set_xlabel(f"standard deviation per axis ({unit})", fontsize=9)
        _quiet(panel)
        panel.locator_params(axis="x", nbins=5)
        panel.grid(visible=False, axis="y")
    panels[0].set_yticks(place, wrapped, fontsize=8)
    return png_bytes(figure)


def residual_bars(
    millimetres: Sequence[float | None], degrees: Sequence[float | None], used: Sequence[bool]
) -> bytes:
    """One bar for each measurement, numbered from 1: how far it lies from the answer.

    Those that were left out are hatched. A bar that would dwarf the used ones is cut and its length
    written over it.

    Args:
        millimetres: lengths of the residuals; None where there is none.
        degrees: the same of the rotation.
        used: whether the answer rests on it.

    Raises:
        ValueError: Not as many of each.
    """
    if not used or not len(used) == len(millimetres) == len(degrees):
        raise ValueError(
            f"residuals take as many numbers of each kind as measurements; got {len(used)},"
            f" {len(millimetres)} and {len(degrees)}"
        )
    figure = new_figure(9.0, 3.9)
    kept = np.array(used, dtype=bool)
    place = np.arange(1, len(used) + 1)
    panels = figure.subplots(2, 1, sharex=True)
    for panel, values, unit in zip(panels, (millimetres, degrees), ("mm", "deg"), strict=True):
        heights = np.array([math.nan if v is None else v for v in values], dtype=np.float64)
        top = _top(heights, kept)
        shown = np.minimum(np.nan_to_num(heights), top)
        if kept.any():
            panel.bar(place[kept], shown[kept], 0.8, color=COLOURS[0], label="used")
        if not kept.all():
            # White with a hatch: apart from the used ones in grey print as well.
            style = {"facecolor": "white", "edgecolor": COLOURS[1], "hatch": "////"}
            panel.bar(place[~kept], shown[~kept], 0.8, linewidth=0.8, label="left out", **style)
        for x in place[np.nan_to_num(heights) > top]:
            words = f"cut, {heights[x - 1]:.3g}"
            panel.annotate(words, (x, top), va="bottom", ha="center", fontsize=7)
        panel.set_ylim(0, 1.12 * top)
        panel.set_ylabel(f"residual ({unit})", fontsize=9)
        _quiet(panel)
        panel.grid(visible=False, axis="x")
    panels[1].set_xlabel("number of the image in the table", fontsize=9)
    panels[1].set_xlim(0.4, max(len(used), 5) + 0.6)
    if len(used) <= _MOST_NUMBERED:
        panels[1].set_xticks(place)
    if not kept.all():
        panels[0].legend(fontsize=8, frameon=False, loc="upper left", ncols=2)
        panels[0].set_ylim(0, 1.25 * panels[0].get_ylim()[1])
    return png_bytes(figure)


def _top(heights: Array, kept: NDArray[np.bool_]) -> float:
    """Where an axis ends: over all bars, unless that makes the used ones too small to see."""
    every = heights[np.isfinite(heights)]
    usual = heights[np.isfinite(heights) & kept]
    highest = float(every.max()) if len(every) else 0.0
    if len(usual) and highest > 4 * usual.max() > 0:
        highest = 2 * float(usual.max())
    return max(highest, 1e-6)


def _short(name: str) -> str:
    return textwrap.shorten(name, 24, placeholder="...") if " " in name else name[:24]


def _quiet(panel: "Axes") -> None:
    panel.grid(color="0.9", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.tick_params(labelsize=8)
    panel.spines[["top", "right"]].set_visible(False)
