"""Whether a board contradicts the stated intrinsics of its camera."""

from dataclasses import replace

import numpy as np

from evercal.calibration.boards.board_poses import (
    BoardImage,
    BoardPoses,
    board_poses,
)
from evercal.calibration.boards.intrinsics import calibrate_camera
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, norms

_WORSE = 1.3
"""Factor by which contradicted intrinsics enlarge the residuals."""


def compared_lens(stated: BoardPoses) -> tuple[BoardPoses, str]:
    """Compare board poses by stated intrinsics with those by intrinsics from the board.

    Where the board contradicts the stated ones, the covariances contain the difference, and a
    sentence says so; otherwise it is empty.
    """
    camera = stated.camera
    views = {image.name: image.view for image in stated.detected if image.view}
    try:
        estimated = calibrate_camera(
            list(views.values()), camera.width, camera.height, camera.model
        ).camera
    except InputError:
        return stated, ""
    free = board_poses(stated.board, estimated, views, "board")
    if stated.corner_sigma_px < _WORSE * free.corner_sigma_px:
        return stated, ""
    others = {image.name: image.camera_from_board for image in free.detected}
    images = [_widened(image, others.get(image.name)) for image in stated.images]
    words = (
        f"the board contradicts the camera file: corners fit to {stated.corner_sigma_px:.2f} px"
        f" with it and to {free.corner_sigma_px:.2f} px without; it moves the corners of the image"
        f" by {_moved_px(camera, estimated):.0f} px. Check the file, or omit `camera`"
    )
    return replace(stated, images=tuple(images)), words


def _widened(
    image: BoardImage,
    other: SE3 | None,
) -> BoardImage:
    """The image with a covariance that contains another pose of the board."""
    pose = image.camera_from_board
    if not pose or not other:
        return image
    shift = other.translation_m - pose.translation_m
    away = np.r_[shift, (pose.inverse() @ other).log()[3:]]
    return replace(image, covariance=image.covariance + np.outer(away, away))


def _moved_px(
    stated: Camera,
    estimated: Camera,
) -> float:
    """Largest distance between the corners of the image by both intrinsics."""
    right = stated.width - 1
    down = stated.height - 1
    pixels = np.array([[0, 0], [right, 0], [0, down], [right, down]])
    moved = stated.project(estimated.unproject(pixels)) - pixels
    return float(np.nanmax(norms(moved), initial=0.0))
