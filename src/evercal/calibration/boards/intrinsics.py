"""Estimate intrinsics from views of a board, with a lens model that the views support."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evercal.calibration.boards.corners import BoardView
from evercal.calibration.pose_pairs.noise_levels import normal_inverse
from evercal.errors import InputError
from evercal.geometry import Camera

MIN_VIEWS = 5
"""Minimum number of views of a flat board."""
_FOCAL_SIGMA = 0.01
"""Maximum relative standard deviation of the focal length."""


class Intrinsics(NamedTuple):
    """A camera with the uncertainty of its focal length."""

    camera: Camera
    focal_sigma_px: float
    """Standard deviation of the focal length, the larger of x and y."""


def calibrate_camera(views: Sequence[BoardView], width: int, height: int) -> Intrinsics:
    """Estimate focal lengths, principal point and distortion.

    Models of 0, 1 (k1), 2 (k2), 4 (p1 p2) and 5 (k3) distortion coefficients are fitted.
    The Bayesian information criterion selects one, so that few views do not overfit.

    Raises:
        InputError: Fewer than five views, or they do not determine the focal length.
    """
    import cv2

    if len(views) < MIN_VIEWS:
        raise InputError(
            f"the board was detected in {len(views)} images, intrinsics take at least {MIN_VIEWS};"
            f" take 15 with the board tilted by 20 to 45 deg, or give --camera"
        )
    points = [view.points_m.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    none = cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    some = none & ~cv2.CALIB_FIX_K1 & ~cv2.CALIB_FIX_K2
    models = {0: none, 1: some | cv2.CALIB_FIX_K2, 2: some, 4: some & ~cv2.CALIB_ZERO_TANGENT_DIST}
    models[5] = 0
    count = 2 * sum(len(p) for p in points)
    best: tuple[float, Intrinsics] | None = None
    matrix = cv2.initCameraMatrix2D(points, pixels, (width, height))
    coefficients = np.zeros(5)
    for extra, flags in models.items():
        try:
            rms, matrix, coefficients, rotvecs, translations = cv2.calibrateCamera(
                points,
                pixels,
                (width, height),
                matrix.copy(),
                coefficients.copy(),
                flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS,
            )[:5]
        except cv2.error:  # diverged, because the views do not determine the camera
            break
        squared = rms**2 * count / 2
        criterion = count * np.log(max(squared, 1e-12) / count) + extra * np.log(count)
        if best is None or criterion < best[0] - 2:
            distortion = tuple(float(v) for v in np.ravel(coefficients)[:5]) if extra else ()
            camera = Camera.from_matrix(matrix, width, height, distortion)
            sigma = float(np.sqrt(squared / max(count - 4 - extra - 6 * len(views), 1)))
            poses = list(zip(rotvecs, translations, strict=True))
            focal = sigma * _unit_focal_sigma(points, camera, extra, poses)
            best = (criterion, Intrinsics(camera, focal))
    result = None if best is None else best[1]
    if result is None or not result.focal_sigma_px < _FOCAL_SIGMA * result.camera.fx:
        focal = ""
        if result is not None:
            focal = f" ({result.camera.fx:.0f} +- {result.focal_sigma_px:.0f} px)"
        raise InputError(
            f"the images leave the focal length open{focal}; tilt the board by 20 to 45 deg in"
            f" several directions, or give --camera"
        )
    return result


def _unit_focal_sigma(
    points: list[np.ndarray], camera: Camera, extra: int, poses: list[tuple[np.ndarray, np.ndarray]]
) -> float:
    """Return the standard deviation of the focal length for a corner noise of one pixel.

    It is huge if the views do not determine the focal length; OpenCV's own deviation is then zero.
    """
    import cv2

    shared, size = 4 + extra, len(poses)
    normal = np.zeros((shared + 6 * size, shared + 6 * size))
    distortion = np.zeros(5)
    distortion[: len(camera.distortion)] = camera.distortion
    for i, (corners, (rotvec, translation)) in enumerate(zip(points, poses, strict=True)):
        # Columns: rotation vector, translation, focal lengths, principal point, distortion.
        projection = cv2.projectPoints(corners, rotvec, translation, camera.matrix(), distortion)
        slopes = np.asarray(projection[1])
        columns = np.concatenate([slopes[:, 6 : 6 + shared], slopes[:, :6]], 1)
        rows = np.r_[:shared, shared + 6 * i : shared + 6 * i + 6]
        normal[np.ix_(rows, rows)] += columns.T @ columns
    return float(np.sqrt(np.diag(normal_inverse(normal))[:2].max()))
