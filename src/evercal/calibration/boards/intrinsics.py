"""Estimate intrinsics from views of a board."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evercal.calibration.boards.corners import BoardView, board_pose, pixel_sigma
from evercal.calibration.boards.lens import LensPrior, lens_estimate, moved_camera
from evercal.errors import InputError
from evercal.geometry import Camera

MIN_VIEWS = 5
"""Minimum number of views of a flat board."""
_FOCAL_SIGMA = 0.1
"""Maximum relative standard deviation of the focal length."""
_FALSE = 10.0
"""Residual of a false detection, in medians of all views."""
_ROUNDS = 25


class Intrinsics(NamedTuple):
    """A camera with the uncertainty of its focal length."""

    camera: Camera
    focal_sigma_px: float
    """Standard deviation of the focal length, the larger of x and y."""


def calibrate_camera(views: Sequence[BoardView], width: int, height: int) -> Intrinsics:
    """Estimate focal lengths, principal point and distortion (k1 k2 p1 p2 k3).

    Weak priors, see `LensPrior.usual`, keep what few views leave open within what is usual.

    Raises:
        InputError: Fewer than five views, or they do not determine the focal length.
    """
    if len(views) < MIN_VIEWS:
        raise InputError(
            f"the board was detected in {len(views)} images, intrinsics take at least {MIN_VIEWS};"
            f" take 15 with the board tilted by 20 to 45 deg, or give --camera"
        )
    open_focal = "the images leave the focal length open{}; tilt the board by 20 to 45 deg in" + (
        " several directions, or give --camera"
    )
    views = _consistent(views, _rough(views, width, height))
    if len(views) < MIN_VIEWS:
        raise InputError(
            f"the corners of {len(views)} images are those of a flat board, intrinsics take at"
            f" least {MIN_VIEWS}; check --size, or give --camera"
        )
    camera = _rough(views, width, height)
    prior = LensPrior.usual(camera)
    try:
        poses, estimate = [board_pose(view, camera) for view in views], None
    except ValueError:
        raise InputError(open_focal.format("")) from None
    for _ in range(_ROUNDS):
        sigma = pixel_sigma(poses)
        estimate = lens_estimate(poses, sigma, camera, prior)
        change = estimate.change * min(1.0, 0.2 * camera.fx / np.abs(estimate.change[:2]).max())
        try:
            moved = moved_camera(camera, change)
            starts = [pose.camera_from_board for pose in poses]
            poses = [board_pose(v, moved, s) for v, s in zip(views, starts, strict=True)]
        except ValueError:
            raise InputError(open_focal.format("")) from None
        camera = moved
        if change @ estimate.information @ change < 1e-4:
            break
    assert estimate is not None
    focal = float(np.sqrt(np.diag(estimate.covariance)[:2].max()))
    if not focal < _FOCAL_SIGMA * camera.fx:
        raise InputError(open_focal.format(f" ({camera.fx:.0f} +- {focal:.0f} px)"))
    return Intrinsics(camera, focal)


def _consistent(views: Sequence[BoardView], camera: Camera) -> list[BoardView]:
    """Leave out false detections: views without a pose, or with much larger residuals."""
    rms = np.full(len(views), np.inf)
    for i, view in enumerate(views):
        with suppress(ValueError):
            rms[i] = board_pose(view, camera).rms_px
    most = _FALSE * np.median(rms)
    return [view for view, error in zip(views, rms, strict=True) if error <= most < np.inf]


def _rough(views: Sequence[BoardView], width: int, height: int) -> Camera:
    """Return a camera without distortion whose only unknown is the focal length."""
    import cv2

    middle = Camera(width, height, width, width, (width - 1) / 2, (height - 1) / 2)
    points = [view.points_m.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT
    flags |= cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST
    flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    try:
        _, matrix, *_ = cv2.calibrateCamera(
            points, pixels, (width, height), middle.matrix(), np.zeros(5), flags=flags
        )
    except cv2.error:
        return middle
    focal = float(matrix[0, 0])
    if not 0.1 * width < focal < 20 * width:
        return middle
    return replace(middle, fx=focal, fy=focal)
