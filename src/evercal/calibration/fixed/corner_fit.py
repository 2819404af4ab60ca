"""Poses of a board by the corners of one camera, with the errors that all of them share."""

from typing import NamedTuple

import numpy as np

from evercal.calibration.boards.corners import BEND, board_pose, board_pose_candidates
from evercal.calibration.boards.intrinsics import lens_estimate, moved_lens
from evercal.calibration.pose_pairs.pairs import BoardCorners, Measured, measured
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_distance
from evercal.typing import Array

_USUAL_PX = 0.3
"""Usual noise of a corner, which counts as much as `_FREEDOM` residuals."""
_FREEDOM = 4.0
_ROUNDS = 3
"""Changes of the intrinsics."""
_NO_PRINT = 1e18
"""Information on the shape of points that are no print."""
_WORSE = 25.0
"""Squared residuals, of corner noise, by which the second pose of a flat board is worse."""
_OTHER_RAD = np.deg2rad(4.0)
"""Angle above which two poses of a flat board are different ones."""


class CornerFit(NamedTuple):
    """Board poses with their errors."""

    lens: Measured
    poses: SE3
    """(n,) camera_from_board."""
    covariance: Array
    """(n, 6, 6) by the noise of the corners."""
    slopes: Array
    """(n, 6, q) by errors of intrinsics and print of one standard deviation each."""
    sigma_px: float
    freedom: float
    """Degrees of freedom of the noise."""
    corners: BoardCorners

    @property
    def lenses(self) -> dict[str, Camera]:
        """Intrinsics by origin, see `Calibration`."""
        known = {"estimated": self.lens.camera}
        if self.corners.stated:
            known["stated"] = self.corners.camera
        return known

    def require_one_pose(self) -> None:
        """Refuse corners that fit two poses alike, in another order or as a flat board."""
        evidence = 0.0
        angle = 0.0
        for view, best in zip(self.corners.views, self.lens.poses, strict=True):
            if self.corners.turned(view):
                raise InputError(
                    "this chessboard looks the same after a turn, so the camera may be at either"
                    " side of it; use a tag, a ChArUco board, or a chessboard whose numbers of"
                    " corners are even one way and odd the other"
                )
            worse = np.inf
            for start in board_pose_candidates(view, self.lens.camera):
                other = board_pose(view, self.lens.camera, start, self.lens.bend)
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


def corner_fit(
    corners: BoardCorners,
    starts: SE3,
    touched_px: float = 0.0,
) -> CornerFit:
    """Estimate poses and intrinsics.

    What was touched is neither bent nor stretched; `touched_px` is the usual noise of its pixels.
    """
    prior = corners.prior
    if touched_px:
        prior.information[-len(BEND) :, -len(BEND) :] = _NO_PRINT * np.eye(len(BEND))
    usual_px = touched_px or _USUAL_PX
    lens = measured(corners, corners.camera, starts)
    freedom = sum(2 * pose.corners - 6 for pose in lens.poses)
    sigma_px = usual_px
    information = prior.information
    for _ in range(_ROUNDS):
        squared = _FREEDOM * usual_px**2 + freedom * lens.sigma_px**2
        sigma_px = float(np.sqrt(squared / (_FREEDOM + freedom)))
        change, information = lens_estimate(
            lens.poses, sigma_px, lens.camera, lens.bend, prior
        )
        camera, bend = moved_lens(lens.camera, lens.bend, change)
        # With other intrinsics, the other pose of a flat board may be the better one.
        again = lens.poses
        if not touched_px:
            again = [board_pose(view, camera, None, bend) for view in corners.views]
        starts = SE3.stack([pose.camera_from_board for pose in again])
        lens = measured(corners, camera, starts, bend)
    # Scaled, as information on a bend and on a focal length differ by orders of magnitude.
    unit = 1 / np.sqrt(information.diagonal())
    root = np.linalg.cholesky(information * unit * unit[:, None])
    slopes = np.stack([pose.lens_slope for pose in lens.poses])
    return CornerFit(
        lens,
        SE3.stack([pose.camera_from_board for pose in lens.poses]),
        sigma_px**2 * np.stack([pose.unit_covariance for pose in lens.poses]),
        slopes @ (unit[:, None] * np.linalg.inv(root).T),
        sigma_px,
        _FREEDOM + freedom,
        corners,
    )
