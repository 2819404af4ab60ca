"""Pose pairs whose camera poses were measured by the corners of a board.

With the intrinsics as extras, the hand-eye equation is the full reprojection problem: what the
corners say about them, and the derivative of each pose by them, come from `boards.corners`.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.boards.corners import BoardPose, BoardView, board_pose, pixel_sigma
from evercal.calibration.boards.intrinsics import LENS, LensPrior, lens_estimate
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.pose_equation import Extras
from evercal.geometry import SE3, Camera

Array = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class BoardCorners:
    """Board corners of the images of pose pairs."""

    camera: Camera
    """Intrinsics of all images."""
    views: tuple[BoardView, ...]
    """One for each pair."""
    half_turn: bool = False
    """Whether the board looks the same after half a turn: its corners may be in reverse order."""
    quarter_turn: bool = False
    """Whether the corners are a square grid, which may be turned by 90 degrees."""
    stated: bool = False
    """Whether the intrinsics are stated by the maker; else they come from these corners."""
    size_m: float | None = None
    """Stated side of a square, or of a tag, for messages."""

    def orders(self, count: int) -> list[NDArray[np.int64]]:
        """Other orders in which the corners of a view may be, as indices of them."""
        if self.quarter_turn:
            side = math.isqrt(count)
            grid = np.arange(side * side).reshape(side, side)
            return [np.rot90(grid, turns).ravel() for turns in (1, 2, 3)]
        return [np.arange(count)[::-1]] if self.half_turn else []

    @property
    def prior(self) -> LensPrior:
        """Knowledge of the intrinsics without the corners."""
        return (LensPrior.stated if self.stated else LensPrior.usual)(self.camera)


class Measured(NamedTuple):
    """Board poses by corners at one estimate of the intrinsics."""

    camera: Camera
    poses: list[BoardPose]
    sigma_px: float
    """Standard deviation of a corner coordinate."""

    def applied_to(self, pairs: PosePairs) -> PosePairs:
        """Return the pairs with these camera poses and their covariances."""
        variance = self.sigma_px**2
        return replace(
            pairs,
            camera_from_board=SE3.stack([pose.camera_from_board for pose in self.poses]),
            camera_covariance=np.stack([variance * pose.unit_covariance for pose in self.poses]),
        )

    def extras(self, prior: LensPrior) -> Extras:
        """Return the intrinsics as unknowns; the corners are part of their prior."""
        change, information = lens_estimate(self.poses, self.sigma_px, self.camera, prior)
        slopes = np.stack([pose.lens_slope for pose in self.poses])
        names = LENS[: len(change)]
        return Extras(names, ("intrinsics",) * len(names), slopes, information, change)


def measured(corners: BoardCorners, camera: Camera, starts: SE3) -> Measured:
    """Fit the pose of the board in every image from (n,) starts."""
    poses = [board_pose(v, camera, s) for v, s in zip(corners.views, starts, strict=True)]
    return Measured(camera, poses, pixel_sigma(poses))


def middle_of(corners: BoardCorners | None) -> NDArray[np.float64]:
    """(3,) middle of the board's corners, metres; the origin without corners."""
    if corners is None:
        return np.zeros(3)
    return np.mean([view.points_m.mean(0) for view in corners.views], 0)
