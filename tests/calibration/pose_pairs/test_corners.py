"""Cameras calibrated from pose pairs and the corners of a board."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.board_recordings import (
    BoardRecording,
    BoardSetting,
    corner_pairs,
    project,
    record,
)
from benchmarks.hand_eye import error
from evercal.calibration.boards.board import Board
from evercal.calibration.boards.board_poses import board_poses
from evercal.calibration.boards.corners import BoardView, board_pose
from evercal.calibration.calibration import Calibration
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.solve import BoardCorners, solve
from evercal.geometry import SE3, Camera
from evercal.robot.mount import MountName

from ..boards.printed import grid
from .test_solve import largest_error


class Photographed(NamedTuple):
    """A simulated recording of a chessboard."""

    pairs: PosePairs
    parent_from_camera: SE3
    camera: Camera

    def views(
        self, points: np.ndarray, noise_px: float, seed: int
    ) -> tuple[BoardView, ...]:
        rng = np.random.default_rng(seed)
        exact = [
            self.camera.project(pose.apply(points))
            for pose in self.pairs.camera_from_board
        ]
        return tuple(
            BoardView(points, p + rng.normal(0, noise_px, p.shape)) for p in exact
        )


def photographed(mount: MountName, seed: int, robot_deg: float = 0.0) -> Photographed:
    """Simulate exact camera poses, and robot poses with rotation noise."""
    rng = np.random.default_rng(seed)
    camera = Camera(1280, 960, 1000, 1000, 640, 480, (-0.1, 0.05, 0.001, 0.0))
    n = 20
    rotation = Rotation.from_rotvec(rng.normal(0, 0.35, (n, 3)))
    centre = rotation.apply(np.tile([0.12, 0.075, 0], (n, 1)))
    translation = np.array([0, 0, 0.6]) + rng.normal(0, 0.06, (n, 3)) - centre
    board = SE3(rotation.as_quat(scalar_first=True), translation)
    parent_from_camera = SE3.exp([0.05, -0.1, 0.08, 0.3, 0.2, -1.5])
    robot = (
        SE3.exp([0.5, 0.1, 0.2, 2.0, 1.0, 0.1]) @ (parent_from_camera @ board).inverse()
    )
    robot = robot if mount == "eye_in_hand" else robot.inverse()
    noise = rng.normal(0, np.deg2rad(robot_deg) + 1e-12, (n, 3))
    robot = robot @ SE3.exp(np.concatenate([np.zeros((n, 3)), noise], 1))
    pairs = PosePairs(tuple(f"{i}.png" for i in range(n)), robot, board)
    return Photographed(pairs, parent_from_camera, camera)


@pytest.mark.parametrize(
    ("mount", "noise_px", "robot_deg"),
    [("eye_in_hand", 0.3, 0.0), ("eye_to_hand", 0.1, 0.1)],
)
def test_corners_improve_the_calibration(
    mount: MountName, noise_px: float, robot_deg: float
) -> None:
    distances = []
    with_corners = []
    without = []
    for seed in range(4):
        truth = photographed(mount, seed, robot_deg)
        views = truth.views(grid(9, 6), noise_px, seed)
        # Inaccurate board poses are refitted to the corners.
        rng = np.random.default_rng(seed)
        board = truth.pairs.camera_from_board @ SE3.exp(rng.normal(0, 0.003, (20, 6)))
        pairs = replace(truth.pairs, camera_from_board=board)
        calibration = solve(pairs, mount, corners=BoardCorners(truth.camera, views))
        difference = error(calibration.parent_from_child, truth.parent_from_camera)
        distances.append(
            difference @ np.linalg.solve(calibration.covariance, difference)
        )
        with_corners.append(np.linalg.norm(difference[:3]))
        assert calibration.checks.to_dict()["corner_sigma_px"] == pytest.approx(
            noise_px, rel=0.1
        )
        assert calibration.camera is not None
        assert calibration.camera.fx == pytest.approx(truth.camera.fx, rel=2e-3)
        plain = solve(pairs, mount).parent_from_child
        without.append(np.linalg.norm(error(plain, truth.parent_from_camera)[:3]))
    assert np.median(distances) < 11
    assert np.median(with_corners) < 0.5 * np.median(without)


def test_a_stray_corner_is_named_and_moves_nothing() -> None:
    drawn = record(BoardSetting(noise_px=0.02), 3)
    clean, [*views] = solve_with_corners(drawn), drawn.views
    for i in (2, 7):
        pixels = views[i].pixels.copy()
        pixels[53] += (0.9, 1.2)
        views[i] = replace(views[i], pixels=pixels)
    spoiled = replace(drawn, views=tuple(views))
    assert (
        clean.uncertain_pose.squared_mahalanobis(
            solve_with_corners(spoiled).parent_from_child
        )
        < 0.2
    )
    found = board_poses(
        Board("chessboard", 0.025, 9, 6),
        drawn.camera,
        dict(zip("abcdefghij", views, strict=False)),
    )
    left_out = {image.name: image.left_out for image in found.images if image.left_out}
    assert left_out == {
        name: (tuple(views[i].pixels[53]),) for name, i in (("c", 2), ("h", 7))
    }


def solve_with_corners(drawn: BoardRecording) -> Calibration:
    pairs, corners = corner_pairs(drawn)
    return solve(pairs, "eye_in_hand", corners=corners)


@pytest.mark.parametrize("bend_m", [0.0, 0.002])
def test_a_bent_board_is_no_worse_than_a_flat_one(bend_m: float) -> None:
    distances = []
    for seed in range(6):
        drawn = record(BoardSetting(square_m=0.04), seed)
        x, y = ((drawn.views[0].points_m - drawn.views[0].points_m.mean(0)) / 0.16).T[
            :2
        ]
        bent = drawn.views[0].points_m + np.outer(
            bend_m * (x**2 - 0.4 * x * y), [0, 0, 1]
        )
        rng = np.random.default_rng(seed)
        views = tuple(
            BoardView(
                view.points_m,
                project(bent, pose, drawn.camera) + rng.normal(0, 0.1, (54, 2)),
            )
            for view, pose in zip(drawn.views, drawn.camera_from_board, strict=True)
        )
        found = solve_with_corners(replace(drawn, views=views))
        distances.append(
            found.uncertain_pose.squared_mahalanobis(drawn.parent_from_camera)
        )
        assert found.camera is not None
        sigma = found.checks.to_dict()["camera_sigma"]["fx"]
        assert abs(found.camera.fx - drawn.camera.fx) < 4 * sigma
    assert np.mean(distances) < 10


@pytest.mark.parametrize("size", [(8, 6), (7, 7), (8, 8)])
def test_turned_corners_of_a_symmetric_board_are_corrected(
    size: tuple[int, int],
) -> None:
    truth = photographed("eye_in_hand", 1)
    points = grid(*size)
    square = size[0] == size[1]
    views = list(truth.views(points, 0.0, 0))
    poses = [board_pose(view, truth.camera).camera_from_board for view in views]
    indices = np.arange(len(points)).reshape(size[::-1])
    for i in range(1, len(views), 3):
        order = np.rot90(indices, 1 + i % 3 if square else 2).ravel()
        views[i] = BoardView(points, views[i].pixels[order])
        poses[i] = board_pose(views[i], truth.camera).camera_from_board
    pairs = replace(truth.pairs, camera_from_board=SE3.stack(poses))
    corners = BoardCorners(
        truth.camera, tuple(views), half_turn=not square, quarter_turn=square
    )
    calibration = solve(pairs, "eye_in_hand", corners=corners)
    assert all(image.used for image in calibration.images)
    assert largest_error(calibration, truth.parent_from_camera) < 1e-4


@pytest.mark.parametrize(("factor", "warned"), [(1.0, False), (1.05, True)])
def test_a_stated_focal_length_is_compared_with_the_corners(
    factor: float, warned: bool
) -> None:
    pairs, corners = corner_pairs(record(BoardSetting(), 3))
    camera = corners.camera
    stated = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
    solved = solve(
        pairs, "eye_in_hand", corners=replace(corners, camera=stated, stated=True)
    )
    warnings = solved.checks.to_dict().get("warnings", ())
    assert any("stated focal length" in words for words in warnings) == warned


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_a_rough_lens_leads_to_the_same_calibration(factor: float) -> None:
    """The intrinsics are fitted until they no longer change."""
    pairs, corners = corner_pairs(record(BoardSetting(), 4))
    camera = corners.camera
    rough = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
    near = solve(pairs, "eye_in_hand", corners=corners)
    far = solve(pairs, "eye_in_hand", corners=replace(corners, camera=rough))
    assert near.camera is not None
    assert far.camera is not None
    sigma = near.checks.to_dict()["camera_sigma"]["fx"]
    assert abs(far.camera.fx - near.camera.fx) < 0.3 * sigma
    assert near.uncertain_pose.squared_mahalanobis(far.parent_from_child) < 0.5
    assert far.sigma_mm == pytest.approx(near.sigma_mm, rel=0.1)


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
def test_corners_of_images_with_wrong_robot_poses_are_left_out(
    mount: MountName,
) -> None:
    drawn = record(BoardSetting(mount, outliers=3), 5)
    pairs, corners = corner_pairs(drawn)
    # A repeated image adds nothing.
    rows = np.r_[np.arange(20), 0]
    names = (*pairs.names, "again.png")
    repeated = replace(pairs[rows], names=names)
    views = replace(corners, views=(*corners.views, corners.views[0]))
    found = solve(repeated, mount, corners=views)
    rejected = {i for i, image in enumerate(found.images[:20]) if not image.used}
    assert rejected == {*drawn.spoiled}
    assert not found.images[20].used
    distance = found.uncertain_pose.squared_mahalanobis(drawn.parent_from_camera)
    assert distance < 16.8
