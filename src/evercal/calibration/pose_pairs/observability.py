"""Check that pose pairs determine the calibration, before it is solved."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.pose_pairs.fit import MIN_POSES
from evercal.calibration.pose_pairs.pairs import PosePairs, listed
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance

Array = NDArray[np.floating]

_FAR_M = 20.0
_MIN_ROTATION_DEG, _MIN_SECOND_DEG = 2.0, 1.0
_MIN_TRANSLATION_M = 0.01
_STILL_M, _STILL_RAD = 1e-3, np.deg2rad(0.1)
_RECORD = "record 15 to 25 poses that differ by 20 to 60 deg about two axes and by 10 cm or more"


def require_observable(pairs: PosePairs, scale_known: bool = True) -> None:
    """Check that the pairs determine the calibration."""
    n = len(pairs)
    if n < MIN_POSES:
        raise InputError(
            f"{n} pose {'pair' if n == 1 else 'pairs'}; hand-eye calibration takes at least"
            f" {MIN_POSES}, because an outlier among fewer cannot be detected; {_RECORD}"
        )
    _require_metres(pairs.base_from_gripper, pairs.names, "robot")
    if scale_known:
        _require_metres(pairs.camera_from_board, pairs.names, "camera")
    different = np.unique(pairs.repeats(scale_known))
    if len(different) < MIN_POSES:
        raise InputError(
            f"{n} pose pairs hold only {len(different)} different"
            f" {'one' if len(different) == 1 else 'ones'}"
            f" ({listed([pairs.names[i] for i in different])}); repeats add nothing: {_RECORD}"
        )
    _require_motion(pairs[different], scale_known)
    grippers = pairs.base_from_gripper[different]
    require_rotations(grippers)
    spread = float(np.sqrt(grippers.translation_m.var(0).sum()))
    if spread < _MIN_TRANSLATION_M:
        raise InputError(
            f"pure rotation: the gripper only turned on the spot (its positions vary by"
            f" {1000 * spread:.1f} mm), so a wrong board size or unit cannot be detected;"
            f" also move the gripper by 10 cm or more between poses"
        )


def require_rotations(
    base_from_gripper: SE3,
    main_deg: float = _MIN_ROTATION_DEG,
    second_deg: float = _MIN_SECOND_DEG,
) -> None:
    """Refuse gripper poses (n,) without rotation, or with rotation about one axis only.

    The angles are root mean squares between two poses, about the main and the second axis.
    """
    rows = np.unique(np.linspace(0, len(base_from_gripper) - 1, 100).round().astype(int))
    i, j = np.triu_indices(len(rows), 1)
    motions = base_from_gripper[rows[i]].inverse() @ base_from_gripper[rows[j]]
    rotations = 2.0 * motions.rotation_wxyz[:, 1:]
    values, axes = np.linalg.eigh(rotations.T @ rotations / len(rotations))
    main, second = np.rad2deg(np.sqrt(np.maximum(values[[2, 1]], 0)))
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


def _require_metres(poses: SE3, names: Sequence[str], role: str) -> None:
    distance = np.linalg.norm(poses.translation_m, axis=1)
    far = distance > _FAR_M
    if not far.any():
        return
    if far.mean() > 0.9:
        millimetres = float(np.median(distance[far])) > 10 * _FAR_M
        raise InputError(
            f"the {role} poses look like {'millimetres' if millimetres else 'another unit'}, not"
            f" metres: their distance from the origin is {float(np.median(distance)):.0f};"
            f" convert them, or correct the unit in the file's header or pose convention"
        )
    rows = listed([name for name, is_far in zip(names, far, strict=True) if is_far])
    raise InputError(
        f"the {role} poses mix units: {rows} are {float(np.median(distance[far])):.0f} from the"
        f" origin, the others {float(np.median(distance[~far])):.2f}; give all of them in metres"
    )


def _require_motion(pairs: PosePairs, scale_known: bool) -> None:
    """Refuse stale poses: one side stands still while the other moves."""
    unit = 1.0
    if not scale_known:
        size = np.linalg.norm(pairs.camera_from_board.translation_m, axis=1)
        unit = max(float(np.median(size)), 1e-12)
    robot_still = _is_still(pairs.base_from_gripper, 1.0)
    camera_still = _is_still(pairs.camera_from_board, unit)
    if robot_still and not camera_still:
        raise InputError(
            "the robot's pose is the same in every row while the board moves in the images; the"
            " robot poses are stale: read them at the time of each image"
        )
    if camera_still and not robot_still:
        raise InputError(
            "the board's pose is the same in every image while the robot moved; the images or their"
            " poses are stale, or the mount is wrong"
        )


def _is_still(poses: SE3, unit_m: float) -> bool:
    metres, radians = pose_distance(poses[0], poses)
    return bool(metres.max() / unit_m < _STILL_M and radians.max() < _STILL_RAD)
