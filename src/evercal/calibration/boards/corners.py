"""Pose of a board from its corners, with covariance, and intrinsics from views of a board.

Depth and tilt of a small board are far less certain than its direction, so hand-eye calibration
weights each pose by this covariance. Eliminating the poses from the normal equations leaves the
information on the intrinsics (the Schur complement of bundle adjustment); a prior is added to it.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import factorial
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from evercal.choices import CameraModel
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, cross_matrix
from evercal.geometry.camera import COEFFICIENTS
from evercal.typing import Array, BoolArray

_LEAST_PX = 0.02
"""Minimum standard deviation of a corner, due to errors of lens model and board."""
_STRAY, _NEIGHBOURS, _FEW_STRAYS = 6.0, 8, 0.2
"""Distance of a stray corner from its neighbours, standard deviations; number of neighbours; a view
with a larger share of strays is no view of the board."""


@dataclass(frozen=True, eq=False)
class BoardView:
    """Four or more corners of a board in one image."""

    points_m: Array
    """(k, 3) in the board frame, metres."""
    pixels: Array
    """(k, 2) x, y."""

    def __post_init__(self) -> None:
        points = np.asarray(self.points_m, dtype=np.float64)
        pixels = np.asarray(self.pixels, dtype=np.float64)
        if (
            points.shape[1:] != (3,)
            or pixels.shape != (len(points), 2)
            or len(points) < 4
        ):
            raise ValueError(
                f"a view takes four corners or more, points (k, 3) and pixels (k, 2), got shapes"
                f" {points.shape} and {pixels.shape}"
            )
        object.__setattr__(self, "points_m", points)
        object.__setattr__(self, "pixels", pixels)

    def __getitem__(self, use: BoolArray) -> "BoardView":
        return BoardView(self.points_m[use], self.pixels[use])


@dataclass(frozen=True, eq=False)
class BoardPose:
    """Least-squares pose of the board in one image."""

    camera_from_board: SE3
    unit_covariance: Array
    """(6, 6) covariance for a corner noise of one pixel: (translation in the camera frame, metres;
    rotation about the board's axes, radians)."""
    residual_px: Array
    """(k, 2) residuals of the corners."""
    lens_slope: Array
    """(6, q) derivative of the pose by fx, fy, cx, cy, the distortion coefficients and the bend."""
    lens_normal: Array
    """(q, q) information on the intrinsics for a corner noise of one pixel, the pose unknown."""
    lens_gradient: Array
    """(q,) `lens_normal` times the change of the intrinsics that fits the corners best."""

    @property
    def corners(self) -> int:
        """Number of corners."""
        return len(self.residual_px)

    @property
    def squared_px(self) -> float:
        """Sum of squared residuals of all coordinates."""
        return float((self.residual_px**2).sum())

    @property
    def rms_px(self) -> float:
        """Root mean square reprojection error."""
        return float(np.sqrt(self.squared_px / self.corners))


_POWERS = [(i, order - i) for order in (2, 3, 4) for i in range(order + 1)]
BEND = tuple(f"bend {'x' * i}{'y' * j}" for i, j in _POWERS)


class Bend(NamedTuple):
    """How a board departs from a plane: z = size^2 times the sum of curvature x^i y^j / (i! j!).

    x and y are measured from the middle, in units of `size`.
    """

    middle: Array
    """(3,) metres."""
    size: float
    """Half of the longer side, metres."""
    curvature: Array
    """(b,) 1 / metres, in the order of `BEND`."""

    @classmethod
    def none(cls, views: Sequence[BoardView]) -> "Bend":
        """Return the plane of a board that views show."""
        points = np.concatenate([view.points_m for view in views])
        half = np.ptp(points, axis=0) / 2
        return cls(points.min(0) + half, float(half.max()), np.zeros(len(BEND)))

    def slopes(self, points: Array) -> Array:
        """Return the (k, b) derivative of z of points (k, 3) by the curvature."""
        x, y, _ = (points - self.middle).T / self.size
        terms = [x**i * y**j / (factorial(i) * factorial(j)) for i, j in _POWERS]
        return self.size**2 * np.stack(terms, 1)


def board_pose(
    view: BoardView, camera: Camera, start: SE3 | None = None, bend: Bend | None = None
) -> BoardPose:
    """Fit the pose of a board to its corners, from a start or from the better of its candidates."""
    if start is None:
        starts = board_pose_candidates(view, camera)
        fits = (board_pose(view, camera, s, bend) for s in starts)
        return min(fits, key=lambda pose: pose.squared_px)
    bend = bend or Bend.none([view])
    by_bend = bend.slopes(view.points_m)
    points = view.points_m + np.outer(by_bend @ bend.curvature, [0, 0, 1])
    rotvec, translation = _refined(points, view.pixels, camera, start)
    projected, by_pose, by_camera = _projected(points, camera, rotvec, translation)
    rotation = Rotation.from_rotvec(np.ravel(rotvec))
    by_point = by_pose[:, 3:].reshape(-1, 2, 3)
    by_rotation = by_point @ (-rotation.as_matrix() @ cross_matrix(points))
    jacobian = np.concatenate([by_point, by_rotation], 2).reshape(-1, 6)
    error = (view.pixels - projected).ravel()
    normal = jacobian.T @ jacobian
    unit = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    covariance = np.outer(unit, unit) * np.linalg.pinv(
        normal * np.outer(unit, unit), 1e-12
    )
    by_z = by_point @ rotation.as_matrix()[:, 2:]
    by_lens = np.c_[by_camera, (by_z * by_bend[:, None]).reshape(-1, len(BEND))]
    lens_slope = -covariance @ (jacobian.T @ by_lens)
    unexplained = by_lens + jacobian @ lens_slope
    return BoardPose(
        camera_from_board=SE3.of(rotation, np.ravel(translation)),
        unit_covariance=(covariance + covariance.T) / 2,
        residual_px=error.reshape(-1, 2),
        lens_slope=lens_slope,
        lens_normal=unexplained.T @ unexplained,
        lens_gradient=unexplained.T @ error,
    )


def _refined(
    points: Array, pixels: Array, camera: Camera, start: SE3
) -> tuple[Array, Array]:
    """Rotation vector and translation (3, 1) of the board that fit its corners best."""
    import cv2

    rotvec = start.rotation.as_rotvec().reshape(3, 1)
    translation = start.translation_m.reshape(3, 1).copy()
    if camera.model == "pinhole":
        lens = camera.matrix(), lens_vector(camera)[4:]
        refined = cv2.solvePnPRefineLM(
            points, pixels, *lens, rotvec.copy(), translation
        )
        return np.asarray(refined[0], np.float64), np.asarray(refined[1], np.float64)
    for _ in range(20):  # Gauss and Newton
        projected, by_pose, _ = _projected(points, camera, rotvec, translation)
        step = np.linalg.lstsq(by_pose, (pixels - projected).ravel(), rcond=None)[0]
        rotvec = rotvec + step[:3, None]
        translation = translation + step[3:, None]
        if np.abs(step).max() < 1e-10:
            break
    return rotvec, translation


def _projected(
    points: Array, camera: Camera, rotvec: Array, translation: Array
) -> tuple[Array, Array, Array]:
    """Pixels (k, 2) and their derivatives (2 k, 6) by the pose and (2 k, q) by the intrinsics."""
    import cv2

    matrix = camera.matrix()
    terms = lens_vector(camera)[4:]
    if camera.model == "fisheye":
        at = points[:, None].copy()
        pixels, slopes = cv2.fisheye.projectPoints(
            at, rotvec, translation, matrix, terms
        )
        by_camera, by_pose = np.split(np.asarray(slopes, np.float64)[:, :14], [8], 1)
    else:
        pixels, slopes, *_ = cv2.projectPoints(
            points, rotvec, translation, matrix, terms
        )
        by_pose, by_camera = np.split(np.asarray(slopes, np.float64), [6], 1)
    return (
        np.reshape(pixels, (-1, 2)).astype(float),
        by_pose,
        by_camera[:, : 4 + len(terms)],
    )


def board_pose_candidates(view: BoardView, camera: Camera) -> list[SE3]:
    """Return the possible poses of the board: up to three for a flat board, else mostly one."""
    import cv2

    thickness = np.linalg.svd(view.points_m - view.points_m.mean(0), compute_uv=False)
    flat = thickness[2] < 1e-6 * thickness[0]
    # Both poses of IPPE are wrong for a small board that faces the camera.
    solvers = (cv2.SOLVEPNP_IPPE, cv2.SOLVEPNP_SQPNP) if flat else (cv2.SOLVEPNP_SQPNP,)
    lens = camera.matrix(), np.array(camera.distortion)
    if camera.model == "fisheye":
        rays = camera.unproject(view.pixels)
        within = np.isfinite(rays).all(1)
        # ValueError if fewer than four are left.
        view = BoardView(view.points_m[within], camera.pinhole.project(rays[within]))
        lens = camera.matrix(), np.zeros(0)
    poses = []
    for solver in solvers:
        found = cv2.solvePnPGeneric(view.points_m, view.pixels, *lens, flags=solver)
        for rotvec, translation in zip(*found[1:3], strict=True):
            if (
                np.isfinite(rotvec).all()
                and np.isfinite(translation).all()
                and translation[2] > 0
            ):
                rotation = Rotation.from_rotvec(np.ravel(rotvec))
                poses.append(SE3.of(rotation, np.ravel(translation), canonical=False))
    return poses


def pixel_sigma(poses: Sequence[BoardPose]) -> float:
    """Return the standard deviation of a corner coordinate in pixels, over images that fit well."""
    squared = np.array([pose.squared_px for pose in poses])
    freedom = np.array([max(2 * pose.corners - 6, 1) for pose in poses])
    inliers = squared / freedom <= 4 * np.median(squared / freedom) + 1e-12
    return max(
        float(np.sqrt(squared[inliers].sum() / freedom[inliers].sum())), _LEAST_PX
    )


def strays(
    views: Sequence[BoardView],
    poses: Sequence[BoardPose],
    camera: Camera,
    bend: Bend | None = None,
) -> list[BoolArray]:
    """Return (k,) of every view: whether a corner leaves its neighbours by many sigma.

    Residuals of lens and board are smooth, so they are no reason. Each is left out before the next
    is looked for, because it moves the pose and with it the residuals around it.
    """
    usual = np.median([_apart(*both)[1] for both in zip(views, poses, strict=True)])
    stray = []
    for view, fit in zip(views, poses, strict=True):
        pose = fit
        keep = np.ones(fit.corners, dtype=bool)
        apart, typical = _apart(view, pose)
        while apart.max() > _STRAY * max(typical, usual):
            keep[np.flatnonzero(keep)[apart.argmax()]] = False
            if keep.mean() <= 1 - _FEW_STRAYS or keep.sum() <= _NEIGHBOURS:
                keep[:] = True
                break
            pose = board_pose(view[keep], camera, pose.camera_from_board, bend)
            apart, typical = _apart(view[keep], pose)
        stray.append(~keep)
    return stray


def _apart(view: BoardView, pose: BoardPose) -> tuple[Array, float]:
    """Return distances (k,) of the residuals from the median of their neighbours, and sigma."""
    count = min(_NEIGHBOURS + 1, pose.corners)
    near = np.asarray(KDTree(view.points_m).query(view.points_m, count)[1])
    apart = pose.residual_px - np.median(pose.residual_px[near[:, 1:]], 1)
    sigma = float(np.median(np.abs(apart)) / norm.ppf(0.75))
    return np.linalg.norm(apart, axis=1), max(sigma, _LEAST_PX)


LENS = {name: ("fx", "fy", "cx", "cy", *terms) for name, terms in COEFFICIENTS.items()}
"""Names of the intrinsics of each model."""
MIN_VIEWS = 5
"""Minimum number of views of a flat board."""
_USUAL_CENTRE, _USUAL_ASPECT, _ROUGH_FOCAL = 0.1, 0.02, 0.5
"""Standard deviations of the principal point from the middle of the image, in widths, of the ratio
of both focal lengths from one, and of a rough focal length, relative."""
_USUAL_DISTORTION = (0.3, 0.5, 2e-3, 2e-3, 0.5, 0.1, 0.1, 0.1)
_USUAL_FISHEYE = (0.1, 0.1, 0.1, 0.1)
_STATED_FISHEYE = (0.01, 0.01, 0.01, 0.01)
_STATED = 0.005
"""Standard deviation of a stated focal length and principal point, relative to the focal length."""
_STATED_DISTORTION = (0.02, 0.05, 5e-4, 5e-4, 0.1, 0.02, 0.02, 0.02)
_USUAL_BEND = 0.15
"""Standard deviation of the curvatures of a board, 1 / metres: over 300 mm, the second
order moves the edges by 1.7 mm, the third by 0.6 mm and the fourth by 0.1 mm."""
_HALF_ANGLES_DEG = (35, 45, 55, 65, 75, 85, 95, 110)
"""Half of the horizontal field of view of a fisheye, the first one is the nearest of these."""
_FOCAL_SIGMA = 0.1
"""Maximum relative standard deviation of the focal length."""
_FALSE = 10.0
"""Residual of a false detection, in medians of all views."""
_ROUNDS = 25


class LensPrior(NamedTuple):
    """A Gaussian over the (q,) intrinsics in the order of `LENS`, and the bend of the board."""

    mean: Array
    information: Array
    """(q, q) inverse covariance."""

    @classmethod
    def stated(cls, camera: Camera) -> "LensPrior":
        """Prior of intrinsics from the maker or from another calibration."""
        terms = _STATED_FISHEYE if camera.model == "fisheye" else _STATED_DISTORTION
        return cls._around(lens_vector(camera), _STATED * camera.fx, terms)

    @classmethod
    def usual(cls, camera: Camera) -> "LensPrior":
        """Prior of unknown intrinsics; `camera` gives image size and a rough focal length."""
        mean = np.zeros(len(lens_vector(camera)))
        mean[:2] = camera.fx
        mean[2:4] = (camera.width - 1) / 2, (camera.height - 1) / 2
        terms = _USUAL_FISHEYE if camera.model == "fisheye" else _USUAL_DISTORTION
        prior = cls._around(mean, _USUAL_CENTRE * camera.width, terms)
        aspect = np.array([[1.0, -1.0], [-1.0, 1.0]]) / (_USUAL_ASPECT * camera.fx) ** 2
        prior.information[:2, :2] = aspect + np.eye(2) / (_ROUGH_FOCAL * camera.fx) ** 2
        return prior

    @classmethod
    def _around(
        cls, mean: Array, sigma_px: float, sigma_terms: Sequence[float]
    ) -> "LensPrior":
        sigma = np.r_[np.full(4, sigma_px), sigma_terms][: len(mean)]
        sigma = np.r_[sigma, np.full(len(BEND), _USUAL_BEND)]
        return cls(np.r_[mean, np.zeros(len(BEND))], np.diag(sigma**-2.0))


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
) -> tuple[Array, Array]:
    """Estimate the change (q,) of the intrinsics and the bend that board poses were fitted with.

    Also return the information (q, q) of the corners and the prior.
    """
    variance = sigma_px**2
    information = (
        np.sum([pose.lens_normal for pose in poses], 0) / variance + prior.information
    )
    right = np.sum([pose.lens_gradient for pose in poses], 0) / variance
    right = right + prior.information @ (
        prior.mean - np.r_[lens_vector(camera), bend.curvature]
    )
    unit = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information * np.outer(unit, unit)
    return unit * np.linalg.lstsq(scaled, unit * right, rcond=1e-13)[0], information


def lens_vector(camera: Camera) -> Array:
    """Return the intrinsics in the order of `LENS`: 9 or 12, or 8 of a fisheye."""
    distortion = np.zeros(
        max(4 if camera.model == "fisheye" else 5, len(camera.distortion))
    )
    distortion[: len(camera.distortion)] = camera.distortion
    return np.r_[camera.fx, camera.fy, camera.cx, camera.cy, distortion]


def moved_lens(camera: Camera, bend: Bend, change: Array) -> tuple[Camera, Bend]:
    """Return camera and bend after a (q,) change; ValueError without a positive focal length."""
    curvature = bend.curvature + change[-len(BEND) :]
    return moved_camera(camera, change[: -len(BEND)]), bend._replace(
        curvature=curvature
    )


def moved_camera(camera: Camera, change: Array) -> Camera:
    """Return the camera after a change of its intrinsics."""
    fx, fy, cx, cy, *distortion = (
        float(value) for value in lens_vector(camera) + change
    )
    return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(distortion))


def calibrate_camera(
    views: Sequence[BoardView], width: int, height: int, model: CameraModel = "pinhole"
) -> Intrinsics:
    """Estimate focal lengths, principal point and distortion, with weak priors.

    The distortion is k1 k2 p1 p2 k3, or k1 k2 k3 k4 of a fisheye.
    """
    if len(views) < MIN_VIEWS:
        raise InputError(
            f"the board was detected in {len(views)} images, intrinsics take at least {MIN_VIEWS};"
            f" take 15 with the board tilted by 20 to 45 deg, or give --camera"
        )
    views = _consistent(views, _rough(views, width, height, model))
    if len(views) < MIN_VIEWS:
        raise InputError(
            f"the corners of {len(views)} images are those of a flat board, intrinsics take at"
            f" least {MIN_VIEWS}; check --size, or give --camera"
        )
    camera = _rough(views, width, height, model)
    prior = LensPrior.usual(camera)
    bend = Bend.none(views)
    open_focal = (
        "the images leave the focal length open{}; tilt the board by 20 to 45 deg in several"
        " directions, or give --camera"
    )
    information = prior.information
    try:
        poses = [board_pose(view, camera) for view in views]
        for _ in range(_ROUNDS):
            change, information = lens_estimate(
                poses, pixel_sigma(poses), camera, bend, prior
            )
            change = change * min(1.0, 0.2 * camera.fx / np.abs(change[:2]).max())
            camera, bend = moved_lens(camera, bend, change)
            starts = [pose.camera_from_board for pose in poses]
            poses = [
                board_pose(v, camera, s, bend)
                for v, s in zip(views, starts, strict=True)
            ]
            if change @ information @ change < 1e-4:
                break
        stray = strays(views, poses, camera, bend)
        if np.concatenate(stray).any():
            used = [view[~mask] for view, mask in zip(views, stray, strict=True)]
            return calibrate_camera(used, width, height, model)
    except ValueError:
        raise InputError(open_focal.format("")) from None
    unit = 1 / np.sqrt(np.diag(information))
    scaled = np.linalg.pinv(information * np.outer(unit, unit), 1e-13, hermitian=True)
    focal = float(np.sqrt((np.diag(scaled) * unit**2)[:2].max()))
    if not focal < _FOCAL_SIGMA * camera.fx:
        raise InputError(open_focal.format(f" ({camera.fx:.0f} +- {focal:.0f} px)"))
    return Intrinsics(camera, focal)


def _consistent(views: Sequence[BoardView], camera: Camera) -> list[BoardView]:
    rms = _misfits(views, camera)
    most = _FALSE * np.median(rms)
    return [
        view for view, error in zip(views, rms, strict=True) if error <= most < np.inf
    ]


def _misfits(views: Sequence[BoardView], camera: Camera) -> Array:
    """Root mean square residuals of (n,) views, pixels; inf without a pose."""
    rms = np.full(len(views), np.inf)
    for i, view in enumerate(views):
        with suppress(ValueError):
            rms[i] = board_pose(view, camera).rms_px
    return rms


def _rough(
    views: Sequence[BoardView], width: int, height: int, model: CameraModel
) -> Camera:
    """Return a camera without distortion whose only unknown is the focal length."""
    import cv2

    if model == "fisheye":
        centre = (width - 1) / 2, (height - 1) / 2
        focals = [width / 2 / np.deg2rad(half) for half in _HALF_ANGLES_DEG]
        fits = [Camera(width, height, f, f, *centre, model=model) for f in focals]
        return min(fits, key=lambda camera: np.median(_misfits(views, camera)))
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
    return (
        replace(middle, fx=focal, fy=focal)
        if 0.1 * width < focal < 20 * width
        else middle
    )
