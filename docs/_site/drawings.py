"""Draw the pictures of docs/conventions.md: python docs/_site/drawings.py [FOLDER]."""

import sys
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

AXES = {"x": "#c0392b", "y": "#1e8449", "z": "#2874a6"}
INK = "#555555"
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "evercal",  # the same bytes each time
    "font.family": "sans-serif",
    "text.color": INK,
}
_OBLIQUE = np.array([[0.94, 0.0], [0.34, 0.30], [0.0, 1.0]])
"""Where x, y and z of the base frame point on paper, shape (3, 2)."""


def frames(path: Path) -> None:
    """The frames of a cell: base, gripper, camera, and the transforms between them."""
    figure, axes = _page(6.4, 3.6)
    base = np.zeros(2)
    gripper = np.array([1.5, 1.6])
    camera = np.array([2.45, 1.75])
    fixed = np.array([4.3, 1.75])
    point = np.array([3.1, 0.15])
    axes.plot(
        *np.array([base, [0.1, 1.25], [0.9, 1.95], gripper]).T,
        color="#cccccc",
        lw=9,
        zorder=0,
    )
    axes.plot(
        *np.array([[-0.5, -0.12], [4.6, -0.12]]).T, color="#cccccc", lw=2, zorder=0
    )
    axes.add_patch(Rectangle((2.95, -0.1), 0.3, 0.25, color="#dddddd", zorder=0))
    down = np.array([-0.05, -0.45])
    right = np.array([0.33, 0.1])
    forward = np.array([0.2, -0.42])
    _triad(axes, base, _OBLIQUE * 0.5, "base")
    _triad(axes, gripper, np.array([right, [0.12, 0.3], down]), "gripper", above=True)
    towards = (point - camera) / np.linalg.norm(point - camera) * 0.5
    _triad(
        axes,
        camera,
        np.array([[0.36, 0.12], forward * [-1.2, 0.5], towards]),
        "camera",
        above=True,
    )
    towards = (point - fixed) / np.linalg.norm(point - fixed) * 0.5
    _triad(
        axes,
        fixed,
        np.array([[-0.2, 0.28], [-0.12, -0.4], towards]),
        "fixed camera",
        above=True,
    )
    for eye in (camera, fixed):
        axes.plot(*np.array([eye, point]).T, color=INK, lw=0.8, ls=":")
    axes.add_patch(Circle((point[0], point[1]), 0.04, color=INK))
    axes.text(point[0] + 0.12, point[1] + 0.05, "point")
    _arrow(axes, base, gripper, "base_from_gripper", (0.98, 0.9))
    _arrow(axes, gripper, camera, "gripper_from_camera", (1.5, 2.3))
    _arrow(axes, base, fixed, "base_from_camera", (1.75, 0.42))
    axes.set(xlim=(-0.6, 5.1), ylim=(-0.3, 2.55))
    _save(figure, path)


def pixels(path: Path) -> None:
    """Pixel coordinates of an image that is four pixels wide and three high."""
    figure, axes = _page(4.6, 3.0)
    width = 4
    height = 3
    for u in range(width):
        for v in range(height):
            axes.add_patch(
                Rectangle((u - 0.5, v - 0.5), 1, 1, fill=False, ec="#bbbbbb")
            )
            axes.plot(u, v, ".", color="#bbbbbb", ms=4)
    axes.plot(0, 0, "o", color=AXES["x"], ms=6)
    axes.text(0.08, 0.32, "(0, 0)", color=AXES["x"])
    axes.plot(-0.5, -0.5, "s", color=INK, ms=5)
    axes.text(-0.5, -0.62, "(-0.5, -0.5)", ha="center")
    middle = (width - 1) / 2, (height - 1) / 2
    axes.plot(*middle, "x", color=AXES["z"], ms=8)
    axes.text(
        middle[0] + 0.1, middle[1] + 0.32, "(1.5, 1), the middle", color=AXES["z"]
    )
    for end, name, colour in (
        ((4.0, -0.95), "u", AXES["x"]),
        ((-0.95, 2.9), "v", AXES["y"]),
    ):
        axes.annotate(
            "", end, (-0.95, -0.95), arrowprops={"arrowstyle": "->", "color": colour}
        )
        axes.text(end[0] + 0.08, end[1] + 0.12, name, color=colour)
    axes.set(xlim=(-1.3, 4.4), ylim=(3.2, -1.2))
    _save(figure, path)


def _page(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_aspect("equal")
    axes.axis("off")
    return figure, axes


def _xy(point: np.ndarray) -> tuple[float, float]:
    return float(point[0]), float(point[1])


def _triad(
    axes: Axes, origin: np.ndarray, ends: np.ndarray, name: str, above: bool = False
) -> None:
    """Three axes from an origin; ends (3, 2) are relative to it."""
    for (label, colour), end in zip(AXES.items(), ends, strict=True):
        style = {"arrowstyle": "-|>", "color": colour, "lw": 1.5}
        axes.annotate("", _xy(origin + end), _xy(origin), arrowprops=style)
        u, v = _xy(origin + 1.22 * end)
        axes.text(u, v, label, color=colour, ha="center", va="center")
    u, v = _xy(origin + np.array([0, 0.42] if above else [-0.32, -0.02]))
    axes.text(u, v, name, ha="center", weight="bold")


def _arrow(
    axes: Axes, start: np.ndarray, end: np.ndarray, name: str, at: tuple[float, float]
) -> None:
    """A dashed arrow between two frames with its name beside it."""
    style = {"arrowstyle": "->", "color": INK, "ls": "--", "shrinkA": 10, "shrinkB": 10}
    axes.annotate("", _xy(end), _xy(start), arrowprops=style)
    axes.text(*at, name, family="monospace", fontsize=8.5)


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, format="svg", transparent=True, metadata={"Date": None})


def main(folder: Path) -> None:
    """Write both drawings to a folder."""
    mpl.rcParams.update(_STYLE)
    frames(folder / "frames.svg")
    pixels(folder / "pixels.svg")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[1])
