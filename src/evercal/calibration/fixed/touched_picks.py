"""A fixed camera by touched points and their pixels: a pose from points, without a map."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import f

from evercal.calibration.boards.corners import BoardView, board_pose
from evercal.calibration.calibration import Calibration
from evercal.calibration.checks import Checks
from evercal.calibration.fixed.corner_fit import corner_fit
from evercal.calibration.fixed.sightings import judged
from evercal.calibration.from_map.by_points import require_spread
from evercal.calibration.picked_points import PickedPoint
from evercal.calibration.pose_pairs.pairs import BoardCorners
from evercal.calibration.unseen.touched import require_usable
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, UncertainPose, norms
from evercal.recordings.poses.pairing import counted
from evercal.typing import Array, BoolArray

_LEAST = 4
"""Least number of points."""
_JUDGES = 5
"""Least number of points that tell that another one is wrong."""
_LEAST_USED = 2 / 3
"""Share of points that agree."""
_TRIED = 12
"""Number of the worst points, one of which is left out next."""
_MOST_NOISE = 2.0
"""Noise of the picks that agree, parts of the stated one, where others were left out."""
_SIGMAS = 4.0
"""Residual of a wrong point, standard deviations, beside `_LENS_SHARE` of the image's width."""
_LENS_SHARE = 0.005
_CHANCE = 1e-4
"""Probability that noise alone fits other intrinsics so much better."""
_OPEN_FOCAL = 0.03
"""Standard deviation of the focal length above which the picks leave it open, as a share."""
_LENS_CHANGE = 0.02
"""Change of intrinsics, parts of focal length and width, that contradicts the stated ones."""
_CONTRADICT = (
    "the picks contradict the points, by {:.0f} px at {}: is each name given to the point that was"
    " picked, are pixels u right and v down, are the points x, y, z of the base (no axis mirrored),"
    " and is `camera` of these images?"
)


def solve_picks(
    points: Mapping[str, Array],
    picks: Sequence[PickedPoint],
    camera: Camera,
    touch_m: float,
    pick_px: float,
) -> Calibration:
    """Calibrate a fixed camera by four or more touched points that were picked in its images.

    Args:
        points: (3,) by name, base frame, metres.
        picks: Their pixels; those of all images count as one image.
        camera: Stated intrinsics.
        touch_m: Standard deviation per axis of a touched point.
        pick_px: That of a pick.
    """
    require_usable(picks, points, camera)
    names = {pick.point for pick in picks}
    if len(names) < _LEAST:
        raise InputError(
            f"{counted(len(names), 'point')} picked; give {_LEAST} or more, better 8, not all on"
            " one line"
        )
    require_spread(np.stack([points[name] for name in names]))
    places = np.stack([points[pick.point] for pick in picks])
    view = BoardView(places, np.stack([pick.pixel for pick in picks]))
    labels = [f"{pick.point} in {pick.image}" for pick in picks]
    try:
        pose = board_pose(view, camera).camera_from_board
        distance = float(norms(pose.apply(places)).mean())
        usual_px = float(np.hypot(pick_px, camera.fx * touch_m / distance))
        focal_sigma = _require_lens(view, camera, usual_px)
        limit = _SIGMAS * usual_px + _LENS_SHARE * camera.width
        used = _agreeing(view, labels, camera, limit)
    except ValueError:
        raise InputError(
            "no pose projects the points onto their picks, in front of the camera and in its view:"
            " is `camera` of these images, and are the points x, y, z of the base?"
        ) from None
    corners = BoardCorners(camera, (view[used],), stated=True)
    fit = corner_fit(corners, usual_px)
    fit.require_one_pose()
    # Of the touches a part is the tool's, which all share.
    tool = UncertainPose(SE3.identity(), np.diag([touch_m**2] * 3 + [1e-8] * 3))
    misses = norms(view.pixels - fit.camera.project(fit.poses[0].apply(places)))
    if not used.all() and fit.sigma_px > _MOST_NOISE * usual_px:
        raise InputError(_CONTRADICT.format(misses.max(), labels[misses.argmax()]))
    apart = np.outer(misses, [distance / camera.fx, 0])
    left_open = ()
    if focal_sigma > _OPEN_FOCAL:
        share = min(100.0, 100 * _SIGMAS * focal_sigma)
        left_open = (
            f"whether `camera` is of these images: the picks would not show an error of"
            f" {share:.0f} % of the focal length, and the camera moves by as large a share of its"
            " distance. Pick more points, near and far",
        )
    checks = Checks(target_m=distance, left_open=left_open)
    return judged(tool @ fit.first.inverse(), labels, used, apart, checks, fit)


def _require_lens(view: BoardView, camera: Camera, usual_px: float) -> float:
    """Standard deviation of the focal length by the picks, as a share of it.

    Refuse picks that fit another focal length and principal point much better.
    """
    freedom = view.pixels.size - 9
    if freedom < 1:
        return np.inf

    def changed(values: Array) -> Camera:
        longer = np.exp(values[0])
        return replace(
            camera,
            fx=longer * camera.fx,
            fy=longer * camera.fy,
            cx=camera.cx + values[1] * camera.width,
            cy=camera.cy + values[2] * camera.width,
        )

    def residuals(values: Array) -> Array:
        return board_pose(view, changed(values)).residual_px.ravel()

    fit = least_squares(
        residuals, np.zeros(3), x_scale=0.1, diff_step=1e-4, bounds=(-0.8, 0.8)
    )
    before = (residuals(np.zeros(3)) ** 2).sum()
    after = 2 * fit.cost
    by_chance = f.isf(_CHANCE, 3, freedom) * 3 / freedom
    explains = before - after > by_chance * after
    explains &= after < freedom * (_MOST_NOISE * usual_px) ** 2
    if explains and np.abs(fit.x).max() > _LENS_CHANGE:
        own = changed(fit.x)
        raise InputError(
            f"the picks fit a focal length of {own.fx:.0f} px and a principal point at"
            f" {own.cx:.0f}, {own.cy:.0f}; `camera` states {camera.fx:.0f} px and {camera.cx:.0f},"
            f" {camera.cy:.0f}: is it of these images, in their resolution?"
        )
    normal = fit.jac.T @ fit.jac + 1e-9 * np.eye(3)
    return usual_px * float(np.sqrt(np.linalg.inv(normal)[0, 0]))


def _agreeing(
    view: BoardView,
    labels: Sequence[str],
    camera: Camera,
    limit_px: float,
) -> BoolArray:
    """(k,) picks that agree with each other; those that do not are left out one by one."""
    used = np.ones(len(labels), bool)
    while True:
        misses = norms(board_pose(view[used], camera).residual_px)
        if misses.max() < limit_px:
            return used
        rows = np.flatnonzero(used)[misses.argsort()]
        left = len(rows) - 1
        if left < _JUDGES or left < _LEAST_USED * len(labels):
            raise InputError(_CONTRADICT.format(misses.max(), labels[rows[-1]]))
        without = used & ~np.eye(len(labels), dtype=bool)[rows[-_TRIED:]]
        costs = [board_pose(view[own], camera).squared_px for own in without]
        used = without[np.argmin(costs)]
