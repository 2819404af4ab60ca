"""Grids of circles in simulated photographs."""

import cv2
import numpy as np
import pytest

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.circles import circle_points
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.boards.detection import find_board
from evercal.calibration.boards.printing import board_image
from evercal.geometry import SE3

from .tagged import CAMERA, around

GRIDS = [
    (Board("circles", 0.03, 7, 6, 0.02), False),
    (Board("circles", 0.03, 5, 4, 0.015), True),
    (Board("circles", 0.02, 7, 7, 0.01), False),
    (Board("acircles", 0.02, 4, 11, 0.016), False),
    (Board("acircles", 0.02, 4, 9, 0.018), True),
    (Board("acircles", 0.02, 5, 10, 0.014), False),
]
_PER_METRE = 4000


def view_of(board: Board, seed: int) -> SE3:
    """Camera from board, seen from above and tilted."""
    middle = circle_points(board).mean(0)
    (pose,) = around(1, np.zeros(3), seed, 45, 0.45)
    over = SE3.exp([0, 0, 0, np.pi, 0, 0])
    return pose @ over @ SE3.from_translation(-middle)


def photographed(board: Board, pose: SE3, bright: bool) -> np.ndarray:
    image = board_image(board, round(board.size_m * _PER_METRE))
    if bright:
        image = 255 - image
    image = image // 255 * 210 + 20
    start = board.size_m * _PER_METRE - 0.5
    to_print = np.array([[_PER_METRE, 0, start], [0, _PER_METRE, start], [0, 0, 1.0]])
    rotation = pose.rotation_matrix()
    plane = np.column_stack([rotation[:, 0], rotation[:, 1], pose.translation_m])
    finer = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1.0]])
    whole = finer @ CAMERA.matrix() @ plane @ np.linalg.inv(to_print)
    size = (2 * CAMERA.width, 2 * CAMERA.height)
    large = cv2.warpPerspective(image.astype(np.uint8), whole, size, borderValue=180)
    small = cv2.resize(large, CAMERA.size, interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), 0.6).astype(float)
    small += np.random.default_rng(0).normal(0, 2, small.shape)
    return np.repeat(np.clip(small, 0, 255).astype(np.uint8)[..., None], 3, 2)


@pytest.mark.parametrize(("board", "bright"), GRIDS)
@pytest.mark.parametrize("seed", [1])
def test_centres_of_circles_are_not_moved_by_perspective(
    board: Board, bright: bool, seed: int
) -> None:
    pose = view_of(board, seed)
    view = find_board(photographed(board, pose, bright), board)
    assert isinstance(view, BoardView), view
    pixels = CAMERA.project(pose.apply(view.points_m))
    apart = np.linalg.norm(view.pixels[:, None] - pixels, axis=2)
    assert np.sqrt((apart.min(1) ** 2).mean() / 2) < 0.04
    order = apart.argmin(1)
    count = len(order)
    orders = [np.arange(count)]
    if board.half_turn:
        orders.append(orders[0][::-1])
    if board.quarter_turn:
        square = np.arange(count).reshape(board.rows, board.columns)
        orders += [np.rot90(square).ravel(), np.rot90(square, 3).ravel()]
    assert any((order == own).all() for own in orders)


def test_turns_that_a_grid_leaves_open() -> None:
    turns = [(board.half_turn, board.quarter_turn) for board, _ in GRIDS]
    assert turns == [
        (True, False),
        (True, False),
        (True, True),
        (False, False),
        (False, False),
        (True, False),
    ]


def test_an_image_without_circles_has_a_reason() -> None:
    grey = np.full((480, 640, 3), 128, np.uint8)
    reason = find_board(grey, GRIDS[0][0])
    assert isinstance(reason, str)
    assert "no grid of 7x6 circles" in reason
