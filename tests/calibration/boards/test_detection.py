"""Boards in images: corners and poses of photographed prints, intrinsics, and the file."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from evercal.calibration.boards.board_poses import BoardPoses, board_poses, read_board_poses
from evercal.calibration.boards.corners import (
    BoardView,
    board_pose,
    board_pose_candidates,
    pixel_sigma,
)
from evercal.calibration.boards.detection import Board, find_board
from evercal.calibration.boards.intrinsics import calibrate_camera
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_distance

from .printed import CAMERA, CHARUCO, CHESSBOARD, TAG, photographed, view_of


def found(board: Board, pose: SE3, seed: int = 0) -> BoardView:
    view = find_board(photographed(board, pose, seed), board)
    assert isinstance(view, BoardView), view
    return view


@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO, TAG], ids=lambda b: b.kind)
def test_corners_and_poses_are_those_of_the_print(board: Board) -> None:
    errors = []
    for seed in range(5):
        pose = view_of(board, seed)
        view = found(board, pose, seed)
        # The first corner is the first corner, however the camera is rolled.
        errors.append(view.pixels - CAMERA.project(pose.apply(view.points_m)))
        metres, radians = pose_distance(board_pose(view, CAMERA).camera_from_board, pose)
        assert metres < 0.0006
        assert np.rad2deg(radians) < 0.3
    error = np.concatenate(errors)
    assert np.abs(error.mean(0)).max() < 0.02  # half a pixel would be a wrong convention
    assert np.sqrt((error**2).mean()) < 0.1


def test_pictures_without_a_board_say_so() -> None:
    grey = np.full((480, 640, 3), 128, np.uint8)
    for board, words in (
        (CHESSBOARD, "no chessboard with 9x6 inner corners"),
        (CHARUCO, "0 corners of the ChArUco board"),
        (TAG, "no tag 3 of APRILTAG_36h11"),
    ):
        reason = find_board(grey, board)
        assert isinstance(reason, str)
        assert words in reason
    other = find_board(photographed(TAG, view_of(TAG, 1)), replace(TAG, tag=4))
    assert isinstance(other, str)
    assert "it shows 3" in other


def test_boards_that_cannot_be_are_refused() -> None:
    for wrong, words in (
        (lambda: Board("chessboard", 0.03), "size of 3x3 or more"),
        (lambda: Board("chessboard", 0.0, 9, 6), "between 0 and 10 m"),
        (lambda: Board("charuco", 0.03, 5, 7, 0.04, "4X4_50"), "markers of a ChArUco board"),
        (lambda: Board("apriltag", 0.03, dictionary="36h11"), "dictionary '36h11' is not known"),
    ):
        with pytest.raises(InputError, match=words):
            wrong()


def test_only_boards_of_two_even_or_two_odd_sides_look_alike_turned() -> None:
    assert not CHESSBOARD.half_turn
    assert Board("chessboard", 0.03, 8, 6).half_turn
    assert Board("chessboard", 0.03, 9, 7).half_turn
    assert not CHARUCO.half_turn


def views(count: int, noise_px: float = 0.2) -> tuple[list[BoardView], list[SE3]]:
    """Corners by projection, without images."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(9), np.arange(6))
    points = 0.03 * np.stack([x, y, 0 * x], -1).reshape(-1, 3).astype(float)
    poses = [view_of(CHESSBOARD, seed) for seed in range(count)]
    return [
        BoardView(points, CAMERA.project(p.apply(points)) + rng.normal(0, noise_px, (54, 2)))
        for p in poses
    ], poses


def test_covariance_of_a_pose_is_that_of_repeated_views() -> None:
    _, (pose,) = views(1)
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.arange(9), np.arange(6))
    points = 0.03 * np.stack([x, y, 0 * x], -1).reshape(-1, 3).astype(float)
    exact = CAMERA.project(pose.apply(points))
    errors = []
    for _ in range(400):
        seen = board_pose(BoardView(points, exact + rng.normal(0, 0.3, exact.shape)), CAMERA, pose)
        turn = (pose.inverse() @ seen.camera_from_board).log()[3:]
        errors.append([*(seen.camera_from_board.translation_m - pose.translation_m), *turn])
    expected = 0.3**2 * board_pose(BoardView(points, exact), CAMERA, pose).unit_covariance
    sampled = np.cov(np.array(errors).T)
    size = np.sqrt(np.diag(expected))
    assert np.sqrt(np.diag(sampled)) == pytest.approx(size, rel=0.15)
    correlation = expected / np.outer(size, size)
    assert sampled / np.outer(size, size) == pytest.approx(correlation, abs=0.25)


def test_pixel_noise_is_found_from_all_images() -> None:
    seen, poses = views(10, 0.25)
    fitted = [board_pose(view, CAMERA, pose) for view, pose in zip(seen, poses, strict=True)]
    assert pixel_sigma(fitted) == pytest.approx(0.25, rel=0.1)
    spoiled = replace(fitted[0], squared_px=1e4)
    assert pixel_sigma([spoiled, *fitted[1:]]) == pytest.approx(0.25, rel=0.1)


def test_a_flat_board_has_two_poses_and_the_better_one_is_taken() -> None:
    pose = view_of(TAG, 2)
    points = found(TAG, pose).points_m
    view = BoardView(points, CAMERA.project(pose.apply(points)))
    starts = board_pose_candidates(view, CAMERA)
    assert len(starts) == 2
    metres, radians = pose_distance(board_pose(view, CAMERA).camera_from_board, pose)
    assert metres < 1e-5
    assert radians < 1e-3
    # From the other one the fit may end beside it: a start decides.
    assert board_pose(view, CAMERA, pose).squared_px < 1e-6


def test_intrinsics_are_found() -> None:
    lens = Camera(640, 480, 600, 602, 318, 242, (-0.2, 0.08, 0.0, 0.0))
    seen, poses = views(15, 0.1)
    rng = np.random.default_rng(2)
    plain = calibrate_camera(seen, 640, 480)
    assert plain.camera.distortion == ()  # no more of a lens than the views support
    assert plain.camera.fx == pytest.approx(600, abs=4 * plain.focal_sigma_px + 0.5)
    assert plain.camera.fy == pytest.approx(602, abs=4 * plain.focal_sigma_px + 0.5)
    assert (plain.camera.cx, plain.camera.cy) == pytest.approx((318, 242), abs=2)
    points = seen[0].points_m
    bent = [
        BoardView(points, lens.project(p.apply(points)) + rng.normal(0, 0.1, (54, 2)))
        for p in poses
    ]
    curved = calibrate_camera(bent, 640, 480)
    assert curved.camera.distortion[0] == pytest.approx(-0.2, abs=0.05)
    assert curved.rms_px == pytest.approx(0.1 * np.sqrt(2), rel=0.1)


def test_intrinsics_take_tilted_views() -> None:
    seen, _ = views(3)
    with pytest.raises(InputError, match="found in 3 images, intrinsics take at least 5"):
        calibrate_camera(seen, 640, 480)
    points = seen[0].points_m
    frontal = [
        BoardView(
            points,
            CAMERA.project(points + np.array([-0.12, -0.075, 0.5]))
            + np.random.default_rng(i).normal(0, 0.2, (54, 2)),
        )
        for i in range(8)
    ]
    with pytest.raises(InputError, match="leave the focal length open"):
        calibrate_camera(frontal, 640, 480)


def test_the_file_says_what_was_found(tmp_path: Path) -> None:
    seen, poses = views(4)
    named = {f"image-{i}.png": view for i, view in enumerate(seen)} | {"dark.png": "no board in it"}
    made = board_poses(CHESSBOARD, CAMERA, named)
    assert [image.name for image in made.images] == list(named)
    assert len(made.found) == 4
    made.write(tmp_path / "board.json")
    again = read_board_poses(tmp_path / "board.json")
    assert (again.board, again.camera) == (CHESSBOARD, CAMERA)
    assert again.images[4].reason == "no board in it"
    for image, pose in zip(again.found, poses, strict=True):
        assert image.camera_from_board is not None
        assert image.view is not None
        metres, _ = pose_distance(image.camera_from_board, pose)
        assert metres < 0.002
        assert image.view.pixels.shape == (54, 2)
    assert again.to_dict() == made.to_dict()


def test_broken_files_are_named(tmp_path: Path) -> None:
    seen, _ = views(1)
    good = board_poses(CHESSBOARD, CAMERA, {"a": seen[0]}).to_dict()
    file = tmp_path / "board.json"
    with pytest.raises(InputError, match="is missing; check the path"):
        read_board_poses(file)
    for change, words in (
        ({"format": "other"}, "no board poses"),
        ({"version": 9}, "version 9"),
        ({"board": {"kind": "chessboard"}}, "'board' is no board"),
        ({"images": [{"name": "a"}]}, "camera_from_board"),
        ({"images": [{**good["images"][0], "covariance": [1.0]}]}, "6x6"),
        ({"images": [{**good["images"][0], "pixels": [[1.0, 2.0]]}]}, "four corners or more"),
    ):
        file.write_text(json.dumps({**good, **change}))
        with pytest.raises(InputError, match=words):
            read_board_poses(file)
    with pytest.raises(ValueError, match="no board poses"):
        BoardPoses.from_dict([])


def test_charuco_boards_of_older_opencv_are_read() -> None:
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    old = Board("charuco", 0.04, 5, 6, 0.03, "4X4_50")  # an even number of rows: patterns differ
    page = cv2.aruco.CharucoBoard((5, 6), 0.04, 0.03, words)
    page.setLegacyPattern(True)
    image = page.generateImage((600, 720), marginSize=40)
    view = find_board(np.repeat(image[..., None], 3, 2).astype(np.uint8), old)
    assert isinstance(view, BoardView)
    assert len(view.points_m) == 20
