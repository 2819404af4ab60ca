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
from evercal.geometry import SE3, Camera, deviations, norms
from evercal.typing import JsonObject

_WORSE = 1.3
"""Factor by which contradicted intrinsics enlarge the residuals."""
_REST = 0.1
"""Share of the residuals that may stay when the cause is taken away."""
_EVIDENCE = 45.0
"""Twice the logarithm of the likelihood ratio that nine free intrinsics reach hardly by chance."""
_FREE = 9
"""Number of free intrinsics."""
_MILLIMETRES = 20.0
"""Ratio of focal lengths above which the stated one is in millimetres."""
_NUMBERS = "fx {0.fx:.4g} fy {0.fy:.4g} cx {0.cx:.4g} cy {0.cy:.4g}"
_MISFIT_PX = 1.0
"""Noise of corners above which stated intrinsics are doubted where none can be estimated."""


def compared_lens(stated: BoardPoses) -> tuple[BoardPoses, str]:
    """Compare board poses by stated intrinsics with those by intrinsics from the board.

    Where the board contradicts the stated ones, the covariances contain the difference, and a
    sentence says so; otherwise it is empty.
    """
    camera = stated.camera
    sigma = stated.corner_sigma_px
    views = {image.name: image.view for image in stated.detected if image.view}
    try:
        own = calibrate_camera([*views.values()], *camera.size, camera.model).camera
    except InputError:
        if sigma < _MISFIT_PX:
            return stated, ""
        return stated, (
            f"corners fit the camera file only to {sigma:.2f} px: check it, or take five images or"
            " more with the board tilted, which tell what is wrong"
        )
    free = board_poses(stated.board, own, views, "board")
    freedom = sum(2 * len(view.pixels) - 6 for view in views.values()) - _FREE
    ratio = sigma / free.corner_sigma_px
    if ratio < _WORSE or 2 * freedom * np.log(ratio) < _EVIDENCE:
        return stated, ""
    most = max(_WORSE * free.corner_sigma_px, _REST * sigma)
    cause = ""
    for words, change in _causes(camera, own).items():
        repaired = replace(camera, **change)
        if board_poses(stated.board, repaired, views).corner_sigma_px < most:
            cause = f"{words}: "
            break
    words = (
        f"the board contradicts the camera file: {cause}{_NUMBERS.format(own)} fit, not"
        f" {_NUMBERS.format(camera)}. Corners fit to {sigma:.2f} px with it and to"
        f" {free.corner_sigma_px:.2f} px without; it moves pixels by up to"
        f" {_moved_px(camera, own):.0f} px. Check the file, or omit `camera`"
    )
    others = {image.name: image.camera_from_board for image in free.detected}
    images = [_widened(image, others.get(image.name)) for image in stated.images]
    return replace(stated, images=tuple(images)), words


def _causes(stated: Camera, own: Camera) -> dict[str, JsonObject]:
    """What may be wrong with stated intrinsics, the simplest first, and the right values."""
    scale = own.fx / stated.fx
    longer = {"fx": own.fx, "fy": stated.fy * scale}
    mode = "its focal length is of another mode or stream"
    if scale > _MILLIMETRES:
        mode = "its focal length is in millimetres"
    distorted = "it has no distortion, the lens does"
    if any(stated.distortion):
        distorted = "its distortion is another"
    return {
        "its distortion is applied twice, the images are rectified already": {
            "distortion": ()
        },
        "its x and y are swapped, as in images that are turned": {
            "fx": stated.fy,
            "fy": stated.fx,
            "cx": stated.cy,
            "cy": stated.cx,
        },
        mode: longer,
        f"it is of another resolution, {1 / scale:.3g} times this one": {
            **longer,
            "cx": stated.cx * scale,
            "cy": stated.cy * scale,
        },
        "its fx is that of squeezed or cropped images": {"fx": own.fx},
        "its fy is that of squeezed or cropped images": {"fy": own.fy},
        "its principal point is of another crop": {"cx": own.cx, "cy": own.cy},
        distorted: {"distortion": own.distortion},
    }


def _widened(
    image: BoardImage,
    other: SE3 | None,
) -> BoardImage:
    """The image with a covariance that contains another pose of the board."""
    pose = image.camera_from_board
    if not pose or not other:
        return image
    away = deviations(SE3.stack([other]), pose)[0]
    return replace(image, covariance=image.covariance + np.outer(away, away))


def _moved_px(
    stated: Camera,
    estimated: Camera,
) -> float:
    """Largest distance between the pixels of one ray by both intrinsics."""
    # Few images leave an estimated distortion without an inverse in the corners.
    shares = np.indices((9, 9)).reshape(2, -1).T / 8
    pixels = shares * np.subtract(stated.size, 1)
    moved = stated.project(estimated.unproject(pixels)) - pixels
    return float(np.nanmax(norms(moved), initial=0.0))
