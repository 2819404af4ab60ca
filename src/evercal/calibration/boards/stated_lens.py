"""Whether a board contradicts the stated intrinsics of its camera."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evercal.calibration.boards.board_poses import (
    BoardImage,
    BoardPoses,
    board_poses,
)
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.boards.intrinsics import calibrate_camera
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, norms

_WORSE = 1.3
"""Factor by which contradicted intrinsics enlarge the residuals."""
_REST = 0.1
"""Share of the residuals that may stay when the cause is taken away."""
_EVIDENCE = 45.0
"""Twice the logarithm of the likelihood ratio that nine free intrinsics reach hardly by chance."""
_FREE = 9
"""Number of free intrinsics."""
_MISFIT_PX = 1.0
"""Noise of corners above which stated intrinsics are doubted where none can be estimated."""


class Contradiction(NamedTuple):
    """A board that contradicts intrinsics."""

    words: str
    others: BoardPoses | None = None
    """Board poses by intrinsics from the board."""


def compared_lens(stated: BoardPoses) -> tuple[BoardPoses, str]:
    """Compare board poses by stated intrinsics with those by intrinsics from the board.

    Where the board contradicts the stated ones, the covariances contain the difference, and a
    sentence says so; otherwise it is empty.
    """
    views = {image.name: image.view for image in stated.detected if image.view}
    found = contradiction(stated, views)
    if not found or not found.others:
        return stated, found.words if found else ""
    others = {image.name: image.camera_from_board for image in found.others.detected}
    images = [_widened(image, others.get(image.name)) for image in stated.images]
    return replace(stated, images=tuple(images)), found.words


def contradiction(
    stated: BoardPoses, views: Mapping[str, BoardView]
) -> Contradiction | None:
    """What the corners of a board say against the stated intrinsics of its poses, if anything."""
    camera = stated.camera
    sigma = stated.corner_sigma_px
    try:
        estimated = calibrate_camera(
            list(views.values()), camera.width, camera.height, camera.model
        ).camera
    except InputError:
        if sigma < _MISFIT_PX:
            return None
        return Contradiction(
            f"corners fit the camera file only to {sigma:.2f} px: check it, or take five images or"
            " more with the board tilted, which tell what is wrong"
        )
    free = board_poses(stated.board, estimated, views, "board")
    freedom = sum(2 * len(view.pixels) - 6 for view in views.values()) - _FREE
    ratio = sigma / free.corner_sigma_px
    if ratio < _WORSE or 2 * freedom * np.log(ratio) < _EVIDENCE:
        return None
    cause = ""
    for words, other in _causes(camera, estimated):
        fit = board_poses(stated.board, other, views)
        if fit.corner_sigma_px < max(_WORSE * free.corner_sigma_px, _REST * sigma):
            cause = f"{words}. C"
            break
    words = (
        f"the board contradicts the camera file: {cause or 'c'}orners fit to {sigma:.2f} px with it"
        f" and to {free.corner_sigma_px:.2f} px without; it moves the corners of the image by"
        f" {_moved_px(camera, estimated):.0f} px. Check the file, or omit `camera`"
    )
    return Contradiction(words, free)


def _causes(stated: Camera, own: Camera) -> Iterator[tuple[str, Camera]]:
    """What may be wrong with stated intrinsics, the simplest first, and the camera without it."""
    if stated.distortion:
        yield (
            "its distortion is applied twice, the images are rectified already",
            replace(stated, distortion=()),
        )
    swapped = replace(stated, fx=stated.fy, fy=stated.fx, cx=stated.cy, cy=stated.cx)
    yield "its x and y are swapped, as in images that are turned", swapped
    scale = own.fx / stated.fx
    longer = replace(stated, fx=own.fx, fy=stated.fy * scale)
    size = "its focal length is of another mode or stream"
    if scale > 20:
        size = "its focal length is in millimetres"
    yield f"{size}: {own.fx:.0f} px fit, not {stated.fx:.4g}", longer
    yield (
        f"it is of another resolution: fx, fy, cx and cy times {scale:.3g} fit",
        replace(longer, cx=stated.cx * scale, cy=stated.cy * scale),
    )
    for name, change in (("fx", {"fx": own.fx}), ("fy", {"fy": own.fy})):
        yield (
            f"its {name} is that of squeezed or cropped images: fx / fy is"
            f" {own.fx / own.fy:.3f} by the board, {stated.fx / stated.fy:.3f} in the file",
            replace(stated, **change),
        )
    yield (
        f"its principal point is of another crop: {own.cx:.0f} {own.cy:.0f} fit, not"
        f" {stated.cx:.0f} {stated.cy:.0f}",
        replace(stated, cx=own.cx, cy=own.cy),
    )
    yield "its distortion is another", replace(stated, distortion=own.distortion)


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
