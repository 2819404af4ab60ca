"""Cameras in space from above and from the side, drawn to scale among landmarks and keyframes."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from evercal.geometry import UncertainPose
from evercal.reports.charts import COLOURS, plain, tidy
from evercal.reports.scene.frusta import Frustum
from evercal.reports.scene.map_parts import Landmarks3D, keyframe_views

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from evercal.mapping.scene_map import SceneMap

Array = NDArray[np.float64]
Plane = tuple[int, int]

ABOVE: Plane = (0, 1)
"""The axes of the base that a view from above shows."""
CHI2_95 = 7.8147
"""Squared Mahalanobis distance of 95 % of three-dimensional errors."""
_MOST_POINTS = 6000
_AXES = ("#c0392b", "#1e8449", "#2874a6")
"""Colours of x, y and z."""


class Line(NamedTuple):
    """A line in space."""

    points_m: Array
    """(n, 3)."""
    colour: str
    width: float = 0.8


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Landmarks and keyframes of a map; lengths in its unit."""

    points_m: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """(n, 3) landmarks."""
    grey: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    """(n,) their pixels."""
    keyframes: tuple[Frustum, ...] = ()
    """Views of the map."""

    @classmethod
    def of(cls, scene: "SceneMap") -> Self:
        """The landmarks and keyframes of a map."""
        marks = Landmarks3D.of(scene, _MOST_POINTS)
        views = tuple(view.frustum for view in keyframe_views(scene))
        return cls(np.asarray(marks.points_m, np.float64), marks.grey, views)

    def bounds(self, others: Array) -> Array:
        """(2, 3) corners of a box around the keyframes, other points, and the landmarks near by."""
        eyes = [view.base_from_camera.translation_m for view in self.keyframes]
        points = np.concatenate([np.reshape(eyes, (-1, 3)), others])
        low, high = points.min(0), points.max(0)
        reach = max(float((high - low).max()), 0.1)
        if len(self.points_m):  # few landmarks lie far behind a window
            far = np.percentile(self.points_m, [2, 98], axis=0)
            low = np.minimum(low, np.maximum(far[0], low - reach))
            high = np.maximum(high, np.minimum(far[1], high + reach))
        return np.stack([low - 0.1 * reach, high + 0.1 * reach])


def frustum_line(view: Frustum, length_m: float, colour: str, width: float = 0.8) -> Line:
    """The edges of a view as one line."""
    a, b, c, d = view.corners(length_m)
    eye = view.base_from_camera.translation_m
    return Line(np.array([eye, a, b, eye, c, d, eye, b, c, d, a]), colour, width)


def frame_lines(length_m: float) -> list[Line]:
    """The axes of the frame that is drawn: x red, y green, z blue."""
    return [
        Line(np.stack([np.zeros(3), length_m * axis]), colour, 2.0)
        for axis, colour in zip(np.eye(3), _AXES, strict=True)
    ]


def ellipse(pose: UncertainPose, times: float, plane: Plane) -> Array:
    """(n, 2) outline in a plane of the ellipsoid that holds a position with 95 %, enlarged."""
    values, vectors = np.linalg.eigh(pose.covariance[np.ix_(plane, plane)])
    half_axes = times * np.sqrt(CHI2_95 * values.clip(0))
    angle = np.linspace(0.0, 2 * np.pi, 181)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return pose.pose.translation_m[list(plane)] + circle * half_axes @ vectors.T


def draw_view(
    panel: "Axes",
    plane: Plane,
    lines: Sequence[Line],
    around: Surroundings,
    bounds: Array,
    names: tuple[str, str] = ("base", "m"),
) -> None:
    """Draw lines, landmarks and keyframes within a box; `names` are those of frame and unit."""
    shades = 0.35 + 0.5 * around.grey / 255  # neither ink nor paper
    pairs = around.points_m[:, plane]
    panel.scatter(*pairs.T, s=2.0, c=shades, cmap="gray", vmin=0, vmax=1, linewidths=0, zorder=1)
    length = 0.04 * float(np.ptp(bounds, axis=0).max())
    keyframes = [frustum_line(view, length, COLOURS[0]) for view in around.keyframes]
    for line in (*keyframes, *lines):
        panel.plot(*line.points_m[:, plane].T, color=line.colour, linewidth=line.width, zorder=3)
    frame, unit = names
    (x0, y0), (x1, y1) = bounds[:, plane]
    x, y = (plain(f"{'xyz'[axis]} of {frame[:24]} ({unit})") for axis in plane)
    panel.set(xlabel=x, ylabel=y)
    panel.locator_params(nbins=7)
    tidy(panel)
    # Where the box is narrower than the panel, more is shown, and nothing white.
    panel.set_xlim(x0, x1, auto=True)
    panel.set_ylim(y0, y1, auto=True)
    panel.set_aspect("equal", adjustable="datalim")
