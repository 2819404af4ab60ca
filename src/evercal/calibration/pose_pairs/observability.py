"""What a recording must hold before anything is solved, each lack with its own sentence."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.pose_pairs.hand_eye import MIN_POSES
from evercal.calibration.pose_pairs.pairs import PosePairs, listed
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance

Array = NDArray[np.floating]

_FAR_M = 20.0
_TURN_RAD, _SECOND_RAD = np.deg2rad(2.0), np.deg2rad(1.0)
_MOVE_M = 0.01
_RECORD = "record 15 to 25 poses that differ by 20 to 60 deg about two axes and by 10 cm or more"


def require_observable(pairs: PosePairs, scale_known: bool = True) -> None:
    """Checks, before solving, that the recording can give an answer.

    Args:
        pairs: all of them, in the order of the recording.
        scale_known: whether the camera's translations are said to be in metres.

    Raises:
        InputError: too few or too few different poses, lengths that are no metres, a robot or a
            camera that never moved, or motions that leave a part of the answer open: translation
            alone, rotation on the spot, rotation about one axis.
    """
    n = len(pairs)
    if n < MIN_POSES:
        raise InputError(
            f"{n} pose {'pair' if n == 1 else 'pairs'}; hand-eye calibration takes at least"
            f" {MIN_POSES}, since fewer leave it open or leave no way to notice a wrong one;"
            f" {_RECORD}"
        )
    _require_metres(pairs.base_from_gripper, pairs.names, "robot")
    if scale_known:
        _require_metres(pairs.camera_from_board, pairs.names, "camera")
    first = pairs.repeats(scale_known)
    different = np.unique(first)
    if len(different) < MIN_POSES:
        raise InputError(
            f"{n} pose pairs hold only {len(different)} different"
            f" {'one' if len(different) == 1 else 'ones'}, the others repeat"
            f" {listed([pairs.names[i] for i in different])}; repeats add nothing: {_RECORD}"
        )
    chosen = pairs[different]
    _require_motion(chosen, scale_known)
    require_turns(chosen.base_from_gripper)
    spread = float(np.sqrt(chosen.base_from_gripper.translation_m.var(0).sum()))
    if spread < _MOVE_M:
        raise InputError(
            f"pure rotation: the gripper only turned on the spot (its positions spread by"
            f" {1000 * spread:.1f} mm); nothing then ties the camera's lengths to the robot's, and"
            f" a wrong board size or unit would pass unseen; move the gripper by 10 cm or more"
            f" between poses as well"
        )


def require_turns(base_from_gripper: SE3) -> None:
    """Checks that the gripper turned about two axes.

    Args:
        base_from_gripper: (n,) different poses.

    Raises:
        InputError: It never turned, or about one axis alone.
    """
    main, second, axis = turn_spread(base_from_gripper)
    if main < _TURN_RAD:
        raise InputError(
            f"pure translation: the gripper never turned (by {np.rad2deg(main):.1f} deg rms), so"
            f" the camera's place on it cannot be told; turn the wrist by 20 to 60 deg between"
            f" poses, about two different axes"
        )
    if second < _SECOND_RAD:
        words = " ".join(f"{value:+.2f}" for value in axis)
        raise InputError(
            f"parallel axes: the gripper turned about one axis only ({words} in its own frame;"
            f" {np.rad2deg(main):.0f} deg rms about it, {np.rad2deg(second):.1f} deg about others),"
            f" so the camera's place along that axis stays open; record poses that also tilt the"
            f" gripper by 20 deg or more about another axis"
        )


def turn_spread(poses: SE3) -> tuple[float, float, Array]:
    """How much poses turn against one another.

    Args:
        poses: (n,), n >= 2.

    Returns:
        Root mean square angle in radians about the main axis and about the next one, and the main
        axis in the frame of a pose.
    """
    chosen = poses[np.unique(np.linspace(0, len(poses) - 1, 100).round().astype(int))]
    i, j = np.triu_indices(len(chosen), 1)
    turns = 2.0 * (chosen[i].inverse() @ chosen[j]).rotation_wxyz[:, 1:]
    values, axes = np.linalg.eigh(turns.T @ turns / len(turns))
    main, second = np.sqrt(np.maximum(values[[2, 1]], 0))
    return float(main), float(second), axes[:, 2]


def _require_metres(poses: SE3, names: Sequence[str], whose: str) -> None:
    far = np.linalg.norm(poses.translation_m, axis=1)
    beyond = far > _FAR_M
    if not beyond.any():
        return
    unit = "millimetres" if float(np.median(far[beyond])) > 10 * _FAR_M else "another unit"
    if beyond.all() or beyond.mean() > 0.9:
        raise InputError(
            f"the {whose} poses look like {unit}, not metres: they lie {float(np.median(far)):.0f}"
            f" from the origin; convert them, or name the file's unit"
        )
    rows = listed([name for name, out in zip(names, beyond, strict=True) if out])
    raise InputError(
        f"the {whose} poses mix units: {rows} lie {float(np.median(far[beyond])):.0f} from the"
        f" origin, the others {float(np.median(far[~beyond])):.2f}; give all of them in metres"
    )


def _require_motion(pairs: PosePairs, scale_known: bool) -> None:
    """One side that stands still while the other moves is stale or stuck."""
    robot_m, robot_rad = _largest(pairs.base_from_gripper)
    camera_m, camera_rad = _largest(pairs.camera_from_board)
    if not scale_known:
        size = np.linalg.norm(pairs.camera_from_board.translation_m, axis=1)
        camera_m /= max(float(np.median(size)), 1e-12)
    still_robot = robot_m < 1e-3 and robot_rad < np.deg2rad(0.1)
    still_camera = camera_m < 1e-3 and camera_rad < np.deg2rad(0.1)
    if still_robot and not still_camera:
        raise InputError(
            "the robot's pose is the same in every row while the camera saw the board move; the"
            " robot poses are stale: read them at the moment of each image"
        )
    if still_camera and not still_robot:
        raise InputError(
            "the board's pose is the same in every image while the robot moved; the images or their"
            " poses are stale, or the mount is the other one"
        )


def _largest(poses: SE3) -> tuple[float, float]:
    metres, radians = pose_distance(poses[0], poses)
    return float(metres.max()), float(radians.max())
