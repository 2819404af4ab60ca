"""Detect grids of circles, with centres that perspective does not move."""

from itertools import product

import cv2
import numpy as np

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.corners import BoardView, Detection
from evercal.geometry import norms
from evercal.typing import Array, Image

_WINDOW = np.linspace(-0.5, 0.5, 33)
"""Samples around a circle, distances to the nearest one."""
_ROUNDS = 2
"""Rounds that move the centres."""
_LEVELS = (10, 90)
"""Percentiles of the brightness around a circle that are dark and bright."""
_EDGE = 0.25
"""Share of the contrast that belongs to neither."""
_MAX_MISFIT = 0.15
"""Maximum distance of a centre from the grid, spacings."""


def circle_points(board: Board) -> Array:
    """Centres (k, 3) of the circles of a grid, row by row."""
    row, column = np.indices((board.rows, board.columns))
    if board.kind == "acircles":
        column = 2 * column + row % 2
    return board.size_m * np.stack([column, row, 0.0 * row], -1).reshape(-1, 3)


def find_circles(grey: Image, board: Board) -> Detection:
    """Detect the centres of a grid of circles, or return a reason."""
    points = circle_points(board)
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.maxArea = grey.size / 20
    detector = cv2.SimpleBlobDetector.create(parameters)
    kind = cv2.CALIB_CB_SYMMETRIC_GRID
    if board.kind == "acircles":
        kind = cv2.CALIB_CB_ASYMMETRIC_GRID
    size = (board.columns, board.rows)
    # Dark circles, then bright ones.
    for image, way in product((grey, 255 - grey), (0, cv2.CALIB_CB_CLUSTERING)):
        found, centres = cv2.findCirclesGrid(
            image, size, flags=kind | way, blobDetector=detector
        )
        if not found:
            continue
        grid = np.reshape(centres, (board.rows, board.columns, 2)).astype(float)
        for down, right in ((1, 1), (1, -1), (-1, -1), (-1, 1)):
            pixels = grid[::down, ::right].reshape(-1, 2)
            plane, _ = cv2.findHomography(pixels, points[:, :2])
            if plane is None or np.linalg.det(plane) < 0:
                continue
            plane = np.asarray(plane, float)
            on_board = _moved(pixels, plane)
            away = np.abs(on_board - points[:, :2]).max() / board.size_m
            if away < _MAX_MISFIT:
                return BoardView(points, _centres(image, on_board, plane))
    return (
        f"no grid of {board.columns}x{board.rows} circles; show the whole board, sharp and"
        " without glare, or correct `size`"
    )


def _centres(image: Image, on_board: Array, plane: Array) -> Array:
    """Centres (k, 2) of dark circles, pixels.

    They are balanced on the board, by the homography from the image: there circles are round, and
    perspective does not move their middles.
    """
    to_image = np.linalg.inv(plane)
    near = norms(on_board[1:] - on_board[0]).min()
    window = near * np.stack(np.meshgrid(_WINDOW, _WINDOW), -1).reshape(-1, 2)
    window = window[norms(window) < near / 2]
    for _ in range(_ROUNDS):
        pixels = _moved((on_board[:, None] + window).reshape(-1, 2), to_image)
        u, v = pixels.astype(np.float32).T.reshape(2, -1, len(window))
        values = np.asarray(cv2.remap(image, u, v, cv2.INTER_LINEAR), float)
        dark, bright = np.percentile(values, _LEVELS, axis=1)[..., None]
        share = (bright - values) / (bright - dark)
        weight = np.clip(share, _EDGE, 1 - _EDGE) - _EDGE
        on_board = on_board + weight @ window / weight.sum(1)[:, None]
    return _moved(on_board, to_image)


def _moved(points: Array, plane: Array) -> Array:
    """Points (k, 2) after a homography."""
    return np.asarray(cv2.perspectiveTransform(points[None], plane)[0], float)
