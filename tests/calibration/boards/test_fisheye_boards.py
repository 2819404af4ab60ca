"""Boards before a fisheye: poses, intrinsics, and the mount that follows from them."""

import numpy as np
import pytest

from evercal.calibration.boards.corners import BoardView, board_pose
from evercal.calibration.boards.intrinsics import calibrate_camera
from evercal.calibration.pose_pairs.pairs import BoardCorners, PosePairs
from evercal.calibration.pose_pairs.solve import solve
from evercal.geometry import SE3, Camera, pose_distance_mm_deg
from evercal.simulation.box_room import look_at

LENS = Camera(
    640, 480, 245.0, 246.0, 322.0, 236.0, (0.03, -0.01, 0.004, -0.001), "fisheye"
)
GRID = (
    np.stack(np.meshgrid(np.arange(9), np.arange(7), [0.0]), -1).reshape(-1, 3) * 0.03
)


def views_of(
    camera: Camera, poses: SE3, noise_px: float, rng: np.random.Generator
) -> list[BoardView]:
    pixels = [camera.project(pose.apply(GRID)) for pose in poses]
    return [BoardView(GRID, p + rng.normal(0, noise_px, p.shape)) for p in pixels]


def cameras(count: int, rng: np.random.Generator) -> SE3:
    """board_from_camera of views that are tilted, some with the board at the edge."""
    poses = []
    middle = GRID.mean(0)
    for _ in range(count):
        side = rng.uniform(-0.15, 0.15, 2)
        eye = middle + np.r_[side, -rng.uniform(0.15, 0.3)]
        away = middle + np.r_[rng.uniform(-0.06, 0.06, 2), 0.0]
        poses.append(look_at(eye, away, rng.uniform(-3, 3)))
    return SE3.stack(poses)


def test_a_pose_through_a_fisheye_is_exact() -> None:
    rng = np.random.default_rng(0)
    for pose in cameras(10, rng).inverse():
        (view,) = views_of(LENS, SE3.stack([pose]), 0.0, rng)
        millimetres, degrees = pose_distance_mm_deg(
            board_pose(view, LENS).camera_from_board, pose
        )
        assert millimetres < 1e-4
        assert degrees < 1e-4


@pytest.mark.parametrize("seed", range(3))
def test_intrinsics_and_mount_of_a_fisheye_follow_from_a_board(seed: int) -> None:
    rng = np.random.default_rng(seed)
    board_from_camera = cameras(20, rng)
    views = views_of(LENS, board_from_camera.inverse(), 0.05, rng)
    estimated = calibrate_camera(views, 640, 480, "fisheye").camera
    assert estimated.model == "fisheye"
    x, y = np.meshgrid(np.linspace(120, 520, 9), np.linspace(80, 400, 7))
    pixels = np.stack([x, y], -1)
    off = estimated.project(LENS.unproject(pixels)) - pixels
    assert np.abs(off - off.mean((0, 1))).max() < 0.5
    mount = SE3.exp([0.03, -0.05, 0.08, 0.3, 1.0, -0.4])
    base_from_board = SE3.exp([0.6, 0, 0.1, 0, 0, 1])
    grippers = base_from_board @ board_from_camera @ mount.inverse()
    poses = SE3.stack([board_pose(view, estimated).camera_from_board for view in views])
    names = tuple(f"{i}.png" for i in range(20))
    corners = BoardCorners(estimated, tuple(views), stated=False)
    found = solve(PosePairs(names, grippers, poses), "eye_in_hand", corners=corners)
    assert found.camera is not None
    assert found.camera.model == "fisheye"
    millimetres, degrees = pose_distance_mm_deg(found.parent_from_child, mount)
    assert millimetres < 0.3
    assert degrees < 0.1
