"""Boards of a solved calibration: found again in their file, and where they are."""

from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.boards.board_poses import board_poses
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.boards.detection import Board
from evercal.calibration.calibration import Calibration
from evercal.geometry import SE3, Camera
from evercal.reports.board_views import board_scene, boards_seen, contributions, estimates

CAMERA = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)
BOARD = Board("chessboard", 0.03, 3, 3)
POINTS = np.array([[x, y, 0] for y in range(3) for x in range(3)]) * 0.03
POSE = SE3.from_translation([0.01, 0.02, 0.5])


def solved(folder: Path, **checks: object) -> Calibration:
    """A calibration with one image, whose board is stated 2 % too large."""
    view = BoardView(1.02 * POINTS, CAMERA.project(POSE.apply(POINTS)))
    views = {"images/a.png": view, "images/b.png": "no board"}
    board_poses(BOARD, CAMERA, views).write(folder / "board.json")
    pose = {"translation_m": [0.01, 0.02, 0.5], "quaternion_wxyz": [1, 0, 0, 0]}
    data = {
        "camera_from_board": {"images/a.png": pose},
        "base_from_board": pose,
        "scale": 1 / 1.02,
        **checks,
    }
    return Calibration(
        "eye_in_hand",
        SE3.identity(),
        1e-6 * np.eye(6),
        parent_frame="gripper",
        camera=CAMERA,
        checks=data,
        source={"command": "solve", "camera_poses": "board.json"},
    )


def test_corners_are_projected_with_the_estimated_size(tmp_path: Path) -> None:
    seen = boards_seen(solved(tmp_path), tmp_path)
    assert list(seen) == ["images/a.png"]
    item = seen["images/a.png"]
    assert item.projected(CAMERA) == pytest.approx(item.view.pixels, abs=1e-9)


def test_other_calibrations_have_no_boards(tmp_path: Path) -> None:
    calibration = solved(tmp_path)
    assert boards_seen(calibration, tmp_path / "elsewhere") == {}
    (tmp_path / "board.json").write_text("0 0 0 0 0 0 1")
    assert boards_seen(calibration, tmp_path) == {}


def test_board_and_cameras_are_drawn(tmp_path: Path) -> None:
    calibration = solved(tmp_path)
    picture = board_scene(calibration, boards_seen(calibration, tmp_path))
    assert picture is not None
    assert picture.kind == "png"
    assert board_scene(calibration, {}) is None


def test_estimates_and_contributions_are_tables(tmp_path: Path) -> None:
    calibration = solved(
        tmp_path,
        scale_sigma=0.001,
        camera_sigma={"fx": 0.5},
        information_percent={"images/a.png": 30.0, "images/c.png": 60.0},
        leave_one_out_mm={"images/a.png": 0.2, "images/c.png": 0.1},
    )
    table = estimates(calibration)
    assert table is not None
    assert table.rows[0] == ("fx (px)", "600.00", "0.50")
    assert table.rows[1][1:] == ("0.98039", "0.00100")
    shares = contributions(calibration)
    assert shares is not None
    assert [row[0] for row in shares.rows] == ["c.png", "a.png"]
    bare = Calibration("eye_to_hand", SE3.identity(), np.eye(6))
    assert estimates(bare) is None
    assert contributions(bare) is None
