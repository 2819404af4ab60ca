"""A scene from two sides, drawn to scale: landmarks, keyframes, cameras, and their uncertainty."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from evercal.geometry import UncertainPose
from evercal.reports.charts import COLOURS, new_figure, plain, png_bytes, tidy
from evercal.reports.scene.frusta import Ellipsoid, Frustum, readable_scale
from evercal.reports.scene.map_parts import Landmarks3D, keyframe_views

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from evercal.calibration.calibration import Calibration
    from evercal.mapping.scene_map import SceneMap

Array = NDArray[np.float64]
Plane = tuple[int, int]

ABOVE: Plane = (0, 1)
"""The axes of the base that a view from above shows."""
SHARE = 0.95
"""Probability of a position inside its drawn ellipsoid."""
_MOST_POINTS = 6000
_AXES = ("#c0392b", "#1e8449", "#2874a6")
"""Colours of x, y and z."""


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What stays the same in every view of a scene; lengths in the unit of its map."""

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
        margin = 0.15 * reach
        return np.stack([low - margin, high + margin])


def draw_surroundings(panel: "Axes", scene: Surroundings, plane: Plane, frustum_m: float) -> None:
    """Draw landmarks as dots and keyframes as frusta of a length."""
    shades = 0.35 + 0.5 * scene.grey / 255  # neither ink nor paper
    pairs = scene.points_m[:, plane]
    panel.scatter(*pairs.T, s=2.0, c=shades, cmap="gray", vmin=0, vmax=1, linewidths=0, zorder=1)
    for view in scene.keyframes:
        draw_frustum(panel, view, plane, frustum_m, COLOURS[0])


def draw_frustum(
    panel: "Axes", view: Frustum, plane: Plane, length_m: float, colour: str, width: float = 0.8
) -> None:
    """Draw the edges of a view, and its eye as a dot."""
    a, b, c, d = view.corners(length_m)
    eye = view.base_from_camera.translation_m
    line = np.array([eye, a, b, eye, c, d, eye, b, c, d, a])[:, plane]
    panel.plot(*line.T, color=colour, linewidth=width, zorder=3)
    panel.plot(*eye[list(plane)], "o", color=colour, markersize=2.5 * width, zorder=3)


def draw_frame(panel: "Axes", plane: Plane, length_m: float, name: str) -> None:
    """Draw the axes of a frame at the origin: x red, y green, z blue."""
    for row, colour in zip(np.eye(3), _AXES, strict=True):
        line = np.stack([np.zeros(3), length_m * row], 1)[list(plane)]
        panel.plot(*line, color=colour, linewidth=2, zorder=4)
    panel.annotate(
        plain(name[:24]), (0, 0), (4, -11), textcoords="offset points", fontsize=9, zorder=5
    )


def draw_ellipse(
    panel: "Axes", pose: UncertainPose, plane: Plane, times: float, colour: str
) -> None:
    """Draw where a position lies with the probability `SHARE`, `times` as large as it is."""
    from evercal.reports.calibration_charts import ellipsoid_outline

    outline = ellipsoid_outline(times**2 * pose.covariance[:3, :3], plane, SHARE)
    x, y = (pose.pose.translation_m[list(plane)] + outline).T
    panel.fill(x, y, facecolor=colour, alpha=0.3, edgecolor=colour, linewidth=1.2, zorder=2)


def calibrated_views(calibration: "Calibration", scene: Surroundings) -> tuple[list[bytes], str]:
    """Two views of a calibrated camera among its surroundings, and a caption.

    Empty without intrinsics or without an uncertainty. The surroundings are those of a fixed
    camera: a camera on the gripper is drawn at the gripper.
    """
    uncertain, camera = calibration.uncertain_pose, calibration.camera
    if camera is None or not np.trace(uncertain.covariance) > 0:
        return [], ""
    view = Frustum.of(calibration.parent_from_child, camera)
    bounds = scene.bounds(np.stack([np.zeros(3), view.base_from_camera.translation_m]))
    extent = float((bounds[1] - bounds[0]).max())
    times = readable_scale([Ellipsoid.of(uncertain)])
    parent = calibration.parent_frame
    wider = int(np.ptp(bounds, axis=0)[1] > np.ptp(bounds, axis=0)[0])
    pictures = []
    for plane in (ABOVE, (wider, 2)):
        figure = new_figure(5.4, 4.6)
        panel = figure.subplots()
        draw_surroundings(panel, scene, plane, 0.05 * extent)
        draw_frame(panel, plane, 0.1 * extent, parent)
        draw_ellipse(panel, uncertain, plane, times, COLOURS[1])
        draw_frustum(panel, view, plane, 0.09 * extent, COLOURS[1], 1.6)
        set_plane(panel, bounds, plane, parent)
        pictures.append(png_bytes(figure))
    return pictures, f"ellipsoid {times} times as large" if times > 1 else "ellipsoid to scale"


def set_plane(panel: "Axes", bounds: Array, plane: Plane, frame: str, unit: str = "m") -> None:
    """Limit a panel to a box, at one scale, and name its axes."""
    (x0, y0), (x1, y1) = bounds[:, plane]
    x, y = (plain(f"{'xyz'[axis]} of {frame[:24]} ({unit})") for axis in plane)
    panel.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal", xlabel=x, ylabel=y)
    panel.locator_params(nbins=7)
    tidy(panel)
