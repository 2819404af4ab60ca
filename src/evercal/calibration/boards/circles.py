"""Detect grids of circles, with centres that perspective does not move."""

from itertools import product

import cv2
import numpy as np

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.corners import BoardView, Detection
from evercal.typing import Array, Image

_ANGLES = 32
"""Number of rays from the centre of a circle."""
_STEPS = 60
"""Number of samples along a ray."""
_ROUNDS = 3
"""Rounds that move the centres."""
_EDGE = 0.5
"""Slope that belongs to an edge, steepest ones of the ray."""
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
        for step in ((1, 1), (1, -1), (-1, -1), (-1, 1)):
            pixels = grid[:: step[0], :: step[1]].reshape(-1, 2)
            plane, _ = cv2.findHomography(points[:, :2], pixels)
            if plane is None or np.linalg.det(plane) < 0:
                continue
            plane = np.asarray(plane, float)
            to_grid = cv2.perspectiveTransform(pixels[None], np.linalg.inv(plane))[0]
            away = np.abs(to_grid - points[:, :2]).max() / board.size_m
            if away < _MAX_MISFIT:
                return BoardView(points, _centres(image, points[:, :2], pixels, plane))
    return (
        f"no grid of {board.columns}x{board.rows} circles; show the whole board, sharp and"
        " without glare, or correct `size`"
    )


def _centres(image: Image, points: Array, pixels: Array, plane: Array) -> Array:
    """Centres of circles by their edges; the middle of an ellipse is not that of its circle."""
    mapped = np.c_[points, np.ones(len(points))] @ plane.T
    x, y, depth = mapped.T
    # Pixels (k, 2, 2) along a metre of the board.
    local = (
        plane[:2, :2]
        - np.stack([x, y], 1)[..., None] / depth[:, None, None] * plane[2, :2]
    )
    local = local / depth[:, None, None]
    near = np.sort(np.linalg.norm(points - points[0], axis=1))[1]
    angles = 2 * np.pi * np.arange(_ANGLES) / _ANGLES
    rays = np.stack([np.cos(angles), np.sin(angles)], 1)
    reach = np.linspace(0.05, 0.6, _STEPS) * near
    along = rays[:, None] * reach[:, None]
    radius = 0.0
    for _ in range(_ROUNDS):
        at = pixels[:, None, None] + along @ local[:, None].transpose(0, 1, 3, 2)
        u, v = np.moveaxis(at.astype(np.float32), -1, 0).reshape(2, len(points), -1)
        values = cv2.remap(image, u, v, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
        values = np.reshape(values, at.shape[:3]).astype(float)
        slope = np.gradient(values, axis=2).clip(0)
        slope[slope < _EDGE * slope.max(2, keepdims=True)] = 0
        edge = (slope * reach).sum(2) / (slope.sum(2) + 1e-9)
        radius = float(np.median(edge))
        shift = 2 * (edge[..., None] * rays).mean(1)
        pixels = pixels + (local @ shift[..., None])[..., 0]
    # The middle of the ellipse of a circle, by its dual conic.
    conic = radius**2 * plane[:, :2] @ plane[2, :2] - mapped * depth[:, None]
    middle = conic[:, :2] / conic[:, 2:]
    return pixels - (middle - mapped[:, :2] / depth[:, None])
