"""Calibrations of fixed cameras from an adjustment: in the base, or beside each other."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from evercal.calibration.calibration import Calibration, ImageUse, Rig, RigPair
from evercal.calibration.checks import Checks
from evercal.calibration.fixed.adjustment import adjust
from evercal.calibration.fixed.sightings import Sightings
from evercal.calibration.from_map.align import umeyama
from evercal.calibration.verdict import verdict
from evercal.errors import InputError
from evercal.geometry import SE3, UncertainPose, length_mm_deg, norms
from evercal.robot.frame_names import FrameNames
from evercal.typing import Array, BoolArray, Strings

_MOST_AGAINST = 0.34
"""Share of sightings that may contradict the others."""
_LEAST_FOR_SIZE = 4
"""Least number of moments that tell the size of the board."""
_OTHER_SIZE = 0.04
"""Logarithm of a ratio of sizes above which they are not one board's."""
_MOST_APART = (0.03, np.deg2rad(5.0))
"""Largest usual residual: share of the distance to the board, and radians."""
_UNSEEN_TURN = (
    "whether the board lies as stated: turned by 90 or 180 deg, or shifted, it moves the camera,"
    " and its images look the same. Test it with one touched point"
)


def solve_place(
    cameras: Sequence[Sightings],
    base_from_board: UncertainPose,
) -> dict[str, Calibration]:
    """Calibrate fixed cameras by a board that stands still at a known place in the base."""
    for camera in cameras:
        if camera.fit:
            camera.fit.require_one_pose()
    return solve_still(cameras, base_from_board, (_UNSEEN_TURN,))


def solve_still(
    cameras: Sequence[Sightings],
    base_from_board: UncertainPose,
    left_open: Strings = (),
) -> dict[str, Calibration]:
    """Calibrate fixed cameras by what stands still in the base."""
    place = Sightings(
        "base",
        ("the stated place",),
        ("",),
        SE3.stack([base_from_board.pose]),
        base_from_board.covariance[None],
        np.zeros((1, 6, 0)),
        size=0.0,
    )
    still = [replace(own, moments=("",) * len(own.images)) for own in cameras]
    return _solved([place, *still], FrameNames(), left_open)


def solve_rig(
    cameras: Sequence[Sightings],
) -> Rig:
    """Estimate fixed cameras beside the first one by a board that moves before them."""
    if len(cameras) < 2:
        raise InputError(
            "`camera_poses`: one camera alone has no place; give the poses of two or more cameras,"
            " or `robot_poses`, or the place of the board with `board_at`"
        )
    first = cameras[0]
    for camera in cameras[1:]:
        _require_one_size(first, camera)
    solved = _solved(cameras, FrameNames(base=first.name))
    pairs = []
    for camera in cameras[1:]:
        pose = solved[camera.name].uncertain_pose
        common = len({*first.moments} & {*camera.moments})
        pairs.append(RigPair(first.name, camera.name, pose, common))
    return Rig(solved, tuple(pairs))


def _require_one_size(
    first: Sightings,
    second: Sightings,
) -> None:
    """Refuse cameras that state another size of the board, or another unit."""
    rows = {moment: i for i, moment in enumerate(first.moments)}
    pairs = [(rows[m], i) for i, m in enumerate(second.moments) if m in rows]
    if len(pairs) < _LEAST_FOR_SIZE:
        return
    ours, theirs = np.transpose(pairs)
    target = first.poses.translation_m[ours]
    places = second.poses.translation_m[theirs]
    try:
        fits = [umeyama(places, target, known) for known in (True, False)]
    except InputError:
        return  # the board moved on a line
    stated, free = (np.median(norms(fit.points(places) - target)) for fit in fits)
    ratio = 1 / fits[1].scale
    extent = np.median(norms(target - target.mean(0)))
    if abs(np.log(ratio)) > _OTHER_SIZE and free < min(stated / 2, extent / 4):
        raise InputError(
            f"{second.name}: the board is {ratio:.3g} times as large as in {first.name}: check the"
            " side of its squares, and the unit"
        )


def _solved(
    cameras: Sequence[Sightings],
    frames: FrameNames,
    left_open: Strings = (),
) -> dict[str, Calibration]:
    """All cameras but the first, by name."""
    adjusted = adjust(cameras)
    solved: dict[str, Calibration] = {}
    for i, seen in enumerate(cameras):
        rows = adjusted.camera == i
        residual = adjusted.residual[rows]
        used = adjusted.used[rows]
        lengths = norms(residual.reshape(-1, 2, 3))
        distance = float(np.median(norms(seen.poses.translation_m)))
        far = np.median(lengths, 0) > np.multiply(_MOST_APART, [distance + 0.1, 1])
        if far.any() or not used.mean() > 1 - _MOST_AGAINST:
            mm, deg = length_mm_deg(np.median(np.abs(residual), 0))
            raise InputError(
                f"{seen.name}: its poses of the board and those of the others differ by {mm:.0f} mm"
                f" and {deg:.1f} deg: do all see one board, of one stated size; do images of one"
                " moment have one name; are the poses camera_from_board (else `invert` camera); and"
                " did cameras stand still?"
            )
        mm, deg = length_mm_deg(np.sqrt((residual[used] ** 2).mean(0)))
        lenses = seen.fit.lenses if seen.fit else {}
        calibration = Calibration(
            mount="eye_to_hand",
            parent_from_child=adjusted.cameras[i],
            covariance=adjusted.covariances[i],
            frames=frames,
            camera=lenses.get("estimated"),
            lenses=lenses,
            images=image_uses(seen.images, used, 1000 * lengths[:, 0]),
            checks=Checks(
                residual_mm=mm,
                residual_deg=deg,
                target_m=distance,
                corner_sigma_px=seen.fit.sigma_px if seen.fit else None,
                left_open=left_open,
            ),
        )
        solved[seen.name] = judged(calibration)
    del solved[cameras[0].name]
    return solved


def image_uses(
    names: Sequence[str],
    used: BoolArray,
    mm: Array,
) -> tuple[ImageUse, ...]:
    """The use of images or points, by whether they agree and how far they are off."""
    uses = []
    for name, agrees, miss in zip(names, used.tolist(), mm.tolist(), strict=True):
        reason = "" if agrees else f"is {miss:.1f} mm from where the others put it"
        uses.append(ImageUse(name, agrees, reason, miss))
    return tuple(uses)


def judged(
    calibration: Calibration,
) -> Calibration:
    """The calibration with its verdict and the number of its images or points."""
    checks = replace(
        calibration.checks,
        poses_given=len(calibration.images),
        poses_used=sum(image.used for image in calibration.images),
    )
    calibration = replace(calibration, checks=checks)
    return replace(calibration, verdict=verdict(calibration))
