"""Boards in simulated photographs: corners, poses, intrinsics and the file."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.board_poses import BoardPoses, board_poses, read_board_poses
from evercal.calibration.boards.corners import (
    BoardView,
    board_pose,
    calibrate_camera,
    pixel_sigma,
)
from evercal.calibration.boards.detection import find_board
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_distance

from .printed import (
    BOARDS,
    CAMERA,
    CHARUCO,
    CHESSBOARD,
    TAG,
    grid,
    photographed,
    view_of,
)


def detect(board: Board, pose: SE3, seed: int = 0) -> BoardView:
    view = find_board(photographed(board, pose, seed), board)
    assert isinstance(view, BoardView), view
    return view


@pytest.mark.parametrize("board", BOARDS, ids=lambda b: b.kind)
def test_corners_and_poses_match_the_print(board: Board) -> None:
    errors = []
    for seed in range(3):
        pose = view_of(board, seed)
        view = detect(board, pose, seed)
        # The roll of the camera does not change the order of the corners.
        errors.append(view.pixels - CAMERA.project(pose.apply(view.points_m)))
        metres, radians = pose_distance(board_pose(view, CAMERA).camera_from_board, pose)
        assert metres < 0.0006
        assert np.rad2deg(radians) < 0.3
    error = np.concatenate(errors)
    assert np.abs(error.mean(0)).max() < 0.02  # a wrong pixel convention gives 0.5
    assert np.sqrt((error**2).mean()) < 0.1


def test_images_without_the_board_give_a_reason() -> None:
    grey, tag = np.full((480, 640, 3), 128, np.uint8), photographed(TAG, view_of(TAG, 1))
    chessboard = photographed(CHESSBOARD, view_of(CHESSBOARD, 0))
    part = "not 12x9 inner corners; show the whole board, or correct --size"
    for image, board, message in (
        (grey, CHESSBOARD, "no chessboard with 9x6 inner corners"),
        (grey, CHARUCO, "0 corners of the ChArUco board"),
        (grey, TAG, "no tag 3 of APRILTAG_36h11"),
        (tag, replace(TAG, tag=4), "it shows 3"),
        (chessboard, Board("chessboard", 0.03, 12, 9), part),
    ):
        reason = find_board(image, board)
        assert isinstance(reason, str)
        assert message in reason


@pytest.mark.parametrize(
    ("create", "message"),
    [
        (lambda: Board("chessboard", 0.03), "size of 3x3 to 200x200"),
        (lambda: Board("chessboard", 0.0, 9, 6), "allowed are 0.5 to 2000 mm"),
        (lambda: Board("charuco", 0.03, 5, 7, 0.04, "4X4_50"), "markers of a ChArUco board"),
        (lambda: Board("apriltag", 0.03, dictionary="36h11"), "dictionary '36h11' is not known"),
    ],
)
def test_invalid_boards_are_refused(create: Callable[[], Board], message: str) -> None:
    with pytest.raises(InputError, match=message):
        create()


def test_only_chessboards_of_even_sum_look_the_same_after_half_a_turn() -> None:
    assert not CHESSBOARD.half_turn
    assert Board("chessboard", 0.03, 8, 6).half_turn
    assert Board("chessboard", 0.03, 9, 7).half_turn
    assert not CHARUCO.half_turn
    assert Board("chessboard", 0.03, 7, 7).quarter_turn
    assert not Board("chessboard", 0.03, 9, 7).quarter_turn


def simulated(
    count: int, noise_px: float = 0.2, camera: Camera = CAMERA
) -> tuple[list[BoardView], list[SE3]]:
    """Return views with projected corners, and their poses."""
    rng, points = np.random.default_rng(0), grid(9, 6)
    poses = [view_of(CHESSBOARD, seed) for seed in range(count)]
    pixels = [camera.project(p.apply(points)) + rng.normal(0, noise_px, (54, 2)) for p in poses]
    return [BoardView(points, p) for p in pixels], poses


def test_covariance_of_a_pose_matches_repeated_views() -> None:
    pose, points = view_of(CHESSBOARD, 0), grid(9, 6)
    rng = np.random.default_rng(1)
    exact = CAMERA.project(pose.apply(points))
    errors = []
    for _ in range(250):
        noisy = BoardView(points, exact + rng.normal(0, 0.3, exact.shape))
        estimate = board_pose(noisy, CAMERA, pose).camera_from_board
        rotation = (pose.inverse() @ estimate).log()[3:]
        errors.append([*(estimate.translation_m - pose.translation_m), *rotation])
    expected = 0.3**2 * board_pose(BoardView(points, exact), CAMERA, pose).unit_covariance
    sampled = np.cov(np.array(errors).T)
    sigma = np.sqrt(np.diag(expected))
    assert np.sqrt(np.diag(sampled)) == pytest.approx(sigma, rel=0.15)
    correlation = expected / np.outer(sigma, sigma)
    assert sampled / np.outer(sigma, sigma) == pytest.approx(correlation, abs=0.25)


def test_pixel_noise_is_estimated_from_all_images() -> None:
    views, poses = simulated(10, 0.25)
    fitted = [board_pose(view, CAMERA, pose) for view, pose in zip(views, poses, strict=True)]
    assert pixel_sigma(fitted) == pytest.approx(0.25, rel=0.1)
    outlier = replace(fitted[0], residual_px=fitted[0].residual_px + 10)
    assert pixel_sigma([outlier, *fitted[1:]]) == pytest.approx(0.25, rel=0.1)


def test_the_best_candidate_of_a_tag_is_returned_even_if_it_faces_the_camera() -> None:
    points = TAG.size_m / 2 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    facing = SE3.exp([0, 0, 0, 0, 0, -0.9]) @ SE3.exp([0, 0, 0, np.pi, 0, 0])
    poses = [view_of(TAG, 2), SE3.from_translation(np.array([-0.09, 0.07, 0.32])) @ facing]
    for pose in poses:
        view = BoardView(points, CAMERA.project(pose.apply(points)))
        metres, radians = pose_distance(board_pose(view, CAMERA).camera_from_board, pose)
        assert metres < 1e-5
        assert radians < 1e-3


@pytest.mark.parametrize("k1", [0.0, -0.2])
def test_intrinsics_are_estimated(k1: float) -> None:
    truth = replace(CAMERA, distortion=(k1, -0.4 * k1, 0.0, 0.0))
    camera, sigma = calibrate_camera(simulated(15, 0.1, truth)[0], 640, 480)
    assert camera.distortion[0] == pytest.approx(k1, abs=0.05)
    assert camera.fx == pytest.approx(600, abs=4 * sigma + 0.5)
    assert camera.fy == pytest.approx(602, abs=4 * sigma + 0.5)
    assert (camera.cx, camera.cy) == pytest.approx((318, 242), abs=2)
    assert 0.1 < sigma < 5


def test_false_detections_do_not_count() -> None:
    views, _ = simulated(10, 0.1)
    plain, rng = calibrate_camera(views, 640, 480).camera, np.random.default_rng(0)
    for _ in range(2):
        false = BoardView(views[0].points_m, rng.uniform(0, 480, views[0].pixels.shape))
        found = calibrate_camera([*views, false], 640, 480).camera
        assert found.fx == pytest.approx(plain.fx, 0.01)
        with pytest.raises(InputError, match="those of a flat board"):
            calibrate_camera([*views[:4], false], 640, 480)


def test_intrinsics_require_five_tilted_views() -> None:
    with pytest.raises(InputError, match="detected in 3 images, intrinsics take at least 5"):
        calibrate_camera(simulated(3)[0], 640, 480)
    points, rng = grid(9, 6), np.random.default_rng(0)
    exact = CAMERA.project(points + np.array([-0.12, -0.075, 0.5]))
    frontal = [BoardView(points, exact + rng.normal(0, 0.2, (54, 2))) for _ in range(8)]
    with pytest.raises(InputError, match="leave the focal length open"):
        calibrate_camera(frontal, 640, 480)


def test_the_file_is_read_back(tmp_path: Path) -> None:
    views, poses = simulated(4)
    named = {f"image-{i}.png": view for i, view in enumerate(views)} | {"dark.png": "no board"}
    written = board_poses(CHESSBOARD, CAMERA, named)
    assert [image.name for image in written.images] == list(named)
    written.write(tmp_path / "board.json")
    read = read_board_poses(tmp_path / "board.json")
    assert read.to_dict() == written.to_dict()
    assert (read.board, read.camera, len(read.detected)) == (CHESSBOARD, CAMERA, 4)
    assert read.images[4].reason == "no board"
    for image, pose in zip(read.detected, poses, strict=True):
        assert image.camera_from_board is not None
        assert pose_distance(image.camera_from_board, pose)[0] < 0.002


def test_broken_files_are_refused(tmp_path: Path) -> None:
    good = board_poses(CHESSBOARD, CAMERA, {"a": simulated(1)[0][0]}).to_dict()
    file = tmp_path / "board.json"
    with pytest.raises(InputError, match="is missing; check the path"):
        read_board_poses(file)
    for change, message in (
        ({"format": "other"}, "'format' is not"),
        ({"version": 9}, "version 9"),
        ({"board": {"kind": "chessboard"}}, "'board' is invalid"),
        ({"images": [{"name": "a"}]}, "camera_from_board"),
        ({"images": [{**good["images"][0], "covariance": [1.0]}]}, "6x6"),
        ({"images": [{**good["images"][0], "pixels": [[1.0, 2.0]]}]}, "four corners or more"),
    ):
        file.write_text(json.dumps({**good, **change}))
        with pytest.raises(InputError, match=message):
            read_board_poses(file)
    with pytest.raises(ValueError, match="'format' is not"):
        BoardPoses.from_dict([])


def test_charuco_boards_of_older_opencv_are_detected() -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = Board("charuco", 0.04, 5, 6, 0.03, "4X4_50")  # patterns differ for even rows
    page = cv2.aruco.CharucoBoard((5, 6), 0.04, 0.03, dictionary)
    page.setLegacyPattern(True)
    image = page.generateImage((600, 720), marginSize=40)
    view = find_board(np.repeat(image[..., None], 3, 2).astype(np.uint8), board)
    assert isinstance(view, BoardView)
    assert len(view.points_m) == 20


def test_every_window_of_refinement_stays_between_edges() -> None:
    # A strongly tilted board: rows are 3 times closer than columns.
    rotation = Rotation.from_euler("x", 65, degrees=True).as_quat(scalar_first=True)
    pose = SE3(rotation, np.array([-0.12, -0.03, 0.5]))
    view = detect(CHESSBOARD, pose)
    error = view.pixels - CAMERA.project(pose.apply(view.points_m))
    assert np.sqrt((error**2).mean()) < 0.06
