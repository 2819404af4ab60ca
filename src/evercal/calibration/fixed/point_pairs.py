"""A fixed camera by points that robot and camera both state, as with a depth camera or a tracker.

The position of the gripper, or of its tool, is that of the point that the camera sees.
"""

import numpy as np
from scipy.spatial.distance import pdist
from scipy.stats import chi2

from evercal.calibration.calibration import Calibration
from evercal.calibration.checks import Checks
from evercal.calibration.fixed.corner_fit import widening
from evercal.calibration.fixed.sightings import judged
from evercal.calibration.from_map.by_points import require_spread, umeyama
from evercal.calibration.unseen.touched import DEPTH_M, DEPTH_SHARE, TOUCH_M
from evercal.errors import InputError
from evercal.geometry import (
    UncertainPose,
    cross_matrix,
    in_parent_axes,
    norms,
    spread,
    unit_vectors,
)
from evercal.recordings.poses.pairing import counted
from evercal.typing import Array, BoolArray, Strings

_LEAST = 3
"""Least number of points."""
_DRAWS = 100
"""Number of samples of three points, one of which is without outliers."""
_COMPARED = 200
"""Number of points whose distances are compared."""
_OTHER_UNIT = 0.2
"""Logarithm of a ratio of lengths above which robot and camera have other units."""
_MIRRORED_AGREES = 4.0
"""Factor by which mirrored points agree better if an axis has the wrong sign."""
_SIGMAS = 4.0
"""Distance of an outlier, root mean squares of the distances of the others."""
_MEDIAN = 1.3
"""Root mean square of distances, in medians: 1.1 of points, 1.5 where rays are the worst."""
_REFITS = 3
"""Number of times that outliers are taken from the fit of the others."""
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
    require_spread(robot)
    rows = spread(len(seen), _COMPARED)
    extent = float(np.median(pdist(seen[rows])))
    ratio = float(np.median(pdist(robot[rows]))) / extent
    if abs(np.log(ratio)) > _OTHER_UNIT:
        raise InputError(
            f"the robot's points lie {ratio:.4g} times as far apart as the camera's: give both in"
            " metres, and each point in the same row of both"
        )
    misses = _least_median(seen, robot)
    mirrored = np.median(_least_median(seen * [1, 1, -1], robot))
    sigma = float(np.median(misses)) / chi2.median(3) ** 0.5
    used = _agreeing(seen, robot, misses)
    is_mirrored = _MIRRORED_AGREES * max(mirrored, TOUCH_M) < sigma
    if used.mean() < _LEAST_USED or sigma > _MOST_APART * extent or is_mirrored:
        reason = _MIRRORED if mirrored < _MOST_APART * extent else _UNMATCHED
        raise InputError(
            f"the points of robot and camera agree only to {1000 * sigma:.0f} mm: {reason}"
        )
    shape = umeyama(seen[used], robot[used], False)
    rest = norms(shape.points(seen[used]) - robot[used])
    about = seen[used] - seen[used].mean(0)
    told = (about**2).sum() / (TOUCH_M**2 + (rest**2).mean() / 3)
    scale = shape.scale ** float(told / (told + DEPTH_SHARE**-2))
    pose = umeyama(scale * seen[used], robot[used], True).base_from_map
    covariance = _covariance(pose.inverse().apply(robot[used]), scale * seen[used])
    scale_sigma = float(np.sqrt(covariance[6, 6]))
    warnings = []
    if np.median(seen[:, 2]) < 0:
        warnings.append(
            "the camera's points have negative z, behind it: for a pose of its optical frame give x"
            " right, y down, z forward; this one is of the frame that they are in"
        )
    if abs(scale - 1) > max(_SCALE_SIGMAS * scale_sigma, 0.01):
        warnings.append(
            f"the camera's lengths are {100 / scale - 100:+.1f} % longer than the robot's: check"
            " its depth scale; the calibration allows for it"
        )
    checks = Checks(
        target_m=float(np.median(norms(seen))),
        scale=scale,
        scale_sigma=scale_sigma,
        left_open=(_SAME_POINT,),
        warnings=warnings,
    )
    misses = norms(pose.apply(scale * seen) - robot)
    own = in_parent_axes(pose.rotation_matrix(), covariance[:6, :6])
    apart = np.outer(misses, [1, 0])
    return judged(UncertainPose(pose, own), names, used, apart, checks)


def _agreeing(seen: Array, robot: Array, misses: Array) -> BoolArray:
    """(n,) points that agree, from those of the sample with the least median."""
    # The sample was chosen by its misses, so they are too small (Rousseeuw and Leroy 1987).
    size = _MEDIAN * np.median(misses) * (1 + 5 / max(len(seen) - 3, 1))
    used = np.ones(len(seen), bool)
    for _ in range(_REFITS):
        used = misses < _SIGMAS * max(size, TOUCH_M)
        if used.sum() <= _LEAST:
            break
        fitted = umeyama(seen[used], robot[used], False)
        misses = norms(fitted.points(seen) - robot)
        size = np.sqrt((misses[used] ** 2).sum() / (used.sum() - 7 / 3))
    return used


def _covariance(
    stated: Array,
    seen: Array,
) -> Array:
    """(7, 7) of a motion of the camera in its axes and of the logarithm of the scale.

    Both points (n, 3) are in the camera frame. The noise along the ray is another than that across.
    """
    ray = unit_vectors(seen)
    along = ray[:, :, None] * ray[:, None]
    misses = (stated - seen)[..., None]
    deep = ((along @ misses) ** 2).sum()
    squares = np.array([deep, ((misses**2).sum() - deep) / 2])
    freedom = _FREEDOM + len(seen) - 7 / 3
    usual = np.square([DEPTH_M, TOUCH_M])
    deep, across = (_FREEDOM * usual + squares) / freedom
    shifts = np.broadcast_to(np.eye(3), along.shape)
    slope = np.concatenate([shifts, -cross_matrix(seen), seen[..., None]], 2)
    turned = slope.transpose(0, 2, 1)
    normal = (turned @ slope).sum(0)
    normal[6, 6] += (deep + across) / 2 / DEPTH_SHARE**2
    gain = np.linalg.inv(normal)
    noise = across * np.eye(3) + (deep - across) * along
    scatter = (turned @ noise @ slope).sum(0)
    return widening(2 * freedom) * gain @ scatter @ gain


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
