"""Rendered photographs of printed boards with known corners."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.boards.printing import board_image
from evercal.geometry import SE3, Camera

CAMERA = Camera(960, 600, 760.0, 760.0, 479.5, 299.5)
DISTORTED = Camera(960, 600, 760.0, 760.0, 479.5, 299.5, (-0.25, 0.08, 0.001, -0.001))
CHESSBOARD = Board("chessboard", 0.03, 9, 6)
LARGE = Board("chessboard", 0.015, 28, 17)
CHARUCO = Board("charuco", 0.04, 8, 6, 0.03, "5X5_100")
TAG = Board("apriltag", 0.08, dictionary="APRILTAG_36h11", tag=3)
_FINER = 4
"""Samples of a pixel along each axis."""
_TEXELS = 56
"""Texture pixels along a square, or along two cells of a tag; cells of CHARUCO are whole pixels."""


@dataclass(frozen=True)
class Photo:
    """How a board is photographed."""

    camera: Camera = CAMERA
    tilt_deg: float = 30.0
    """Angle between the optical axis and the normal of the board."""
    distance: float = 1.0
    """Distance in units of that at which the frontal board fills the image."""
    roll_deg: float = 40.0
    """Maximum rotation about the optical axis to either side."""
    aside: float = 0.1
    """Maximum shift of the aim from the board's centre, parts of its size."""
    blur_px: float = 0.7
    noise: float = 3.0
    """Standard deviation of the grey values, of 255."""
    light: float = 0.3
    """Relative change of brightness across the image."""


def render(board: Board, photo: Photo, seed: int) -> tuple[np.ndarray, BoardView, SE3]:
    """Return an image (H, W, 3) uint8 RGB, the true corners in view, and camera_from_board."""
    rng = np.random.default_rng(seed)
    pose = _pose(board, photo, rng)
    image = _photograph(board, photo, pose, rng)
    return (
        np.repeat(image[..., None], 3, 2),
        true_corners(board, photo.camera, pose),
        pose,
    )


def true_corners(board: Board, camera: Camera, pose: SE3) -> BoardView:
    """Return all corners of a board that lie in the image."""
    points = corner_points(board)
    pixels = camera.project(pose.apply(points))
    inside = ((pixels >= 0) & (pixels <= (camera.width - 1, camera.height - 1))).all(1)
    return BoardView(points[inside], pixels[inside])


def corner_points(board: Board) -> np.ndarray:
    """Return the (k, 3) corners of a board in its frame, metres."""
    if board.kind == "apriltag":
        half = board.size_m / 2
        return np.array(
            [[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]]
        )
    first = 0 if board.kind == "chessboard" else 1
    x, y = np.meshgrid(np.arange(first, board.columns), np.arange(first, board.rows))
    return board.size_m * np.stack([x, y, 0 * x], -1).reshape(-1, 3).astype(float)


def _pose(board: Board, photo: Photo, rng: np.random.Generator) -> SE3:
    low, high = _extent(board)
    camera = photo.camera
    size = high - low + 0.5 * board.size_m
    fills = max(size[0] * camera.fx / camera.width, size[1] * camera.fy / camera.height)
    turn = rng.uniform(0, 2 * np.pi)
    roll = np.deg2rad(photo.roll_deg * rng.uniform(-1, 1))
    axis = np.array([np.cos(turn), np.sin(turn), 0])
    rotation = Rotation.from_rotvec(np.deg2rad(photo.tilt_deg) * axis)
    rotation = rotation * Rotation.from_rotvec([0, 0, roll])
    aim = (low + high) / 2 + photo.aside * (high - low) * rng.uniform(-1, 1, 2)
    centre = np.array([*aim, 0.0])
    if board.kind == "apriltag":  # y is up and z towards the camera
        rotation = rotation * Rotation.from_euler("x", np.pi)
        centre = centre * (1, -1, 1)
    translation = np.array([0, 0, photo.distance * fills]) - rotation.apply(centre)
    return SE3(rotation.as_quat(scalar_first=True), translation)


def _photograph(
    board: Board, photo: Photo, pose: SE3, rng: np.random.Generator
) -> np.ndarray:
    camera = photo.camera
    texture, per_m, start = _texture(board)
    v, u = np.mgrid[: camera.height, : camera.width].astype(float)
    rays = (
        camera.unproject(np.stack([u, v], -1).reshape(-1, 2)) @ pose.rotation_matrix()
    )
    origin = pose.inverse().translation_m
    down = rays[:, 2] if board.kind != "apriltag" else -rays[:, 2]
    hit = origin[:2] - rays[:, :2] * (origin[2] / rays[:, 2])[:, None]
    hit[down < 0.05] = 1e3
    if board.kind == "apriltag":
        hit[:, 1] *= -1
    where = ((hit - start) * per_m - 0.5).reshape(camera.height, camera.width, 2)
    fine = (camera.width * _FINER, camera.height * _FINER)
    x, y = (cv2.resize(where[..., k].astype(np.float32), fine) for k in (0, 1))
    sampled = cv2.remap(
        texture, x, y, cv2.INTER_LINEAR, None, cv2.BORDER_CONSTANT, [90.0]
    )
    small = cv2.resize(
        sampled, (camera.width, camera.height), interpolation=cv2.INTER_AREA
    )
    blurred = cv2.GaussianBlur(small, (0, 0), photo.blur_px).astype(float)
    ramp = (u / camera.width - 0.5) * rng.uniform(-1, 1) + (
        v / camera.height - 0.5
    ) * rng.uniform(-1, 1)
    noisy = blurred * (1 + photo.light * ramp) + rng.normal(
        0, photo.noise, blurred.shape
    )
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def _texture(board: Board) -> tuple[np.ndarray, float, np.ndarray]:
    image = board_image(board, _TEXELS // 2 if board.kind == "apriltag" else _TEXELS)
    low, high = _extent(board)
    per_m = image.shape[1] / (high - low)[0]
    margin = round(0.8 * _TEXELS)
    bright = np.pad(image, margin, constant_values=255) / 255
    return (25 + 200 * bright).astype(np.float32), per_m, low - margin / per_m


def _extent(board: Board) -> tuple[np.ndarray, np.ndarray]:
    """Return the upper left and the lower right corner of a print, x right and y down, metres."""
    if board.kind == "apriltag":
        return np.full(2, -board.size_m / 2), np.full(2, board.size_m / 2)
    size = board.size_m * np.array([board.columns, board.rows], dtype=float)
    return (
        np.full(2, -board.size_m) if board.kind == "chessboard" else np.zeros(2)
    ), size
