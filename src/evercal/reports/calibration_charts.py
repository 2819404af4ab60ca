"""Charts of a calibration: cameras in space with their uncertainty, and residuals of images."""

import math
from collections.abc import Mapping

import numpy as np

from evercal.calibration.calibration import Calibration
from evercal.reports.boards_seen import BoardSeen, pose_of
from evercal.reports.charts import COLOURS, new_figure, png_bytes, tidy
from evercal.reports.page import Picture
from evercal.reports.scene.frusta import Ellipsoid, Frustum, readable_scale
from evercal.reports.scene.side_views import (
    ABOVE,
    CHI2_95,
    Line,
    Surroundings,
    draw_view,
    ellipse,
    frame_lines,
    frustum_line,
)

USED, REJECTED, OTHER = COLOURS[0], COLOURS[1], "black"


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
    figure = new_figure(10.8, 4.8)
    for panel, plane in zip(figure.subplots(1, 2), (ABOVE, _side(bounds)), strict=True):
        draw_view(panel, plane, lines, around, bounds, (parent, "m"))
        panel.fill(*ellipse(pose, times, plane).T, color=COLOURS[1], alpha=0.3, zorder=2)
    c, b, a = 1000 * np.sqrt(CHI2_95 * variances.clip(0))
    forward = pose.pose.rotation_matrix()[:, 2]
    angle = np.rad2deg(np.arccos(np.clip(abs(axes[:, 2] @ forward), 0.0, 1.0)))
    caption = (
        f"In {parent}, from above and from the side. The 95 % ellipsoid of the position has half"
        f" axes of {a:.2f}, {b:.2f} and {c:.2f} mm and is drawn {times} times as large. The longest"
        f" one lies {angle:.0f} deg from the viewing direction."
    )
    return Picture(png_bytes(figure), caption)


def board_views(calibration: Calibration, boards: Mapping[str, BoardSeen]) -> Picture | None:
    """Draw boards and cameras in the base frame; None where they are not known."""
    camera, board = calibration.camera, calibration.checks.get("base_from_board")
    carried = calibration.mount == "eye_in_hand"
    if not boards or camera is None or (carried and board is None):
        return None
    used = {image.name: image.used for image in calibration.images}
    fixed = pose_of(board) if carried else calibration.parent_from_child
    depth = 0.12 * float(np.median([s.camera_from_board.translation_m[2] for s in boards.values()]))
    lines = frame_lines(depth)
    for name, seen in boards.items():
        colour = USED if used.get(name, True) else REJECTED
        if carried:
            eye = fixed @ seen.camera_from_board.inverse()
            lines.append(frustum_line(Frustum.of(eye, camera), depth, colour))
        else:
            lines.append(Line((fixed @ seen.camera_from_board).apply(seen.outline_m), colour))
    if carried:
        lines.append(Line(fixed.apply(next(iter(boards.values())).outline_m), OTHER, 1.6))
    else:
        lines.append(frustum_line(Frustum.of(fixed, camera), depth, OTHER, 1.6))
    nothing = Surroundings()
    bounds = nothing.bounds(np.concatenate([line.points_m for line in lines]))
    figure = new_figure(10.8, 4.8)
    for panel, plane in zip(figure.subplots(1, 2), (ABOVE, _side(bounds)), strict=True):
        draw_view(panel, plane, lines, nothing, bounds)
    what = "the board (black) and the cameras" if carried else "the camera (black) and boards"
    caption = f"In the base frame: {what}. Used images are blue, rejected ones orange."
    return Picture(png_bytes(figure), caption)


def _side(bounds: np.ndarray) -> tuple[int, int]:
    """The plane of the wider of two views from the side."""
    width, depth, _ = np.ptp(bounds, axis=0)
    return int(depth > width), 2


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
