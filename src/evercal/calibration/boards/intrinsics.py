"""Intrinsics of a camera from views of a board.

Eliminating the poses from the normal equations leaves the information on the intrinsics (the Schur
complement of bundle adjustment); a Gaussian prior is added to it.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evercal.calibration.boards.corners import (
    BEND,
    Bend,
    BoardPose,
    BoardView,
    board_pose,
    lens_vector,
    strays,
)
from evercal.calibration.boards.row_shift import CornerNoise
from evercal.choices import CameraModel
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.geometry.camera import COEFFICIENTS
from evercal.geometry.normal_equations import normal_pseudo_inverse, normal_solution
from evercal.typing import Array, ArrayPair, Pair

LENS = {name: ("fx", "fy", "cx", "cy", *terms) for name, terms in COEFFICIENTS.items()}
"""Names of the intrinsics of each model."""
MIN_VIEWS = 5
"""Minimum number of views of a flat board."""
_CENTRE_SIGMA = 0.1
"""Standard deviation of the principal point from the middle of the image, image widths."""
_ASPECT_SIGMA = 0.02
"""Standard deviation of the ratio of both focal lengths from 1."""
_FOCAL_SIGMA = 0.5
"""Relative standard deviation of a rough focal length."""
_DISTORTION_SIGMA = {
    "pinhole": (0.3, 0.5, 2e-3, 2e-3, 0.5, 0.1, 0.1, 0.1),
    "fisheye": (0.1,) * 4,
}
"""Standard deviations of the distortion coefficients of an unknown camera."""
_STATED_SIGMA = 0.005
"""Standard deviation of a stated focal length and principal point, relative to the focal length."""
_STATED_DISTORTION_SIGMA = {
    "pinhole": (0.02, 0.05, 5e-4, 5e-4, 0.1, 0.02, 0.02, 0.02),
    "fisheye": (0.01,) * 4,
}
"""Standard deviations of stated distortion coefficients."""
_BEND_SIGMA = 0.15
"""Standard deviation of the curvatures of a board, 1 / metres: over 300 mm, the second
order moves the edges by 1.7 mm, the third by 0.6 mm and the fourth by 0.1 mm."""
_STRETCH_SIGMA = 0.005
"""Standard deviation of the ratio of the sides of a printed square from 1, and of the angle between
them from 90 degrees, radians."""
_HALF_ANGLES_DEG = (35, 45, 55, 65, 75, 85, 95, 110)
"""Candidates for half of the horizontal field of view of a fisheye."""
_MAX_FOCAL_SIGMA = 0.1
"""Maximum relative standard deviation of an estimated focal length."""
_MAX_MISFIT = 10.0
"""Maximum residual of a view, medians of all views; with more it is a false detection."""
_MAX_ROUNDS = 25
"""Maximum number of alternations between poses and intrinsics."""
_MAX_FOCAL_STEP = 0.2
"""Maximum relative change of the focal length in one of them."""
_CONVERGED = 1e-4
"""Squared Mahalanobis length of a change of the intrinsics that ends them."""
_OPEN_FOCAL = (
    "the images leave the focal length open{}; tilt the board by 20 to 45 deg in several"
    " directions, or give `camera`"
)


class LensPrior(NamedTuple):
    """A Gaussian over the (q,) intrinsics in the order of `LENS`, and the bend of the board."""

    mean: Array
    information: Array
    """(q, q) inverse covariance."""

    @classmethod
    def stated(cls, camera: Camera) -> "LensPrior":
        """Prior of intrinsics from the maker or from another calibration."""
        sigma_px = _STATED_SIGMA * camera.fx
        distortion = _STATED_DISTORTION_SIGMA[camera.model]
        return cls._around(lens_vector(camera), sigma_px, distortion)

    @classmethod
    def usual(cls, camera: Camera) -> "LensPrior":
        """Prior of unknown intrinsics; `camera` gives image size and a rough focal length."""
        mean = np.zeros(len(lens_vector(camera)))
        mean[:2] = camera.fx
        mean[2:4] = _middle(*camera.size)
        centre_px = _CENTRE_SIGMA * camera.width
        distortion = _DISTORTION_SIGMA[camera.model]
        prior = cls._around(mean, centre_px, distortion)
        aspect_px = _ASPECT_SIGMA * camera.fx
        focal_px = _FOCAL_SIGMA * camera.fx
        difference = np.array([[1.0, -1.0], [-1.0, 1.0]])
        focal = difference / aspect_px**2 + np.eye(2) / focal_px**2
        prior.information[:2, :2] = focal
        return prior

    @classmethod
    def _around(
        cls, mean: Array, sigma_px: float, sigma_terms: Sequence[float]
    ) -> "LensPrior":
        sigma = np.r_[np.full(4, sigma_px), sigma_terms][: len(mean)]
        sigma = np.r_[sigma, np.full(2, _STRETCH_SIGMA)]
        sigma = np.r_[sigma, np.full(len(BEND) - 2, _BEND_SIGMA)]
        return cls(
            np.r_[mean, np.zeros(len(BEND))],
            np.diag(sigma**-2.0),
        )


class Intrinsics(NamedTuple):
    """A camera with the uncertainty of its focal length."""

    camera: Camera
    focal_sigma_px: float
    """Standard deviation of the focal length, the larger of x and y."""


def lens_estimate(
    poses: Sequence[BoardPose],
    sigma_px: float,
    camera: Camera,
    bend: Bend,
    prior: LensPrior,
) -> ArrayPair:
    """Estimate the change (q,) of the intrinsics and the bend that board poses were fitted with.

    Also return the information (q, q) of the corners and the prior.
    """
    variance = sigma_px**2
    information = np.sum([pose.lens_normal for pose in poses], 0) / variance
    information = information + prior.information
    gradient = np.sum([pose.lens_gradient for pose in poses], 0) / variance
    deviation = prior.mean - np.r_[lens_vector(camera), bend.terms]
    gradient = gradient + prior.information @ deviation
    return normal_solution(information, gradient), information


def moved_lens(
    camera: Camera,
    bend: Bend,
    change: Array,
) -> tuple[Camera, Bend]:
    """Return camera and bend after a (q,) change; ValueError without a positive focal length."""
    of_camera, of_bend = np.split(change, [-len(BEND)])
    moved = bend._replace(terms=bend.terms + of_bend)
    return moved_camera(camera, of_camera), moved


def moved_camera(camera: Camera, change: Array) -> Camera:
    """Return the camera after a change of its intrinsics."""
    fx, fy, cx, cy, *distortion = (lens_vector(camera) + change).tolist()
    return replace(
        camera,
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        distortion=tuple(distortion),
    )


def fitted_poses(
    views: Sequence[BoardView], camera: Camera, starts: Sequence[SE3] | SE3, bend: Bend
) -> list[BoardPose]:
    """Fit the pose of the board in every view from its start."""
    pairs = zip(views, starts, strict=True)
    return [board_pose(view, camera, start, bend) for view, start in pairs]


def calibrate_camera(
    views: Sequence[BoardView], width: int, height: int, model: CameraModel = "pinhole"
) -> Intrinsics:
    """Estimate focal lengths, principal point and distortion, with weak priors.

    The distortion is k1 k2 p1 p2 k3, or k1 k2 k3 k4 of a fisheye.
    """
    if len(views) < MIN_VIEWS:
        raise InputError(
            f"the board was detected in {len(views)} images, intrinsics take at least {MIN_VIEWS};"
            f" take 15 with the board tilted by 20 to 45 deg, or give `camera`"
        )
    views = _consistent(views, rough_camera(views, width, height, model))
    if len(views) < MIN_VIEWS:
        raise InputError(
            f"the corners of {len(views)} images are those of a flat board, intrinsics take at"
            f" least {MIN_VIEWS}; check `size`, or give `camera`"
        )
    camera = rough_camera(views, width, height, model)
    prior = LensPrior.usual(camera)
    bend = Bend.none(views)
    information = prior.information
    try:
        poses = [board_pose(view, camera) for view in views]
        for _ in range(_MAX_ROUNDS):
            sigma_px = CornerNoise.plain(poses).sigma_px
            change, information = lens_estimate(poses, sigma_px, camera, bend, prior)
            largest = np.abs(change[:2]).max()
            change = change * min(1.0, _MAX_FOCAL_STEP * camera.fx / largest)
            camera, bend = moved_lens(camera, bend, change)
            starts = [pose.camera_from_board for pose in poses]
            poses = fitted_poses(views, camera, starts, bend)
            if change @ information @ change < _CONVERGED:
                break
        stray = strays(views, poses, camera, bend)
        if np.concatenate(stray).any():
            views = [view[~mask] for view, mask in zip(views, stray, strict=True)]
            return calibrate_camera(views, width, height, model)
    except ValueError:
        raise InputError(_OPEN_FOCAL.format("")) from None
    covariance = normal_pseudo_inverse(information, 1e-13)
    focal_sigma = float(np.sqrt(np.diag(covariance)[:2].max()))
    if not focal_sigma < _MAX_FOCAL_SIGMA * camera.fx:
        focal = f" ({camera.fx:.0f} +- {focal_sigma:.0f} px)"
        raise InputError(_OPEN_FOCAL.format(focal))
    return Intrinsics(camera, focal_sigma)


def _consistent(
    views: Sequence[BoardView],
    camera: Camera,
) -> list[BoardView]:
    """Return the views that fit a pose of a flat board."""
    misfits = _misfits(views, camera)
    most = _MAX_MISFIT * np.median(misfits)
    if not most < np.inf:
        return []
    pairs = zip(views, misfits, strict=True)
    return [view for view, misfit in pairs if misfit <= most]


def _misfits(
    views: Sequence[BoardView],
    camera: Camera,
) -> Array:
    """Root mean square residuals of (n,) views, pixels; inf without a pose."""
    rms = np.full(len(views), np.inf)
    for i, view in enumerate(views):
        with suppress(ValueError):
            rms[i] = board_pose(view, camera).rms_px
    return rms


def _middle(
    width: int,
    height: int,
) -> Pair:
    return (width - 1) / 2, (height - 1) / 2


def rough_camera(
    views: Sequence[BoardView], width: int, height: int, model: CameraModel
) -> Camera:
    """Return a camera without distortion whose only unknown is the focal length."""
    import cv2

    middle = _middle(width, height)
    if model == "fisheye":
        focals = [width / 2 / np.deg2rad(half) for half in _HALF_ANGLES_DEG]
        cameras = [
            Camera(
                width,
                height,
                f,
                f,
                *middle,
                model=model,
            )
            for f in focals
        ]
        return min(cameras, key=lambda camera: np.median(_misfits(views, camera)))
    camera = Camera(width, height, width, width, *middle)
    points = [view.points_m.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    flags = (
        cv2.CALIB_USE_INTRINSIC_GUESS
        | cv2.CALIB_FIX_PRINCIPAL_POINT
        | cv2.CALIB_FIX_ASPECT_RATIO
        | cv2.CALIB_ZERO_TANGENT_DIST
        | cv2.CALIB_FIX_K1
        | cv2.CALIB_FIX_K2
        | cv2.CALIB_FIX_K3
    )
    size = (width, height)
    threads = cv2.getNumThreads()
    # With more threads, the answers of OpenCV 5.0 differ from call to call in the last bits.
    cv2.setNumThreads(1)
    try:
        _, matrix, *_ = cv2.calibrateCamera(
            points, pixels, size, camera.matrix(), np.zeros(5), flags=flags
        )
    except cv2.error:
        return camera
    finally:
        cv2.setNumThreads(threads)
    focal = float(matrix[0, 0])
    if not 0.1 * width < focal < 20 * width:
        return camera
    return replace(camera, fx=focal, fy=focal)
