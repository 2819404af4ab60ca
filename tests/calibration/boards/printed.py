"""Simulated photographs of printed boards with known corners."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from evercal.calibration.boards.board import Board, dictionary_of
from evercal.calibration.boards.marker_layout import STYLES
from evercal.calibration.boards.printing import board_image
from evercal.geometry import SE3, Camera

CAMERA = Camera(640, 480, 600, 602, 318, 242)
CHESSBOARD = Board("chessboard", 0.03, 9, 6)
CHARUCO = Board("charuco", 0.04, 6, 5, 0.03, "4X4_50")
TAG = Board("apriltag", 0.08, dictionary="APRILTAG_36h11", tag=3)
APRILGRID = Board(
    "aprilgrid", 0.04, 4, 3, dictionary="APRILTAG_36h11", tag=0, gap_m=0.012
)
ARUCOGRID = Board("arucogrid", 0.04, 4, 3, dictionary="4X4_50", tag=0, gap_m=0.012)
BOARDS = (CHESSBOARD, CHARUCO, TAG, APRILGRID, ARUCOGRID)
CENTRE = {
    "chessboard": (0.12, 0.075, 0),
    "charuco": (0.12, 0.1, 0),
    "apriltag": (0, 0, 0),
    "aprilgrid": (0.1, 0.07, 0),
    "arucogrid": (0.1, 0.07, 0),
}
UP = ("apriltag", "aprilgrid")
"""Boards whose y goes up in print, and whose z points towards the camera."""
CELLS = {"chessboard": 1, "charuco": 1, "apriltag": 8, "aprilgrid": 10, "arucogrid": 6}
_PER_METRE = 6000


def grid(columns: int, rows: int) -> np.ndarray:
    """Return (columns * rows, 3) chessboard corners with squares of 30 mm."""
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return 0.03 * np.stack([x, y, 0 * x], -1).reshape(-1, 3).astype(float)


def grid_image(board: Board, unit_px: int) -> np.ndarray:
    """Draw a grid of markers as Kalibr and OpenCV print it."""
    turn, up = STYLES[board.kind]
    side = unit_px * CELLS[board.kind]
    dictionary = dictionary_of(board)
    pitch = side / board.marker_share
    gap = round(pitch - side)
    counts = np.array([board.rows, board.columns])
    image = np.full(
        np.round((counts - 1) * pitch).astype(int) + side + 2 * gap, 255, np.uint8
    )
    for k, (row, column) in enumerate(np.ndindex(*counts)):
        y = round((counts[0] - 1 - row if up else row) * pitch)
        x = round(column * pitch)
        for i, j in np.ndindex(2, 2) if up else ():  # Kalibr's squares at the corners
            at_y = y + i * (gap + side)
            at_x = x + j * (gap + side)
            image[at_y : at_y + gap, at_x : at_x + gap] = 0
        tag = cv2.aruco.generateImageMarker(
            dictionary, (board.tag or 0) + k, side, borderBits=2 if up else 1
        )
        image[y + gap : y + gap + side, x + gap : x + gap + side] = np.rot90(tag, turn)
    return image


def printed(board: Board) -> tuple[np.ndarray, np.ndarray]:
    """Return the print of a board and the (3, 3) map from metres to pixels of the print."""
    side = round(board.size_m * _PER_METRE)
    draw = grid_image if board.is_grid else board_image
    image = draw(board, side // CELLS[board.kind])
    margin = side // 3 if board.kind == "apriltag" else side
    # The black and the white of a real print.
    image = np.pad(image, margin, constant_values=255) // 255 * 210 + 20
    start = margin - 0.5
    up = 1
    if board.kind == "chessboard":
        start += side  # the first inner corner
    elif board.kind == "apriltag":
        start = start + side / 2
        up = -1
    across = start
    down = start
    if board.is_grid:  # outside of the first marker
        across = down = start + round(board.gap_m * _PER_METRE)
        up = -1 if board.kind == "aprilgrid" else 1
        down = len(image) - 1 - down if up < 0 else down
    to_print = np.array(
        [[_PER_METRE, 0, across], [0, up * _PER_METRE, down], [0, 0, 1.0]]
    )
    return image.astype(np.uint8), to_print


def photographed(board: Board, camera_from_board: SE3, seed: int = 0) -> np.ndarray:
    """Return a blurred and noisy image of a print, (480, 640, 3) uint8 RGB."""
    image, to_print = printed(board)
    rotation = camera_from_board.rotation_matrix()
    plane = np.column_stack(
        [rotation[:, 0], rotation[:, 1], camera_from_board.translation_m]
    )
    finer = 4
    to_finer = np.array([[finer, 0, 1.5], [0, finer, 1.5], [0, 0, 1.0]])
    homography = to_finer @ CAMERA.matrix() @ plane @ np.linalg.inv(to_print)
    size = (CAMERA.width * finer, CAMERA.height * finer)
    large = cv2.warpPerspective(image, homography, size, borderValue=180)
    small = cv2.resize(
        large, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA
    )
    blurred = cv2.GaussianBlur(small, (0, 0), 0.6).astype(float)
    noise = np.random.default_rng(seed).normal(0, 2, blurred.shape)
    grey = np.clip(blurred + noise, 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, 2)


def view_of(board: Board, seed: int) -> SE3:
    """Return camera_from_board of a tilted board with a random roll."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(np.array([0, 0, rng.uniform(-3, 3)]))
    rotation = Rotation.from_rotvec(rng.normal(0, 0.3, 3)) * rotation
    if board.kind in UP:
        # Z points towards the camera.
        rotation = rotation * Rotation.from_euler("x", np.pi)
    centre = np.array([0, 0, 0.4 if board.kind == "apriltag" else 0.55])
    centre = centre + rng.normal(0, 0.02, 3)
    translation = centre - rotation.apply(CENTRE[board.kind])
    return SE3(rotation.as_quat(scalar_first=True), translation)
