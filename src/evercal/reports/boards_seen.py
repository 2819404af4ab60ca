"""The board of a calibration by `evercal solve`, found again in its images."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.boards.board_poses import read_board_poses
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.calibration import Calibration
from evercal.errors import InputError
from evercal.geometry import SE3, Camera

Array = NDArray[np.float64]


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

    @property
    def outline_m(self) -> Array:
        """(5, 3) the outline of the corners in the frame of the board."""
        points = self.scale * self.view.points_m
        (x0, y0), (x1, y1) = points[:, :2].min(0), points[:, :2].max(0)
        return np.array([[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0], [x0, y0, 0]])


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
            seen[name] = BoardSeen(view, pose_of(pose), scale)
    return seen


def pose_of(data: Any) -> SE3:
    """Return the pose of JSON values."""
    return SE3(np.array(data["quaternion_wxyz"]), np.array(data["translation_m"]))
