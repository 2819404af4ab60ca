"""Pose of a board from its corners, with covariance.

Depth and tilt of a small board are far less certain than its direction, so hand-eye calibration
weights each pose by this covariance. Each pose also states what its corners say about the
intrinsics, see `evercal.calibration.boards.intrinsics`.
"""

from collections.abc import Sequence
from math import factorial
from typing import NamedTuple, TypeAlias

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from scipy.special import ndtri

from evercal.classes import frozen_arrays
from evercal.geometry import SE3, Camera, cross_matrix, norms
from evercal.geometry.normal_equations import normal_pseudo_inverse
from evercal.typing import Array, ArrayPair, BoolArray

MIN_SIGMA_PX = 0.02
"""Minimum standard deviation of a corner, due to errors of camera model and board."""
_STRAY_SIGMAS = 6.0
"""Distance of a stray corner from its neighbours, standard deviations."""
_NEIGHBOURS = 8
"""Number of neighbours that a residual is compared with."""
_MIN_TREND = 24
"""Minimum number of corners from whose residuals a cubic trend over the board is taken first."""
_MAX_STRAYS = 0.2
"""Maximum share of strays: a view with more is no view of the board."""
_MAX_ITERATIONS = 20
"""Maximum number of Gauss-Newton steps for the pose of a fisheye image."""
_MIN_STEP = 1e-10
"""Step, radians and metres, below which they end."""


@frozen_arrays
class BoardView:
    """Four or more corners of a board in one image."""

    points_m: Array
    """(k, 3) in the board frame, metres."""
    pixels: Array
    """(k, 2) x, y."""

    def __post_init__(self) -> None:
        points = np.asarray(self.points_m, float)
        pixels = np.asarray(self.pixels, float)
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

    def __getitem__(
        self,
        use: BoolArray,
    ) -> "BoardView":
        return BoardView(self.points_m[use], self.pixels[use])


Detection: TypeAlias = BoardView | str
"""The corners in an image, or the reason why there are none."""


class CornerSlopes(NamedTuple):
    """Derivatives of the (2 k,) coordinates of the corners of one image."""

    by_pose: Array
    """(2 k, 6) by the pose."""
    by_lens: Array
    """(2 k, q) by the intrinsics and the bend."""
    by_rows: Array
    """(2 k, 4) by motions of the last row of the image against the first: shifts in x and in y,
    and a roll and a zoom that shift what is one height from the principal point as far."""


@frozen_arrays
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
    slopes: CornerSlopes

    def weighted(
        self,
        row_ratio: float,
    ) -> "BoardPose":
        """Return the pose that allows for shifts that grow with the row.

        Args:
            row_ratio: Standard deviation of the shift over the image height, over that of a corner.
        """
        return _fitted(
            self.camera_from_board, self.residual_px.ravel(), self.slopes, row_ratio
        )

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
"""Powers of x and y of the terms of a bend."""
BEND = ("stretch", "shear", *(f"bend {'x' * i}{'y' * j}" for i, j in _POWERS))
"""Names of the terms of a `Bend`."""


class Bend(NamedTuple):
    """How a board departs from its drawing: its columns are stretched and sheared, and it is bent.

    z = size^2 times the sum of curvature x^i y^j / (i! j!). x and y are measured from the middle,
    in units of `size`.
    """

    middle: Array
    """(3,) metres."""
    size: float
    """Half of the longer side, metres."""
    terms: Array
    """(b,) in the order of `BEND`: a relative length, an angle in radians, and curvatures in
    1 / metres."""

    @classmethod
    def none(
        cls,
        views: Sequence[BoardView],
    ) -> "Bend":
        """Return the plane of a board that views show."""
        points = np.concatenate([view.points_m for view in views])
        half = np.ptp(points, axis=0) / 2
        return cls(
            points.min(0) + half,
            float(half.max()),
            np.zeros(len(BEND)),
        )

    def slopes(
        self,
        points: Array,
    ) -> Array:
        """Return the (k, 3, b) derivative of points (k, 3) by the terms."""
        x, y, _ = (points - self.middle).T / self.size
        bent = [x**i * y**j / (factorial(i) * factorial(j)) for i, j in _POWERS]
        slopes = np.zeros((len(points), 3, len(BEND)))
        slopes[:, 1, 0] = self.size * y
        slopes[:, 0, 1] = self.size * y
        slopes[:, 2, 2:] = self.size**2 * np.stack(bent, 1)
        return slopes


def lens_vector(camera: Camera) -> Array:
    """Return fx, fy, cx, cy and the distortion: 9 or 12 numbers, or 8 of a fisheye."""
    distortion = list(camera.distortion)
    terms = {"fisheye": 4, "pinhole": 5}[camera.model]
    distortion += [0.0] * (terms - len(distortion))
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *distortion])


def board_pose(
    view: BoardView, camera: Camera, start: SE3 | None = None, bend: Bend | None = None
) -> BoardPose:
    """Fit the pose of a board to its corners, from a start or from the better of its candidates."""
    if not start:
        starts = board_pose_candidates(view, camera)
        fits = (board_pose(view, camera, candidate, bend) for candidate in starts)
        return min(fits, key=lambda pose: pose.squared_px)
    bend = bend or Bend.none([view])
    by_bend = bend.slopes(view.points_m)
    points = view.points_m + by_bend @ bend.terms
    rotvec, translation = _refined(points, view.pixels, camera, start)
    projected, by_pose, by_camera = _projected(points, camera, rotvec, translation)
    rotation = Rotation.from_rotvec(np.ravel(rotvec))
    matrix = rotation.as_matrix()
    by_point = by_pose[:, 3:].reshape(-1, 2, 3)
    by_rotation = by_point @ (-matrix @ cross_matrix(points))
    jacobian = np.concatenate([by_point, by_rotation], 2).reshape(-1, 6)
    by_shape = by_point @ matrix @ by_bend
    by_lens = np.c_[by_camera, by_shape.reshape(-1, len(BEND))]
    slopes = CornerSlopes(jacobian, by_lens, _by_rows(view.pixels, camera))
    pose = SE3.of(rotation, np.ravel(translation))
    return _fitted(pose, (view.pixels - projected).ravel(), slopes)


def _by_rows(
    pixels: Array,
    camera: Camera,
) -> Array:
    """Return (2 k, 4) shifts in x and y, a roll and a zoom that grow with the row."""
    x, y = ((pixels - [camera.cx, camera.cy]) / camera.height).T
    one = np.ones_like(x)
    zero = np.zeros_like(x)
    moves = np.array([[one, zero, -y, x], [zero, one, x, y]])
    return (y * moves).transpose(2, 0, 1).reshape(-1, 4)


def _fitted(
    pose: SE3, residual: Array, slopes: CornerSlopes, row_ratio: float = 0.0
) -> BoardPose:
    """One step of weighted least squares from residuals (2 k,); see `BoardPose.weighted`."""
    jacobian, by_lens, by_rows = slopes
    axes, sizes, _ = np.linalg.svd(by_rows, full_matrices=False)
    shrunk = axes * (1 - (1 + (row_ratio * sizes) ** 2) ** -0.5)

    def whitened(values: Array) -> Array:
        return values - shrunk @ (axes.T @ values)

    white = whitened(jacobian)
    covariance = normal_pseudo_inverse(white.T @ white, 1e-12)
    gain = covariance @ white.T
    step = gain @ whitened(residual)
    lens_slope = -gain @ whitened(by_lens)
    unexplained = whitened(by_lens + jacobian @ lens_slope)
    moved = SE3(pose.rotation_wxyz, pose.translation_m + step[:3])
    return BoardPose(
        camera_from_board=moved @ SE3.exp(np.r_[np.zeros(3), step[3:]]),
        unit_covariance=(covariance + covariance.T) / 2,
        residual_px=(residual - jacobian @ step).reshape(-1, 2),
        lens_slope=lens_slope,
        lens_normal=unexplained.T @ unexplained,
        lens_gradient=unexplained.T @ whitened(residual),
        slopes=slopes,
    )


def _refined(points: Array, pixels: Array, camera: Camera, start: SE3) -> ArrayPair:
    """Rotation vector and translation (3, 1) of the board that fit its corners best."""
    import cv2

    rotvec = start.rotation.as_rotvec().reshape(3, 1)
    translation = start.translation_m.reshape(3, 1).copy()
    if camera.model == "pinhole":
        distortion = lens_vector(camera)[4:]
        rotvec, translation = cv2.solvePnPRefineLM(
            points, pixels, camera.matrix(), distortion, rotvec, translation
        )
        return np.asarray(rotvec, float), np.asarray(translation, float)
    for _ in range(_MAX_ITERATIONS):
        projected, by_pose, _ = _projected(points, camera, rotvec, translation)
        step = np.linalg.lstsq(by_pose, (pixels - projected).ravel(), rcond=None)[0]
        rotvec = rotvec + step[:3, None]
        translation = translation + step[3:, None]
        if np.abs(step).max() < _MIN_STEP:
            break
    return rotvec, translation


def _projected(
    points: Array, camera: Camera, rotvec: Array, translation: Array
) -> tuple[Array, Array, Array]:
    """Pixels (k, 2) and their derivatives (2 k, 6) by the pose and (2 k, q) by the intrinsics."""
    import cv2

    matrix = camera.matrix()
    distortion = lens_vector(camera)[4:]
    if camera.model == "fisheye":
        pixels, slopes = cv2.fisheye.projectPoints(
            points[:, None].copy(), rotvec, translation, matrix, distortion
        )
        by_camera, by_pose, _ = np.split(np.asarray(slopes, float), [8, 14], 1)
    else:
        pixels, slopes, *_ = cv2.projectPoints(
            points, rotvec, translation, matrix, distortion
        )
        by_pose, by_camera = np.split(np.asarray(slopes, float), [6], 1)
    pixels = np.reshape(pixels, (-1, 2)).astype(float)
    return pixels, by_pose, by_camera[:, : 4 + len(distortion)]


def board_pose_candidates(
    view: BoardView,
    camera: Camera,
) -> list[SE3]:
    """Return the possible poses of the board: up to three for a flat board, else mostly one."""
    import cv2

    thickness = np.linalg.svd(view.points_m - view.points_m.mean(0), compute_uv=False)
    solvers = [cv2.SOLVEPNP_SQPNP]
    if thickness[2] < 1e-6 * thickness[0]:
        # Both poses of IPPE are wrong for a small board that faces the camera.
        solvers.insert(0, cv2.SOLVEPNP_IPPE)
    distortion = np.array(camera.distortion)
    if camera.model == "fisheye":
        rays = camera.unproject(view.pixels)
        within = np.isfinite(rays).all(1)
        # ValueError if fewer than four are left.
        view = BoardView(
            view.points_m[within],
            camera.pinhole.project(rays[within]),
        )
        distortion = np.zeros(0)
    poses = []
    for solver in solvers:
        _, rotvecs, translations, _ = cv2.solvePnPGeneric(
            view.points_m, view.pixels, camera.matrix(), distortion, flags=solver
        )
        for rotvec, translation in zip(rotvecs, translations, strict=True):
            if not np.isfinite([rotvec, translation]).all():
                continue
            rotation = Rotation.from_rotvec(np.ravel(rotvec))
            pose = SE3.of(rotation, np.ravel(translation), canonical=False)
            # The origin may be behind the camera, where points are those of a base.
            if pose.apply(view.points_m)[:, 2].mean() > 0:
                poses.append(pose)
    return poses


def strays(
    views: Sequence[BoardView],
    poses: Sequence[BoardPose],
    camera: Camera,
    bend: Bend | None = None,
) -> list[BoolArray]:
    """Return (k,) of every view: whether a corner leaves its neighbours by many sigma.

    Residuals of camera model and board are smooth, so they are no reason. Each stray is left out
    before the next is searched, because it moves the pose and with it the residuals around it.
    """
    usual = np.median([_apart(*pair)[1] for pair in zip(views, poses, strict=True)])
    stray = []
    for view, fit in zip(views, poses, strict=True):
        pose = fit
        keep = np.ones(fit.corners, bool)
        apart, sigma = _apart(view, pose)
        while apart.max() > _STRAY_SIGMAS * max(sigma, usual):
            keep[np.flatnonzero(keep)[apart.argmax()]] = False
            if keep.mean() <= 1 - _MAX_STRAYS or keep.sum() <= _NEIGHBOURS:
                keep[:] = True
                break
            pose = board_pose(
                view[keep],
                camera,
                pose.camera_from_board,
                bend,
            )
            apart, sigma = _apart(view[keep], pose)
        stray.append(~keep)
    return stray


def _apart(
    view: BoardView,
    pose: BoardPose,
) -> tuple[Array, float]:
    """Return distances (k,) of the residuals from the median of their neighbours, and sigma."""
    residual = pose.residual_px
    if pose.corners >= _MIN_TREND:
        # A lens, a print or a shutter that the model lacks moves whole parts of the board.
        x, y, _ = (view.points_m - view.points_m.mean(0)).T / np.ptp(view.points_m)
        trend = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], 1)
        residual = residual - trend @ np.linalg.lstsq(trend, residual, rcond=None)[0]
    count = min(_NEIGHBOURS + 1, pose.corners)
    near = np.asarray(KDTree(view.points_m).query(view.points_m, count)[1])
    apart = residual - np.median(residual[near[:, 1:]], 1)
    sigma = float(np.median(np.abs(apart)) / ndtri(0.75))
    return norms(apart), max(sigma, MIN_SIGMA_PX)
