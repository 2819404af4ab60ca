"""Errors that the corners of an image share: shutter, print and stated intrinsics."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.board_errors import NAMED, spoiled_pairs
from evercal.calibration.boards.board import Board
from evercal.calibration.boards.board_poses import board_poses
from evercal.calibration.boards.corners import BoardView, board_pose, strays
from evercal.calibration.boards.row_shift import CornerNoise
from evercal.calibration.boards.stated_lens import compared_lens
from evercal.calibration.pose_pairs.solve import solve
from evercal.geometry import pose_distance_mm_deg

CAUSES = (
    ("rolling shutter, px", 1.0),
    ("motion, px", 3.0),
    ("stretched print, %", 2.0),
    ("distortion left out, share", 1.0),
)


@pytest.mark.parametrize(("kind", "size"), CAUSES)
def test_errors_that_corners_share_are_named_and_allowed_for(
    kind: str, size: float
) -> None:
    recording, pairs, corners = spoiled_pairs(kind, size, seed=3)
    answer = solve(pairs, recording.setting.mount, corners=corners)
    truth = recording.parent_from_camera
    assert answer.uncertain_pose.squared_mahalanobis(truth) < 16.8
    assert pose_distance_mm_deg(answer.parent_from_child, truth)[0] < 1.0
    assert any(NAMED[kind] in words for words in answer.checks.warnings or ())


def test_exact_boards_are_not_accused() -> None:
    recording, pairs, corners = spoiled_pairs("none", 0.0, seed=4)
    answer = solve(pairs, recording.setting.mount, corners=corners)
    assert not answer.checks.warnings


def test_the_noise_is_told_from_shifts_with_the_row() -> None:
    for kind, px in (("none", 0.0), ("rolling shutter, px", 2.0)):
        recording, _, corners = spoiled_pairs(kind, px, seed=5)
        starts = recording.camera_from_board
        views = zip(corners.views, starts, strict=True)
        noise = CornerNoise.of([board_pose(v, recording.camera, s) for v, s in views])
        assert noise.sigma_px == pytest.approx(0.1, rel=0.1)
        # Uniform up to 2 px has a standard deviation of 1.15 px.
        assert noise.row_shift_px == pytest.approx(px / np.sqrt(3), abs=0.4)


def test_a_trend_over_the_board_is_no_reason_to_leave_corners_out() -> None:
    recording, _, corners = spoiled_pairs("none", 0.0, seed=6)
    views = []
    for view in corners.views:
        x, y = ((view.pixels - view.pixels.mean(0)) / 100).T
        trend = 0.5 * np.stack([x * y + x**3, y**3 - x**2], 1)
        views.append(BoardView(view.points_m, view.pixels + trend))
    views[2].pixels[20] += 4
    poses = [board_pose(view, recording.camera) for view in views]
    stray = strays(views, poses, recording.camera)
    assert [
        (i, np.flatnonzero(mask)) for i, mask in enumerate(stray) if mask.any()
    ] == [(2, [20])]


@pytest.mark.parametrize("wrong", [False, True])
def test_a_board_tells_a_wrong_camera_file(wrong: bool) -> None:
    recording, _, corners = spoiled_pairs("none", 0.0, seed=7)
    camera = recording.camera
    if wrong:
        camera = replace(camera, distortion=(0.0,) * 5)
    views = {str(i): view for i, view in enumerate(corners.views)}
    board = Board("chessboard", 0.025, 9, 6)
    poses, words = compared_lens(board_poses(board, camera, views))
    assert ("contradicts the camera file" in words) == wrong
    for image, truth in zip(poses.detected, recording.camera_from_board, strict=True):
        assert image.camera_from_board is not None
        assert image.covariance is not None
        away = image.camera_from_board.translation_m - truth.translation_m
        assert away @ np.linalg.solve(image.covariance[:3, :3], away) < 25
