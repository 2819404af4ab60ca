"""A fixed camera by points that robot and camera both state, as with a depth camera or a tracker.

The position of the gripper, or of its tool, is that of the point that the camera sees.
"""

import numpy as np
from scipy.spatial.distance import pdist
from scipy.stats import chi2, f

from evercal.calibration.calibration import Calibration
from evercal.calibration.checks import Checks
from evercal.calibration.fixed.sightings import image_uses, judged
from evercal.calibration.from_map.by_points import umeyama
from evercal.calibration.unseen.touched import DEPTH_M, DEPTH_SHARE, TOUCH_M
from evercal.errors import InputError
from evercal.geometry import SE3, cross_matrix, norms, unit_vectors
from evercal.recordings.poses.pairing import counted
from evercal.typing import Array, Strings

_LEAST = 3
"""Least number of points."""
_DRAWS = 100
"""Number of samples of three points, one of which is without outliers."""
_OTHER_UNIT = 0.2
"""Logarithm of a ratio of lengths above which robot and camera have other units."""
_SIGMAS = 4.0
"""Distance of an outlier, standard deviations."""
_LEAST_USED = 0.6
"""Share of points that agree."""
_MOST_APART = 0.05
"""Largest standard deviation, parts of the extent of the points."""
_FREEDOM = 2.0
"""Weight of the usual noise of depths, degrees of freedom."""
_SCALE_SIGMAS = 4.0
"""Significance of an error of the camera's lengths that is reported."""
_SAME_POINT = (
    "whether the camera sees the very point that the robot states: an offset between them that does"
    " not turn moves the camera by as much, and no residual shows it"
)
_MIRRORED = "they are mirrored: one axis of robot or camera has the wrong sign"
_UNMATCHED = (
    "is each point in the same row of both, in the base frame and in the camera frame, and does the"
    " camera see the robot's own point, not a marker beside it? If it sees a marker with a"
    " rotation, give poses of both"
)


def solve_points(
    names: Strings,
    robot: Array,
    seen: Array,
) -> Calibration:
    """Calibrate a fixed camera by points (n, 3) in the base and in the camera frame, metres."""
    if len(seen) < _LEAST:
        raise InputError(
            f"{counted(len(seen), 'point')} by robot and camera; give {_LEAST} or more, better 20,"
            " not all on one line"
        )
    umeyama(seen, robot, True)  # refuses points on one line
    extent = float(np.median(pdist(seen)))
    ratio = float(np.median(pdist(robot))) / extent
    if abs(np.log(ratio)) > _OTHER_UNIT:
        raise InputError(
            f"the robot's points lie {ratio:.4g} times as far apart as the camera's: give both in"
            " metres, and each point in the same row of both"
        )
    misses = _least_median(seen, robot)
    sigma = float(np.median(misses)) / chi2.median(3) ** 0.5
    used = misses < _SIGMAS * max(sigma, TOUCH_M)
    if used.mean() < _LEAST_USED or sigma > _MOST_APART * extent:
        mirrored = np.median(_least_median(seen * [1, 1, -1], robot))
        reason = _MIRRORED if mirrored < _MOST_APART * extent else _UNMATCHED
        raise InputError(
            f"the points of robot and camera agree only to {1000 * sigma:.0f} mm: {reason}"
        )
    shape = umeyama(seen[used], robot[used], False)
    about = seen[used] - seen[used].mean(0)
    rest = norms(shape.points(seen[used]) - robot[used])
    told = (about**2).sum() / (TOUCH_M**2 + (rest**2).mean() / 3)
    scale = shape.scale ** float(told / (told + DEPTH_SHARE**-2))
    pose = umeyama(scale * seen[used], robot[used], True).base_from_map
    misses = norms(pose.apply(scale * seen) - robot)
    covariance = _covariance(pose, scale * seen[used], robot[used])
    spread = float(np.sqrt(covariance[6, 6]))
    warnings = []
    if abs(scale - 1) > max(_SCALE_SIGMAS * spread, 0.01):
        warnings.append(
            f"the camera's lengths are {100 / scale - 100:+.1f} % longer than the robot's: check"
            " its depth scale; the calibration allows for it"
        )
    checks = Checks(
        residual_mm=1000 * float(np.sqrt((misses[used] ** 2).mean())),
        residual_deg=0.0,
        target_m=float(np.median(norms(seen))),
        scale=scale,
        scale_sigma=spread,
        left_open=(_SAME_POINT,),
        warnings=warnings,
    )
    images = image_uses(names, used, 1000 * misses)
    return judged(
        Calibration(
            "eye_to_hand", pose, covariance[:6, :6], images=images, checks=checks
        )
    )


def _covariance(
    pose: SE3,
    seen: Array,
    robot: Array,
) -> Array:
    """(7, 7) of the pose and of the logarithm of the scale; the noise along the ray is its own."""
    count = len(seen)
    misses = pose.apply(seen) - robot
    usual = np.square([DEPTH_M, TOUCH_M])
    ray = unit_vectors(pose.rotation.apply(seen))
    along = ((misses * ray).sum(1) ** 2).sum()
    squares = np.array([along, ((misses**2).sum() - along) / 2])
    freedom = _FREEDOM + count - 7 / 3
    variance = (_FREEDOM * usual + squares) / freedom
    slope = np.zeros((count, 3, 7))
    slope[:, :, :3] = np.eye(3)
    slope[:, :, 3:6] = -pose.rotation_matrix() @ cross_matrix(seen)
    slope[:, :, 6] = pose.rotation.apply(seen)
    noise = np.eye(3) * variance[1] + (variance[0] - variance[1]) * (
        ray[:, :, None] * ray[:, None]
    )
    rows = slope.reshape(-1, 7)
    normal = rows.T @ rows
    normal[6, 6] += variance.mean() / DEPTH_SHARE**2
    gain = np.linalg.inv(normal)
    scatter = (slope.transpose(0, 2, 1) @ noise @ slope).sum(0)
    covariance = gain @ scatter @ gain
    covariance *= 6 * f.isf(0.05, 6, 2 * freedom) / chi2.isf(0.05, 6)
    return (covariance + covariance.T) / 2


def _least_median(
    seen: Array,
    robot: Array,
) -> Array:
    """(n,) misses of the sample of three points that has the least median of them."""
    rng = np.random.default_rng(0)
    best = np.full(len(seen), np.inf)
    for _ in range(_DRAWS):
        rows = rng.permutation(len(seen))[:3]
        try:
            fitted = umeyama(seen[rows], robot[rows], True)
        except InputError:
            continue  # they lie on one line
        misses = norms(fitted.points(seen) - robot)
        if np.median(misses) < np.median(best):
            best = misses
    return best
