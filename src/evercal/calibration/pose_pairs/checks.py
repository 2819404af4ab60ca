"""Checks before a hand-eye fit, whether pose pairs determine it, and of the fit itself.

After the fit: held-out poses, repeatability, open directions, a stated size.
"""

from dataclasses import replace

import numpy as np

from evercal.calibration.pose_pairs.fit import (
    MIN_POSES,
    HandEyeFit,
    agreement,
    predicted,
    refine,
    robust_fit,
)
from evercal.calibration.pose_pairs.pairs import BoardCorners, PosePairs
from evercal.calibration.pose_pairs.pose_equation import PoseEquation, Unknowns
from evercal.errors import InputError
from evercal.geometry import (
    SE3,
    norms,
    pose_distance,
    pose_distance_mm_deg,
    spread,
)
from evercal.recordings.poses.pairing import counted
from evercal.recordings.stale_poses import stale_poses
from evercal.storage.text_files import few
from evercal.typing import Array, IntArray, JsonObject

_MAX_DISTANCE_M = 20.0
"""Distance of poses from the origin above which they are not in metres."""
_MIN_ROTATION_DEG = 2.0
"""Minimum root mean square angle between two poses about the main axis."""
_MIN_SECOND_DEG = 1.0
"""Minimum root mean square angle between two poses about a second axis."""
_MIN_TRANSLATION_M = 0.01
"""Minimum spread of the gripper's positions for an unknown scale."""
_SAME_LIST = 0.1
"""Differences of robot and camera poses that make them one list, parts of the robot's motion."""
_AT_REST_M = 1e-3
"""Distance from the first pose below which no pose moves."""
_AT_REST_RAD = np.deg2rad(0.1)
"""Angle from the first pose below which no pose moves."""
_STALE = 0.3
"""Motion of the board in rows with stale robot poses, parts of that in all rows."""
_NAMES = 5
"""Number of names of poses in a message."""
_RECORD = "record 15 to 25 poses that differ by 20 to 60 deg about two axes and by 10 cm or more"
FOLDS = 5
"""Number of parts of the poses that are held out in turn."""
_MIN_HALVED = 12
"""Minimum number of poses for two calibrations from a half each."""
_MAIN_SHARE = 0.5
"""Share of the variance that names a cause."""
_ELONGATED = 4.0
"""Ratio of the two largest standard deviations that names a direction."""
_SMALL_MM = 0.1
"""Standard deviation below which nothing is left open."""
_SMOOTH = (
    "smooth errors of the arm or the board, which similar poses share: add poses that differ by 20"
    " cm and 60 deg, lay the board on a flat plate, name the arm with `arm`"
)
_REMEDIES = {
    "intrinsics": (
        "the intrinsics, which trade against distance: tilt the board by 30 to 45 deg, vary the"
        " distance by half, fill the corners of the image, or give a known lens with `camera`"
    ),
    "shared depth": (
        "a depth error that all images share: add poses that turn by 30 to 60 deg about two axes,"
        " so that the same depth points in different directions"
    ),
    "joint offsets": (
        "offsets of the arm's joints: name the arm with `arm`, or record joint values with a URDF"
    ),
    "smooth translation": _SMOOTH,
    "smooth rotation": _SMOOTH,
    "size": (
        "the size of the squares, which trades against distance: measure it over the whole board,"
        " and move the gripper by 20 cm or more between poses"
    ),
}
"""Causes of uncertainty by group of extras, and what removes them."""
SIZE_SIGMA = 0.002
"""Relative standard deviation of a stated square size, and of a depth error of all images."""
_SIZE_SIGMAS = 5.0
"""Significance of a wrong size, standard deviations."""
_LARGE_SIZE = 0.1
"""Relative error of a size that is believed only if the residuals fall by `_MUCH_BETTER`."""
_MUCH_BETTER = 3.0
"""Factor by which a large error of the size reduces the residuals."""


def require_observable(pairs: PosePairs, scale_known: bool = True) -> None:
    """Check that the pairs determine the calibration."""
    n = len(pairs)
    if n < MIN_POSES:
        raise InputError(
            f"{counted(n, 'pose pair')}; hand-eye calibration takes at least"
            f" {MIN_POSES}, because an outlier among fewer cannot be detected; {_RECORD}"
        )
    _require_metres(pairs, pairs.base_from_gripper, "robot")
    if scale_known:
        _require_metres(pairs, pairs.camera_from_board, "camera")
    different = np.unique(pairs.repeats(scale_known))
    if len(different) < MIN_POSES:
        names = few([pairs.names[i] for i in different], most=_NAMES)
        raise InputError(
            f"{n} pose pairs hold only {counted(len(different), 'different one')}"
            f" ({names}); repeats add nothing: {_RECORD}"
        )
    _require_motion(pairs[different], scale_known)
    grippers = pairs.base_from_gripper[different]
    require_rotations(grippers)
    spread = float(np.sqrt(grippers.translation_m.var(0).sum()))
    if not scale_known and spread < _MIN_TRANSLATION_M:
        raise InputError(
            f"pure rotation: the gripper only turned on the spot (its positions vary by"
            f" {1000 * spread:.1f} mm), so the scale of the camera poses is open; also move the"
            f" gripper by 10 cm or more between poses"
        )


def require_two_lists(pairs: PosePairs) -> None:
    """Refuse one list of poses in both files, apart from noise, unit, inversion and axes."""
    camera = pairs.camera_from_board
    about_x = SE3.exp([0, 0, 0, np.pi, 0, 0])
    for robot in (pairs.base_from_gripper, pairs.base_from_gripper.inverse()):
        length = _median_length(robot)
        motion = np.median(pose_distance(robot[0], robot), 1)
        for read in (camera, about_x @ camera, camera @ about_x):
            unit = length / max(_median_length(read), 1e-300)
            same_unit = SE3(read.rotation_wxyz, unit * read.translation_m)
            apart = np.median(pose_distance(robot, same_unit), 1)
            if (apart < _SAME_LIST * motion).all():
                raise InputError(
                    f"robot and camera poses are one list, up to {1000 * apart[0]:.2f} mm and"
                    f" {np.rad2deg(apart[1]):.2f} deg, so they measure nothing: give"
                    f" base_from_gripper of the robot and camera_from_board of the images"
                )


def _median_length(poses: SE3) -> float:
    return float(np.median(norms(poses.translation_m)))


def require_rotations(
    base_from_gripper: SE3,
    main_deg: float = _MIN_ROTATION_DEG,
    second_deg: float = _MIN_SECOND_DEG,
) -> None:
    """Refuse gripper poses (n,) without rotation, or with rotation about one axis only.

    The angles are root mean squares between two poses, about the main and the second axis.
    """
    grippers = base_from_gripper[spread(len(base_from_gripper), 100)]
    i, j = np.triu_indices(len(grippers), 1)
    motions = grippers[i].inverse() @ grippers[j]
    rotations = 2.0 * motions.rotation_wxyz[:, 1:]
    values, axes = np.linalg.eigh(rotations.T @ rotations / len(rotations))
    _, second, main = np.rad2deg(np.sqrt(np.maximum(values, 0)))
    if main < main_deg:
        raise InputError(
            f"pure translation: the gripper hardly turned (by {main:.1f} deg rms), so the position"
            f" of the camera is not determined; turn the wrist by 20 to 60 deg between poses, about"
            f" two different axes"
        )
    if second < second_deg:
        axis = " ".join(f"{value:+.2f}" for value in axes[:, 2])
        raise InputError(
            f"parallel axes: the gripper turned about one axis only ({axis} in the gripper frame;"
            f" {main:.0f} deg rms about it, {second:.1f} deg about others), so the position of the"
            f" camera along it is not determined; record poses that also tilt the gripper by 20 deg"
            f" or more about another axis"
        )


def _require_metres(
    pairs: PosePairs,
    poses: SE3,
    role: str,
) -> None:
    distance = norms(poses.translation_m)
    far = distance > _MAX_DISTANCE_M
    if not far.any():
        return
    typical = float(np.median(distance[far]))
    if far.mean() > 0.9:
        unit = "another unit"
        if typical > 10 * _MAX_DISTANCE_M:
            unit = "millimetres"
        raise InputError(
            f"the {role} poses look like {unit}, not"
            f" metres: their distance from the origin is {float(np.median(distance)):.0f};"
            f" convert them, or correct the unit in the file's header or pose convention"
        )
    names = few([pairs.names[i] for i in np.flatnonzero(far)], most=_NAMES)
    raise InputError(
        f"the {role} poses mix units: {names} are {typical:.0f} from the"
        f" origin, the others {float(np.median(distance[~far])):.2f}; give all of them in metres"
    )


def _require_motion(pairs: PosePairs, scale_known: bool) -> None:
    """Refuse stale poses: one side stands still while the other moves."""
    unit = 1.0
    if not scale_known:
        size = norms(pairs.camera_from_board.translation_m)
        unit = max(float(np.median(size)), 1e-12)
    camera_still = _is_still(pairs.camera_from_board, unit)
    robot = pairs.base_from_gripper
    if camera_still and not _is_still(robot, 1.0):
        raise InputError(
            "the board's pose is the same in every image while the robot moved; the images or their"
            " poses are stale, or the mount is wrong"
        )
    usual = _motion(pairs.camera_from_board)

    def moved(rows: IntArray) -> bool:
        # As much as in all images: noise moves a board less.
        seen = _motion(pairs.camera_from_board[rows])
        return not camera_still and bool((seen > _STALE * usual).all())

    if stale := stale_poses(robot, pairs.names, moved):
        raise InputError(
            f"{stale} while the board moves in the images; the robot poses are stale: read them at"
            " the time of each image"
        )


def _motion(poses: SE3) -> Array:
    """(2,) median distance and angle from the first of (n,) poses to the others."""
    return np.median(pose_distance(poses[0], poses[1:]), 1)


def _is_still(poses: SE3, unit_m: float) -> bool:
    metres, radians = pose_distance(poses[0], poses)
    return bool(metres.max() / unit_m < _AT_REST_M and radians.max() < _AT_REST_RAD)


def held_out_error(
    equation: PoseEquation,
    fit: HandEyeFit,
) -> dict[str, float]:
    """Median and root mean square errors of poses predicted from the others, in five folds.

    They include the noise of the held-out pose. Empty for fewer than six poses.
    """
    rows = np.flatnonzero(fit.inliers)
    if len(rows) <= FOLDS:
        return {}
    errors = []
    for fold in range(FOLDS):
        held_out = np.arange(len(rows)) % FOLDS == fold
        at = _refined(equation, fit, rows[~held_out])
        every, _ = predicted(equation[rows], at, fit.levels, ~held_out)
        errors.append(every[held_out])
    return held_out_sizes(np.concatenate(errors))


def held_out_sizes(errors: Array) -> JsonObject:
    """Median and root mean square lengths of errors (n, 6), metres and radians."""
    error = norms(errors.reshape(-1, 2, 3)) * (1000.0, 180 / np.pi)
    median_mm, median_deg = np.median(error, 0).tolist()
    rms_mm, rms_deg = np.sqrt((error**2).mean(0)).tolist()
    return {
        "held_out_mm": median_mm,
        "held_out_deg": median_deg,
        "held_out_rms_mm": rms_mm,
        "held_out_rms_deg": rms_deg,
    }


def repeatability(
    equation: PoseEquation,
    fit: HandEyeFit,
) -> dict[str, float]:
    """Compare the calibrations from two halves of the sorted poses; empty for fewer than twelve."""
    rows = np.flatnonzero(fit.inliers)
    if len(rows) < _MIN_HALVED:
        return {}
    even = _refined(
        equation,
        fit,
        rows[0::2],
    ).parent_from_camera
    odd = _refined(
        equation,
        fit,
        rows[1::2],
    ).parent_from_camera
    millimetres, degrees = pose_distance_mm_deg(even, odd)
    return {"repeatability_mm": millimetres, "repeatability_deg": degrees}


def _refined(
    equation: PoseEquation,
    fit: HandEyeFit,
    rows: IntArray,
) -> Unknowns:
    use = np.zeros(len(equation), bool)
    use[rows] = True
    return refine(equation, fit.at, fit.levels, use)


def left_open(fit: HandEyeFit, parent: str) -> list[str]:
    """Return what the poses determine badly, and which poses to add; one sentence each."""
    position = fit.covariance[:3, :3]
    if 1000 * np.sqrt(float(np.trace(position)) / 3) < _SMALL_MM:
        return []
    sentences = []
    total = np.trace(fit.covariance[:3, :3])
    for group, remedy in _REMEDIES.items():
        share = fit.contributions.get(group, np.zeros((6, 6)))
        if np.trace(share[:3, :3]) > _MAIN_SHARE * total:
            left = 1000 * np.sqrt(np.trace(position - share[:3, :3]) / 3)
            sentences.append(
                f"Most of the uncertainty is due to {remedy}. Without it, {left:.2f} mm are left."
            )
    values, axes = np.linalg.eigh(position)
    sigma = 1000 * np.sqrt(np.maximum(values, 0))
    if sigma[2] > _ELONGATED * max(sigma[1], 1e-9):
        axis = " ".join(f"{value:+.2f}" for value in axes[:, 2])
        sentences.append(
            f"Along one direction ({axis} in the {parent} frame) the position is known only to"
            f" {sigma[2]:.2f} mm, along the others to {sigma[1]:.2f} mm: add poses that turn the"
            f" gripper by 30 deg or more about axes perpendicular to it."
        )
    return sentences


def with_tested_size(
    equation: PoseEquation,
    fit: HandEyeFit,
    corners: BoardCorners | None,
    of_board: bool = True,
) -> tuple[PoseEquation, HandEyeFit, list[str]]:
    """Free the size of the squares, or of a map, if the robot's motions contradict it."""
    k = equation.extras.names.index("size")
    # What the residuals say without the prior.
    information = fit.sigma[12 + k] ** -2.0 - SIZE_SIGMA**-2.0
    pull = fit.at.extras[k] / fit.sigma[12 + k] ** 2
    if pull**2 < information:
        return equation, fit, []
    # A wrong size looks like noise, so the noise is estimated again with the free size.
    free = replace(equation, extras=equation.extras.without_prior("size"))
    freed = robust_fit(free, agreement(free, fit.at), fit.levels)
    error = float(freed.at.extras[k])
    sigma = float(freed.sigma[12 + k])
    if abs(error) < max(_SIZE_SIGMAS * sigma, SIZE_SIGMA):
        return equation, fit, []
    # A camera in the point of rotation that sees a board of size zero fits, too.
    if error < -0.5:
        warning = "the gripper turned about one point, so a wrong size of the board stays hidden"
        return equation, fit, [warning]
    percent = 100 * abs(error)
    what = "board" if of_board else "map"
    larger = "larger" if error > 0 else "smaller"
    if abs(error) > _LARGE_SIZE and _misfit(fit) < _MUCH_BETTER * _misfit(freed):
        warning = (
            f"a {percent:.0f} % {larger} {what} improves the fit but does not explain the"
            f" residuals: check its size, the robot poses and the intrinsics"
        )
        return equation, fit, [warning]
    deviation = f"{percent:.2f} +- {100 * sigma:.2f} %"
    evidence = f"by the robot's motions ({abs(error) / sigma:.0f} standard deviations)"
    if not of_board:
        short = "short" if error > 0 else "long"
        warning = (
            f"the lengths of the map are {deviation} too"
            f" {short}, {evidence}: the estimated scale is used"
        )
        return free, freed, [warning]
    size = f"a square or tag of 24 mm would measure {24 * (1 + error):.2f} mm"
    if corners and corners.size_m is not None:
        stated = 1000 * corners.size_m
        size = f"its side measures {stated * (1 + error):.2f} mm, not {stated:.2f} mm"
    warning = (
        f"the board is {deviation} {larger} than stated,"
        f" {evidence}: {size}; check its size and the focal length. The calibration uses the"
        f" estimated size"
    )
    return free, freed, [warning]


def _misfit(fit: HandEyeFit) -> float:
    return float(np.sqrt((fit.residual[fit.inliers, :3] ** 2).mean()))
