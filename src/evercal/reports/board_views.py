"""The board of a calibration by `evercal solve`: its corners in the images, and its place."""

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.boards.board_poses import read_board_poses
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.calibration import Calibration
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.reports.charts import COLOURS, new_figure, plain, png_bytes
from evercal.reports.page import Picture, Table

Array = NDArray[np.float64]

_FRUSTUM_M = 0.06
"""Length of a drawn frustum."""


@dataclass(frozen=True, eq=False)
class BoardSeen:
    """A board in one image."""

    view: BoardView
    """Detected corners."""
    camera_from_board: SE3
    """Pose by the robot's pose and the calibration."""
    scale: float
    """Estimated length per stated length of the board."""

    def projected(self, camera: Camera) -> Array:
        """Return the (k, 2) pixels of the corners by the calibration."""
        return camera.project(self.camera_from_board.apply(self.scale * self.view.points_m))


def boards_seen(calibration: Calibration, folder: Path) -> dict[str, BoardSeen]:
    """Return the board in each image of a calibration by name; empty without corners.

    Args:
        calibration: By `evercal solve`.
        folder: Folder of its file.
    """
    poses = calibration.checks.get("camera_from_board")
    given = Path(str(calibration.source.get("camera_poses", "")))
    file = next((f for f in (folder / given, given, folder / given.name) if f.is_file()), None)
    if not isinstance(poses, dict) or file is None:
        return {}
    try:
        board = read_board_poses(file)
    except InputError:  # poses by other programs have no corners
        return {}
    views = {(file.parent / image.name).resolve(): image.view for image in board.images}
    scale, seen = float(calibration.checks.get("scale", 1.0)), {}
    for name, pose in poses.items():
        view = views.get((folder / name).resolve()) or views.get((file.parent / name).resolve())
        if view is not None:
            seen[name] = BoardSeen(view, _pose(pose), scale)
    return seen


def board_scene(calibration: Calibration, seen: dict[str, BoardSeen]) -> Picture | None:
    """Draw the board and the cameras in the frame of the robot's base; None without corners."""
    board = calibration.checks.get("base_from_board")
    camera = calibration.camera
    if not seen or camera is None:
        return None
    moving_camera = calibration.mount == "eye_in_hand" and board is not None
    if calibration.mount == "eye_in_hand" and not moving_camera:
        return None
    drawn: list[Array] = []
    used = {image.name: image.used for image in calibration.images}
    figure = new_figure(7.0, 5.2)
    axes: Any = figure.add_subplot(projection="3d")
    fixed = _pose(board) if moving_camera else calibration.parent_from_child
    for name, item in seen.items():
        colour = COLOURS[0] if used.get(name, True) else COLOURS[1]
        if moving_camera:
            placed, lines = fixed @ item.camera_from_board.inverse(), _frustum(camera)
        else:
            placed, lines = fixed @ item.camera_from_board, _outline(item)
        drawn.append(placed.apply(lines))
        axes.plot(*drawn[-1].T, color=colour, linewidth=0.8)
    other = _outline(next(iter(seen.values()))) if moving_camera else _frustum(camera)
    drawn.append(fixed.apply(other))
    axes.plot(*drawn[-1].T, color="black", linewidth=2)
    _draw_base(axes, np.concatenate(drawn))
    axes.set_aspect("equal")
    axes.tick_params(labelsize=7)
    for axis in "xyz":
        getattr(axes, f"set_{axis}label")(plain(f"{axis} of base (m)"), fontsize=8)
    what = "the board (black) and the cameras" if moving_camera else "the camera (black) and boards"
    caption = f"In the base frame: {what}. Used images are blue, rejected ones orange."
    return Picture(png_bytes(figure), caption)


def estimates(calibration: Calibration) -> Table | None:
    """Return what was estimated together with the transform, and its standard deviation."""
    checks, rows = calibration.checks, []
    sigma = checks.get("camera_sigma", {})
    camera = calibration.camera
    if camera is not None and sigma:
        names = ("fx", "fy", "cx", "cy")
        values = {name: getattr(camera, name) for name in names}
        values |= dict(zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion, strict=False))
        for name, value in values.items():
            digits, unit = (2, " (px)") if name in names else (4, "")
            if name in sigma:
                rows.append((f"{name}{unit}", f"{value:.{digits}f}", f"{sigma[name]:.{digits}f}"))
    if "scale_sigma" in checks:
        spread = f"{checks['scale_sigma']:.5f}"
        rows.append(("size of the board, or metres per unit", f"{checks['scale']:.5f}", spread))
    if "time_offset_s" in checks:
        offset, spread = (1000 * checks[k] for k in ("time_offset_s", "time_offset_sigma_s"))
        rows.append(("clock of the robot behind that of the camera (ms)", f"{offset:.1f}",
                     f"{spread:.1f}"))  # fmt: skip
    if "corner_sigma_px" in checks:
        rows.append(("noise of a corner (px)", f"{checks['corner_sigma_px']:.3f}", ""))
    return Table(("unknown", "estimate", "standard deviation"), rows) if rows else None


def contributions(calibration: Calibration) -> Table | None:
    """Return what each image contributes, largest first; None without board images."""
    share = calibration.checks.get("information_percent")
    moved = calibration.checks.get("leave_one_out_mm")
    if not isinstance(share, dict) or not isinstance(moved, dict):
        return None
    ordered = sorted(share, key=lambda name: -share[name])
    rows = [(os.path.basename(n), f"{share[n]:.1f}", f"{moved.get(n, 0):.3f}") for n in ordered]
    header = ("image", "share of the information (%)", "position moves without it (mm)")
    return Table(header, rows)


def _pose(data: Any) -> SE3:
    return SE3(np.array(data["quaternion_wxyz"]), np.array(data["translation_m"]))


def _draw_base(axes: Any, points: Array) -> None:
    """Draw the axes of the base, 0.1 m long, unless it lies far from the points (n, 3)."""
    if np.linalg.norm(points.mean(0)) > 2 * np.linalg.norm(np.ptp(points, axis=0)):
        return
    for row, colour in zip(np.eye(3), ("#d62728", "#2ca02c", "#1f5fdc"), strict=True):
        axes.plot(*np.stack([np.zeros(3), 0.1 * row], 1), color=colour, linewidth=2)
    axes.text(0, 0, 0, "base", fontsize=8)


def _outline(seen: BoardSeen) -> Array:
    """Return the outline of the corners of a board, (5, 3) in its frame."""
    points = seen.scale * seen.view.points_m
    (x0, y0), (x1, y1) = points[:, :2].min(0), points[:, :2].max(0)
    return np.array([[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0], [x0, y0, 0]])


def _frustum(camera: Camera) -> Array:
    """Return the edges of a frustum as one line (n, 3) in the camera frame."""
    pinhole = replace(camera, distortion=())  # distortion may have no inverse in the corners
    width, height = camera.width - 1, camera.height - 1
    rays = pinhole.unproject([[0, 0], [width, 0], [width, height], [0, height]])
    a, b, c, d = _FRUSTUM_M * np.asarray(rays)
    tip = np.zeros(3)
    return np.array([tip, a, b, tip, c, d, tip, b, c, d, a, tip])
