"""Intrinsics of a camera from views of a board, with as much of a lens model as they support."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evercal.calibration.boards.corners import BoardView
from evercal.calibration.pose_pairs.noise_levels import normal_inverse
from evercal.errors import InputError
from evercal.geometry import Camera

MIN_VIEWS = 5
"""Views of a flat board from which five parameters and more are found."""
_FOCAL_SIGMA = 0.01
"""Share of the focal length that it must be sure to."""


@dataclass(frozen=True)
class Intrinsics:
    """A camera and how well the corners fit it."""

    camera: Camera
    """At the size of the images."""
    rms_px: float
    """Root mean square distance of corners from where they should be."""
    focal_sigma_px: float
    """Standard deviation of the focal length, the larger of both."""


def calibrate_camera(views: Sequence[BoardView], width: int, height: int) -> Intrinsics:
    """Finds focal lengths, principal point and distortion.

    Lens models of growing size are fitted, none, k1, k1 k2, those with p1 p2, with k3; the one with
    the lowest Bayesian information criterion is kept, so that few views get no wild lens.

    Args:
        views: of a flat board, five or more, tilted.
        width: of the images, pixels.
        height: of the images, pixels.

    Raises:
        InputError: Too few views, or views that leave the focal length open.
    """
    import cv2

    if len(views) < MIN_VIEWS:
        raise InputError(
            f"the board was found in {len(views)} images, intrinsics take at least {MIN_VIEWS};"
            f" take 15 with the board tilted by 20 to 45 deg, or give --camera"
        )
    points = [view.points_m.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    free = cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    some = free & ~cv2.CALIB_FIX_K1 & ~cv2.CALIB_FIX_K2
    models = {0: free, 1: some | cv2.CALIB_FIX_K2, 2: some, 4: some & ~cv2.CALIB_ZERO_TANGENT_DIST}
    models[5] = 0
    count = 2 * sum(len(p) for p in points)
    best: tuple[float, Intrinsics] | None = None
    matrix, lens = cv2.initCameraMatrix2D(points, pixels, (width, height)), np.zeros(5)
    for extra, flags in models.items():
        try:
            rms, matrix, lens, turns, shifts = cv2.calibrateCamera(
                points,
                pixels,
                (width, height),
                matrix.copy(),
                lens.copy(),
                flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS,
            )[:5]
        except cv2.error:  # it ran away, as it does where the views leave the camera open
            break
        squared = rms**2 * count / 2
        criterion = count * np.log(max(squared, 1e-12) / count) + extra * np.log(count)
        if best is None or criterion < best[0] - 2:
            distortion = tuple(float(v) for v in np.ravel(lens)[:5]) if extra else ()
            camera = Camera.from_matrix(matrix, width, height, distortion)
            sigma = float(np.sqrt(squared / max(count - 4 - extra - 6 * len(views), 1)))
            focal = sigma * _unit_focal_sigma(
                points, camera, extra, list(zip(turns, shifts, strict=True))
            )
            best = (criterion, Intrinsics(camera, float(rms), focal))
    found = None if best is None else best[1]
    if found is None or not found.focal_sigma_px < _FOCAL_SIGMA * found.camera.fx:
        size = "" if found is None else f" ({found.camera.fx:.0f} +- {found.focal_sigma_px:.0f} px)"
        raise InputError(
            f"the images leave the focal length open{size}; tilt the board by 20 to 45 deg in"
            f" several directions, or give --camera"
        )
    return found


def _unit_focal_sigma(
    points: list[np.ndarray], camera: Camera, extra: int, poses: list[tuple[np.ndarray, np.ndarray]]
) -> float:
    """Standard deviation of the focal length for corners that are off by a pixel; huge if open.

    OpenCV's own deviations come out zero where the views leave a parameter open.
    """
    import cv2

    shared, size = 4 + extra, len(poses)
    normal = np.zeros((shared + 6 * size, shared + 6 * size))
    lens = np.zeros(5)
    lens[: len(camera.distortion)] = camera.distortion
    for i, (corners, (turn, shift)) in enumerate(zip(points, poses, strict=True)):
        # Columns: rotation vector, translation, focal lengths, principal point, distortion.
        slopes = np.asarray(cv2.projectPoints(corners, turn, shift, camera.matrix(), lens)[1])
        columns = np.concatenate([slopes[:, 6 : 6 + shared], slopes[:, :6]], 1)
        where = np.r_[:shared, shared + 6 * i : shared + 6 * i + 6]
        normal[np.ix_(where, where)] += columns.T @ columns
    return float(np.sqrt(np.diag(normal_inverse(normal))[:2].max()))
