"""Poses of a board and intrinsics from its corners, and their file."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.boards.board_poses import (
    BoardPoses,
    board_poses,
    read_board_poses,
)
from evercal.calibration.boards.corners import BoardView, board_pose
from evercal.calibration.boards.intrinsics import calibrate_camera
from evercal.calibration.boards.row_shift import CornerNoise
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_distance

from .printed import CAMERA, CHESSBOARD, TAG, grid, view_of


def simulated(
    count: int, noise_px: float = 0.2, camera: Camera = CAMERA
) -> tuple[list[BoardView], list[SE3]]:
    """Return views with projected corners, and their poses."""
    rng = np.random.default_rng(0)
    points = grid(9, 6)
    poses = [view_of(CHESSBOARD, seed) for seed in range(count)]
    pixels = [
        camera.project(p.apply(points)) + rng.normal(0, noise_px, (54, 2))
        for p in poses
    ]
    return [BoardView(points, p) for p in pixels], poses


def test_covariance_of_a_pose_matches_repeated_views() -> None:
    pose = view_of(CHESSBOARD, 0)
    points = grid(9, 6)
    rng = np.random.default_rng(1)
    exact = CAMERA.project(pose.apply(points))
    errors = []
    for _ in range(250):
        noisy = BoardView(points, exact + rng.normal(0, 0.3, exact.shape))
        estimate = board_pose(noisy, CAMERA, pose).camera_from_board
        rotation = (pose.inverse() @ estimate).log()[3:]
        errors.append([*(estimate.translation_m - pose.translation_m), *rotation])
    expected = (
        0.3**2 * board_pose(BoardView(points, exact), CAMERA, pose).unit_covariance
    )
    sampled = np.cov(np.array(errors).T)
    sigma = np.sqrt(np.diag(expected))
    assert np.sqrt(np.diag(sampled)) == pytest.approx(sigma, rel=0.15)
    correlation = expected / np.outer(sigma, sigma)
    assert sampled / np.outer(sigma, sigma) == pytest.approx(correlation, abs=0.25)


def test_pixel_noise_is_estimated_from_all_images() -> None:
    views, poses = simulated(10, 0.25)
    fitted = [
        board_pose(view, CAMERA, pose) for view, pose in zip(views, poses, strict=True)
    ]
    assert CornerNoise.plain(fitted).sigma_px == pytest.approx(0.25, rel=0.1)
    outlier = replace(fitted[0], residual_px=fitted[0].residual_px + 10)
    assert CornerNoise.plain([outlier, *fitted[1:]]).sigma_px == pytest.approx(
        0.25, rel=0.1
    )


def test_the_best_candidate_of_a_tag_is_returned_even_if_it_faces_the_camera() -> None:
    points = TAG.size_m / 2 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    facing = SE3.exp([0, 0, 0, 0, 0, -0.9]) @ SE3.exp([0, 0, 0, np.pi, 0, 0])
    poses = [
        view_of(TAG, 2),
        SE3.from_translation(np.array([-0.09, 0.07, 0.32])) @ facing,
    ]
    for pose in poses:
        view = BoardView(points, CAMERA.project(pose.apply(points)))
        metres, radians = pose_distance(
            board_pose(view, CAMERA).camera_from_board, pose
        )
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
    plain = calibrate_camera(views, 640, 480).camera
    rng = np.random.default_rng(0)
    for _ in range(2):
        false = BoardView(views[0].points_m, rng.uniform(0, 480, views[0].pixels.shape))
        found = calibrate_camera([*views, false], 640, 480).camera
        assert found.fx == pytest.approx(plain.fx, 0.01)
        with pytest.raises(InputError, match="those of a flat board"):
            calibrate_camera([*views[:4], false], 640, 480)


def test_intrinsics_require_five_tilted_views() -> None:
    with pytest.raises(
        InputError, match="detected in 3 images, intrinsics take at least 5"
    ):
        calibrate_camera(simulated(3)[0], 640, 480)
    points = grid(9, 6)
    rng = np.random.default_rng(0)
    exact = CAMERA.project(points + np.array([-0.12, -0.075, 0.5]))
    frontal = [BoardView(points, exact + rng.normal(0, 0.2, (54, 2))) for _ in range(8)]
    with pytest.raises(InputError, match="leave the focal length open"):
        calibrate_camera(frontal, 640, 480)


def test_the_file_is_read_back(tmp_path: Path) -> None:
    views, poses = simulated(4)
    named = {f"image-{i}.png": view for i, view in enumerate(views)} | {
        "dark.png": "no board"
    }
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
        (
            {"images": [{**good["images"][0], "pixels": [[1.0, 2.0]]}]},
            "four corners or more",
        ),
    ):
        file.write_text(json.dumps({**good, **change}))
        with pytest.raises(InputError, match=message):
            read_board_poses(file)
    with pytest.raises(ValueError, match="'format' is not"):
        BoardPoses.from_dict([])
