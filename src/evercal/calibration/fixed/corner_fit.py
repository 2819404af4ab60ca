"""Poses of a board by the corners of one camera, with the errors that all of them share."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.stats import chi2, f

from evercal.calibration.boards.corners import (
    BEND,
    Bend,
    BoardPose,
    board_pose,
    board_pose_candidates,
)
from evercal.calibration.boards.intrinsics import lens_estimate, moved_lens
from evercal.calibration.boards.row_shift import CornerNoise
from evercal.calibration.pose_pairs.pairs import BoardCorners
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, UncertainPose, pose_distance
from evercal.typing import Array

_USUAL_PX = 0.3
"""Usual noise of a corner, which counts as much as `_FREEDOM` residuals."""
_FREEDOM = 4.0
_ROUNDS = 4
"""Fits of the poses, between which the intrinsics change."""
_NO_PRINT = 1e18
"""Information on the shape of points that are no print."""
_WORSE = 25.0
"""Squared residuals, of corner noise, by which the second pose of a flat board is worse."""
_OTHER_RAD = np.deg2rad(4.0)
"""Angle above which two poses of a flat board are different ones."""


class CornerFit(NamedTuple):
    """Board poses with their errors."""

    corners: BoardCorners
    camera: Camera
    bend: Bend
    fits: list[BoardPose]
    sigma_px: float
    freedom: float
    """Degrees of freedom of the noise."""
    slopes: Array
    """(n, 6, q) by errors of intrinsics and print of one standard deviation each."""

    @property
    def poses(self) -> SE3:
        """(n,) camera_from_board."""
        return SE3.stack([fit.camera_from_board for fit in self.fits])

    @property
    def covariance(self) -> Array:
        """(n, 6, 6) by the noise of the corners."""
        return self.sigma_px**2 * np.stack([fit.unit_covariance for fit in self.fits])

    @property
    def first(self) -> UncertainPose:
        """The first camera_from_board, with all its errors."""
        slopes = self.slopes[0]
        covariance = self.covariance[0] + slopes @ slopes.T
        return UncertainPose(self.poses[0], widening(self.freedom) * covariance)

    @property
    def lenses(self) -> dict[str, Camera]:
        """Intrinsics by origin, see `Calibration`."""
        known = {"estimated": self.camera}
        if self.corners.stated:
            known["stated"] = self.corners.camera
        return known

    def require_one_pose(self) -> None:
        """Refuse corners that fit two poses alike, in another order or as a flat board."""
        evidence = 0.0
        angle = 0.0
        for view, best in zip(self.corners.views, self.fits, strict=True):
            if self.corners.turned(view):
                raise InputError(
                    "this chessboard looks the same after a turn, so the camera may be at either"
                    " side of it; use a tag, a ChArUco board, or a chessboard whose numbers of"
                    " corners are even one way and odd the other"
                )
            worse = np.inf
            for start in board_pose_candidates(view, self.camera):
                other = board_pose(view, self.camera, start, self.bend)
                turn = pose_distance(best.camera_from_board, other.camera_from_board)[1]
                if turn > _OTHER_RAD:
                    worse = min(worse, other.squared_px - best.squared_px)
                    angle = float(np.rad2deg(turn))
            evidence += worse / self.sigma_px**2
        if evidence < _WORSE:
            raise InputError(
                f"the corners fit two poses {angle:.0f} deg apart alike, as those of flat things do"
                " that are small in the image or face the camera: tilt the board by 30 deg, go"
                " nearer, or use a larger one"
            )


def widening(freedom: float) -> float:
    """Factor of the covariance (6, 6) of a pose whose noise was estimated with few freedoms."""
    return float(6 * f.isf(0.05, 6, freedom) / chi2.isf(0.05, 6))


def corner_fit(
    corners: BoardCorners,
    touched_px: float = 0.0,
) -> CornerFit:
    """Estimate poses and intrinsics.

    What was touched is neither bent nor stretched; `touched_px` is the usual noise of its pixels.
    """
    prior = corners.prior
    if touched_px:
        prior.information[-len(BEND) :, -len(BEND) :] = _NO_PRINT * np.eye(len(BEND))
    usual_px = touched_px or _USUAL_PX
    camera = corners.camera
    bend = Bend.none(corners.views)
    change = np.zeros(len(prior.mean))
    rounds = 0
    while True:
        camera, bend = moved_lens(camera, bend, change)
        # With other intrinsics, the other pose of a flat board may be the better one.
        fits = [board_pose(view, camera, None, bend) for view in corners.views]
        freedom = sum(2 * fit.corners - 6 for fit in fits)
        squared = freedom * CornerNoise.plain(fits).sigma_px ** 2
        squared += _FREEDOM * usual_px**2
        sigma_px = float(np.sqrt(squared / (_FREEDOM + freedom)))
        change, information = lens_estimate(fits, sigma_px, camera, bend, prior)
        rounds += 1
        if rounds == _ROUNDS:
            break
    slopes = np.stack([fit.lens_slope for fit in fits])
    root = np.linalg.cholesky(information)
    by_lens = solve_triangular(root, slopes.reshape(-1, len(root)).T, lower=True)
    slopes = by_lens.T.reshape(slopes.shape)
    return CornerFit(corners, camera, bend, fits, sigma_px, _FREEDOM + freedom, slopes)
