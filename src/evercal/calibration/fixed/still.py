"""Fixed cameras by what stands still in the base: a board at a known place."""

from dataclasses import replace

import numpy as np

from evercal.calibration.boards.corners import BoardView
from evercal.calibration.calibration import Calibration
from evercal.calibration.checks import Checks
from evercal.calibration.fixed.corner_fit import corner_fit
from evercal.calibration.fixed.sightings import Sightings, judged
from evercal.calibration.pose_pairs.checks import SIZE_SIGMA
from evercal.errors import InputError
from evercal.geometry import UncertainPose, average_poses, deviations, norms

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
    away = deviations(seen.poses, mean)
    apart = norms(away.reshape(-1, 2, 3))
    most = np.multiply(_MOST_APART, [seen.distance, 1])
    used = np.all(apart < most, axis=1)
    if used.mean() < _LEAST_USED:
        raise InputError(
            f"{seen.name}: the board is at {1000 * np.median(apart[:, 0]):.0f} mm from where most"
            " images show it: did board and camera stand still?"
        )
    fit = seen.fit
    if fit:
        # One pose of all corners.
        rows = np.flatnonzero(used)
        views = [fit.corners.views[row] for row in rows]
        points = np.concatenate([view.points_m for view in views])
        pixels = np.concatenate([view.pixels for view in views])
        corners = replace(fit.corners, views=(BoardView(points, pixels),))
        fit = corner_fit(corners)
        fit.require_one_pose()
        camera_from_board = fit.first
    else:
        scatter = away[used].T @ away[used] / used.sum()
        camera_from_board = UncertainPose(mean, seen.own.mean(0) + scatter)
    size = np.pad(SIZE_SIGMA * camera_from_board.pose.translation_m, (0, 3))
    covariance = camera_from_board.covariance + np.outer(size, size)
    camera_from_board = UncertainPose(camera_from_board.pose, covariance)
    pose = base_from_board @ camera_from_board.inverse()
    checks = Checks(target_m=seen.distance, left_open=(_UNSEEN_TURN,))
    return judged(pose, seen.images, used, apart, checks, fit)
