"""Charts of a calibration: cameras in space with their uncertainty, and residuals of images."""

import math

import numpy as np

from evercal.calibration.calibration import Calibration
from evercal.reports.charts import COLOURS, new_figure, png_bytes, tidy
from evercal.reports.page import Picture
from evercal.reports.scene.frusta import Ellipsoid, Frustum, readable_scale
from evercal.reports.scene.side_views import (
    ABOVE,
    CHI2_95,
    Surroundings,
    draw_view,
    ellipse,
    frame_lines,
    frustum_line,
)

USED, REJECTED = COLOURS[0], COLOURS[1]


def camera_views(calibration: Calibration, around: Surroundings) -> Picture:
    """Draw the camera and the ellipsoid of its position, from above and from the side."""
    pose, parent = calibration.uncertain_pose, calibration.parent_frame
    ends = np.stack([np.zeros(3), pose.pose.translation_m])
    extent = float(np.ptp(around.bounds(ends), axis=0).max())
    lines = frame_lines(0.1 * extent)
    if calibration.camera is not None:
        view = Frustum.of(pose.pose, calibration.camera)
        lines.append(frustum_line(view, 0.09 * extent, COLOURS[1], 1.6))
    times = readable_scale([Ellipsoid.of(pose)], 0.07 * extent)
    variances, axes = np.linalg.eigh(pose.covariance[:3, :3])
    half = times * np.sqrt(CHI2_95 * np.diag(pose.covariance)[:3].clip(0))
    points = np.concatenate([ends, [ends[1] - half, ends[1] + half]])
    bounds = around.bounds(np.concatenate([points, *(line.points_m for line in lines)]))
    width, depth, _ = np.ptp(bounds, axis=0)
    side = int(depth > width), 2  # the wider one
    figure = new_figure(10.8, 4.8)
    for panel, plane in zip(figure.subplots(1, 2), (ABOVE, side), strict=True):
        panel.fill(*ellipse(pose, times, plane).T, color=COLOURS[1], alpha=0.3, zorder=2)
        draw_view(panel, plane, lines, around, bounds, (parent, "m"))
    c, b, a = 1000 * np.sqrt(CHI2_95 * variances.clip(0))
    forward = pose.pose.rotation_matrix()[:, 2]
    angle = np.rad2deg(np.arccos(np.clip(abs(axes[:, 2] @ forward), 0.0, 1.0)))
    caption = (
        f"In {parent}, from above and from the side. The 95 % ellipsoid of the position has half"
        f" axes of {a:.2f}, {b:.2f} and {c:.2f} mm and is drawn {times} times as large. The longest"
        f" one lies {angle:.0f} deg from the viewing direction."
    )
    return Picture(png_bytes(figure), caption)


def residual_chart(calibration: Calibration) -> Picture | None:
    """Draw the residual of each image as a bar, cut at twice the largest used one.

    None without residuals.
    """
    images = calibration.images
    rows = np.array([[i.residual_mm, i.residual_deg] for i in images], np.float64).reshape(-1, 2)
    if not np.isfinite(rows).any():
        return None
    used = np.array([image.used for image in images])
    numbers = np.arange(1, len(images) + 1)
    figure = new_figure(9.0, 3.4)
    panels = figure.subplots(2, 1, sharex=True)
    for panel, values, unit in zip(panels, np.nan_to_num(rows).T, ("mm", "deg"), strict=True):
        panel.bar(numbers[used], values[used], 0.8, color=USED)
        # Hatched, so that the two kinds differ in grey print as well.
        style = {"facecolor": "white", "edgecolor": REJECTED, "hatch": "////"}
        panel.bar(numbers[~used], values[~used], 0.8, **style)
        typical = float(values[used].max(initial=0.0))
        top = min(1.1 * float(values.max()), 2 * typical or math.inf)
        panel.set(ylim=(0, max(top, 1e-6)), ylabel=f"residual ({unit})")
        tidy(panel)
    panels[1].set(xlabel="number of the image in the table", xlim=(0.4, max(len(images), 5) + 0.6))
    words = "Residual of each image; those of rejected images are hatched, and cut where larger."
    return Picture(png_bytes(figure), words)
