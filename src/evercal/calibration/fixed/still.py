"""Fixed cameras by what stands still in the base: a board at a known place."""

from dataclasses import replace

import numpy as np
from scipy.stats import chi2, f

from evercal.calibration.boards.corners import BoardView
from evercal.calibration.calibration import Calibration
from evercal.calibration.checks import Checks
from evercal.calibration.fixed.corner_fit import CornerFit, corner_fit
from evercal.calibration.fixed.sightings import Sightings, image_uses, judged
from evercal.calibration.pose_pairs.checks import SIZE_SIGMA
from evercal.errors import InputError
from evercal.geometry import UncertainPose, average_poses, deviations, norms
from evercal.typing import BoolArray

_LEAST_USED = 0.66
"""Share of images that agree."""
_MOST_APART = (0.03, np.deg2rad(5.0))
"""Distance of an image from the others: share of the distance to the board, and radians."""
_UNSEEN_TURN = (
    "whether the board lies as stated: turned by 90 or 180 deg, or shifted, it moves the camera,"
    " and its images look the same. Test it with one touched point"
)


def solve_place(
    seen: Sightings,
    base_from_board: UncertainPose,
) -> Calibration:
    """Calibrate a fixed camera by a board that stands still at a known place in the base."""
    mean = average_poses(seen.poses)
    apart = norms(deviations(seen.poses, mean).reshape(-1, 2, 3))
    most = np.multiply(_MOST_APART, [seen.distance, 1])
    used: BoolArray = np.all(apart < most, axis=1)
    if used.mean() < _LEAST_USED:
        raise InputError(
            f"{seen.name}: the board is at {1000 * np.median(apart[:, 0]):.0f} mm from where most"
            " images show it: did board and camera stand still?"
        )
    scatter = deviations(seen.poses[used], mean)
    own = seen.own.mean(0) + scatter.T @ scatter / len(scatter)
    camera_from_board = UncertainPose(mean, own)
    fit = _as_one_image(seen.fit, used) if seen.fit else None
    if fit:
        fit.require_one_pose()
        camera_from_board = still_pose(fit)
    size = np.pad(SIZE_SIGMA * camera_from_board.pose.translation_m, (0, 3))
    covariance = camera_from_board.covariance + np.outer(size, size)
    camera_from_board = UncertainPose(camera_from_board.pose, covariance)
    pose = base_from_board @ camera_from_board.inverse()
    checks = Checks(
        residual_mm=1000 * float(np.sqrt((apart[used, 0] ** 2).mean())),
        residual_deg=float(np.rad2deg(np.sqrt((apart[used, 1] ** 2).mean()))),
        target_m=seen.distance,
        left_open=(_UNSEEN_TURN,),
    )
    images = image_uses(seen.images, used, 1000 * apart[:, 0])
    return judged(
        Calibration(
            "eye_to_hand", pose.pose, pose.covariance, images=images, checks=checks
        ),
        fit,
    )


def _as_one_image(
    fit: CornerFit,
    used: BoolArray,
) -> CornerFit:
    """Fit one pose to the corners of all images that are used."""
    rows = np.flatnonzero(used)
    views = [fit.corners.views[row] for row in rows]
    points = np.concatenate([view.points_m for view in views])
    pixels = np.concatenate([view.pixels for view in views])
    corners = replace(fit.corners, views=(BoardView(points, pixels),))
    return corner_fit(corners, fit.poses[rows[:1]])


def still_pose(
    fit: CornerFit,
) -> UncertainPose:
    """The only camera_from_board of a fit, with all its errors."""
    slopes = fit.slopes[0]
    few = 6 * f.isf(0.05, 6, fit.freedom) / chi2.isf(0.05, 6)
    covariance = few * (fit.covariance[0] + slopes @ slopes.T)
    return UncertainPose(fit.poses[0], covariance)
