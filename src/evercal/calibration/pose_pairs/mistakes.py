"""Mistakes in the input, found by evidence: which other reading of the poses fits them?

A camera on the gripper rotates by the same angle as the gripper. Poses that violate this were
mostly read in a wrong convention: inverted, transposed, another order of angles, shifted by a row,
another unit. Each of these readings is tested, and one that makes the pairs agree is reported.

Exchanged files, both files inverted or camera axes of OpenGL leave the pairs in agreement. Geometry
gives them away: a camera sees its board near its optical axis, and a gripper carries what is near.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evercal.calibration.pose_pairs.fit import MIN_POSES, Agreement, agreement
from evercal.calibration.pose_pairs.pairs import PoseNumbers, PosePairs
from evercal.calibration.pose_pairs.pose_equation import Extras
from evercal.calibration.pose_pairs.starts import consensus_start
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.recordings.poses.conventions import (
    CONVENTIONS,
    pose_convention,
    poses_from_numbers,
)
from evercal.robot.mount import MountName, mount_named
from evercal.typing import Array

_FAILS_M, _FAILS_RAD, _FEW = 0.01, np.deg2rad(1.0), 0.8
"""A reading fails with larger residuals, or with a smaller share of inliers."""
_HOPELESS_M, _HOPELESS_RAD = 0.05, np.deg2rad(3.0)
"""Residuals above which the pairs are refused."""
_BETTER, _SPOILT, _MORE = 3.0, 1.2, 0.2
"""A better reading reduces residuals of translation or rotation by the first factor, or explains
this share of poses more, and enlarges neither by more than the second factor."""
_DOUBT_RAD = np.deg2rad(0.1)
"""Residual above which other conventions of tables are tested, even if the given one is usable."""
_NEAR_M, _FAR_M, _SPREAD = 0.1, 0.7, 0.8
"""Usual distances of a camera or board from gripper and base; deviation of their logarithms."""
_FIELD_RAD, _ANYWHERE, _IMAGES = np.deg2rad(22.0), 0.03, 4.0
"""Usual angle between board and optical axis; share of any angle; number of independent images."""
_CLEARLY = 4.0
"""Logarithm of the likelihood ratio at which another reading is more plausible."""
_MOST, _COHERENT, _OBLIQUE, _LONG_M = 0.9, 0.8, np.cos(np.deg2rad(45.0)), 0.4
"""Suspect: this share of boards behind the camera, boards of similar directions (length of their
mean) far from the optical axis, or a gripper that reaches so far."""
_LENGTHS = {1.0: "m", 0.001: "mm"}
_FLIP = SE3(np.array([0.0, 1.0, 0.0, 0.0]), np.zeros(3))
_CAUSES = (
    "check that each row belongs to its image, that the robot stood still, which frames the poses"
    " connect, their Euler or quaternion order, and that the camera was fixed firmly"
)


class _Reading(NamedTuple):
    """The pairs in another convention; the message names the mistake and its correction."""

    message: str
    pairs: PosePairs
    mount: MountName


def quick_fit(
    pairs: PosePairs, mount: MountName, scale_known: bool
) -> tuple[Agreement, float]:
    """Return a robust estimate of X and Z alone, and the scale."""
    blank = Extras.nothing(len(pairs))
    start = consensus_start(pairs.equation(mount, blank), scale_known)
    equation = pairs.scaled(start.scale).equation(mount, blank)
    return agreement(equation, start.at), start.scale


def require_agreement(
    pairs: PosePairs,
    mount: MountName,
    scale_known: bool,
    fit: Agreement,
    own_camera: bool,
) -> None:
    """Check that pose pairs agree, or name the mistake.

    What agrees is not accused, and neither are camera poses of our own, from corners or a map.
    """
    outliers = (~fit.inliers).sum() > 1
    readings = _shifted(pairs, mount) if outliers or _fails(fit) else []
    if _fails(fit):
        readings += _readings(pairs, mount, _OTHER_ROBOT)
        readings += _readings(pairs, mount, {} if own_camera else _OTHER_CAMERA)
    if _fails(fit) or fit.radians > _DOUBT_RAD:
        readings += _other_conventions(pairs, mount, every=_fails(fit))
    fits = [(quick_fit(r.pairs, r.mount, scale_known)[0], r) for r in readings]
    better = [
        (other, r) for other, r in fits if not _fails(other) and _better(other, fit)
    ]
    if better:
        # Inverted robot poses, inverted camera poses and the other mount obey the same equation.
        least = min(_cost(other) for other, _ in better)
        equal = [(other, r) for other, r in better if _cost(other) < 3 * least]
        corrected, likely = max(equal, key=lambda pair: _plausibility(pair[1], pair[0]))
        given = "; if --invert or :inverse is given, leave it out" * (
            "--invert" in likely.message
        )
        raise InputError(
            f"{likely.message}{given}; corrected, the poses agree to {_size(corrected)},"
            f" as given to {_size(fit)}"
        )
    if not (_fails(fit) or own_camera):
        _require_plausible(_Reading("", pairs, mount), fit, scale_known)
    enough = fit.inliers.mean() >= 0.5
    if not (fit.metres < _HOPELESS_M and fit.radians < _HOPELESS_RAD and enough):
        if scale_known:
            _require_unit(pairs, mount, fit)
        raise InputError(
            f"{_mismatch(pairs)}; they agree only to {_size(fit)}, and no other reading fits: no"
            f" order of angles or quaternions, inverse, mount or shift of rows; {_CAUSES}"
        )


def _fails(fit: Agreement) -> bool:
    few = fit.inliers.mean() < _FEW
    return bool(fit.metres > _FAILS_M or fit.radians > _FAILS_RAD or few)


def _require_plausible(given: _Reading, fit: Agreement, scale_known: bool) -> None:
    """Refuse pairs that agree, but whose geometry fits another reading far better."""
    camera = given.pairs.camera_from_board
    rays = camera.translation_m / np.linalg.norm(camera.translation_m, axis=1)[
        :, None
    ].clip(1e-9)
    behind = (rays[:, 2] < 0).mean() > _MOST
    mean = rays.mean(0)
    coherent = float(np.linalg.norm(rays.mean(0)))
    beside = coherent > _COHERENT and mean[2] < _OBLIQUE * coherent
    x = fit.at.parent_from_camera
    z = fit.at.fixed_from_board
    carried = x if mount_named(given.mount).moves else z
    if not (behind or beside or np.linalg.norm(carried.translation_m) > _LONG_M):
        return
    others = [
        (_plausibility(r, quick_fit(r.pairs, r.mount, scale_known)[0]), r)
        for r in _readings(given.pairs, given.mount, _SAME_EQUATION)
    ]
    plausibility, best = max(others, key=lambda other: other[0])
    board = best.pairs.camera_from_board.translation_m
    # Within 60 degrees of the optical axis, where a camera may see the board.
    ahead = (board[:, 2] > 0.5 * np.linalg.norm(board, axis=1)).mean()
    if plausibility > _plausibility(given, fit) + _CLEARLY and ahead > _MOST:
        raise InputError(best.message)
    if behind:
        raise InputError(
            "the board is behind the camera: camera poses are camera_from_board, with OpenCV's axes"
            " (z forward); see --camera-convention and --invert"
        )


def _better(other: Agreement, fit: Agreement) -> bool:
    ratios = other.metres / fit.metres, other.radians / fit.radians
    more = other.inliers.mean() - fit.inliers.mean() > _MORE
    # A pair less cannot explain two outliers, unless the rows after it are shifted.
    if len(other.inliers) < len(fit.inliers):
        more = (~fit.inliers).sum() - (~other.inliers).sum() > 1
    return bool((min(ratios) * _BETTER < 1 or more) and max(ratios) < _SPOILT)


def _plausibility(reading: _Reading, fit: Agreement) -> float:
    x = fit.at.parent_from_camera
    z = fit.at.fixed_from_board
    on_arm = mount_named(reading.mount).moves
    usual = (_NEAR_M, _FAR_M) if on_arm else (_FAR_M, _NEAR_M)
    lengths = np.array(
        [np.linalg.norm(x.translation_m), np.linalg.norm(z.translation_m)]
    )
    ratio = np.log(np.maximum(lengths, 0.03) / usual) / _SPREAD
    board = reading.pairs.camera_from_board.translation_m
    angle = np.arccos(
        np.clip(board[:, 2] / np.linalg.norm(board, axis=1).clip(1e-9), -1, 1)
    )
    bell = np.exp(-0.5 * (angle / _FIELD_RAD) ** 2) / (_FIELD_RAD * np.sqrt(np.pi / 2))
    seen = np.log((1 - _ANYWHERE) * bell + _ANYWHERE / np.pi)
    return float(_IMAGES * seen.mean() - 0.5 * (ratio**2).sum())


def _transposed(poses: SE3) -> SE3:
    return SE3(poses.rotation_wxyz * [1.0, -1.0, -1.0, -1.0], poses.translation_m)


_Change = Callable[[SE3, SE3], tuple[SE3, SE3]]
_TRANSPOSED = (
    "the rotations of the {} poses look transposed (their translations do not): swap rows and"
    " columns of the matrices, or the sign of the quaternions' x y z"
)
_SHIFTED = (
    "rows and images are shifted by one from {} on: the {} poses have an extra pose there; pair"
    " each row with its own image"
)
_WRONG_MOUNT = (
    "the mount looks wrong: use --mount {other}, or, if it is {mount}, invert the robot poses"
    " (--invert robot)"
)
_SAME_EQUATION: dict[str, _Change] = {
    "the files look exchanged: the camera poses look like gripper poses; exchange --robot-poses"
    " and --camera-poses": lambda robot, camera: (camera, robot),
    "robot and camera poses look inverted (gripper_from_base and board_from_camera): invert both"
    " (--invert both)": lambda robot, camera: (robot.inverse(), camera.inverse()),
    "the board is behind the camera, as if the camera poses had OpenGL's axes (y up, z back):"
    " append :opengl to --camera-convention, or convert the poses to OpenCV's axes (y down, z"
    " forward)": lambda robot, camera: (robot, _FLIP @ camera),
}
"""Readings that agree as well as the given one."""
_OTHER_ROBOT: dict[str, _Change] = {
    "the robot poses look inverted (gripper_from_base): invert them (--invert robot), or, if they"
    " are base_from_gripper, use --mount {other}": lambda robot, camera: (
        robot.inverse(),
        camera,
    ),
    _WRONG_MOUNT: lambda robot, camera: (robot, camera),
    _TRANSPOSED.format("robot"): lambda robot, camera: (_transposed(robot), camera),
}
_OTHER_CAMERA: dict[str, _Change] = {
    "the camera poses look inverted (board_from_camera): invert them (--invert camera), or, if they"
    " are camera_from_board, use --mount {other}": lambda robot, camera: (
        robot,
        camera.inverse(),
    ),
    _TRANSPOSED.format("camera"): lambda robot, camera: (robot, _transposed(camera)),
}
"""Readings in other frames, or with the other mount."""


def _readings(
    pairs: PosePairs, mount: MountName, changes: Mapping[str, _Change]
) -> list[_Reading]:
    other = mount_named(mount).other.name
    readings = []
    for message, change in changes.items():
        robot, camera = change(pairs.base_from_gripper, pairs.camera_from_board)
        to = other if message == _WRONG_MOUNT else mount
        read = PosePairs(pairs.names, robot, camera)
        readings.append(_Reading(message.format(other=other, mount=mount), read, to))
    return readings


def _shifted(pairs: PosePairs, mount: MountName) -> list[_Reading]:
    """Return the pairs without one extra row of either file, where successive angles fit best."""
    if len(pairs) <= MIN_POSES:
        return []
    whole = np.arange(len(pairs))
    readings = []
    sides = {"robot": pairs.base_from_gripper, "camera": pairs.camera_from_board}
    for extra, other in (("robot", "camera"), ("camera", "robot")):
        turned, same = (
            pose_distance(p[:-1], p[1:])[1] for p in (sides[extra], sides[other])
        )
        before = np.abs(turned - same)
        after = np.abs(turned[1:] - same[:-1])
        mean = [
            np.mean([*before[: max(k - 1, 0)], *after[k:]])
            for k in range(len(pairs) - 2)
        ]
        k = int(np.argmin(mean))
        rows = {extra: np.delete(whole, k), other: whole[:-1]}
        read = PosePairs(
            pairs.names[:-1],
            sides["robot"][rows["robot"]],
            sides["camera"][rows["camera"]],
        )
        readings.append(_Reading(_SHIFTED.format(pairs.names[k], extra), read, mount))
    return readings


def _other_conventions(
    pairs: PosePairs, mount: MountName, every: bool
) -> list[_Reading]:
    """Return the pairs in other conventions of one file: `every`, or those that agree better."""
    robot = pairs.base_from_gripper
    camera = pairs.camera_from_board
    readings = list[_Reading]()
    for name, part, other, given in (
        ("robot", "base_from_gripper", camera, pairs.robot_numbers),
        ("camera", "camera_from_board", robot, pairs.camera_numbers),
    ):
        if given is None:  # its file leaves no choice
            continue
        for meant, corrected in _reread(given):
            if every or _mismatch_rad(corrected, other) < _mismatch_rad(robot, camera):
                message = (
                    f"the {name} poses look written as {' or '.join(meant)} and read as"
                    f" {given.convention.name}; give --{name}-convention {meant[0]}"
                    f" ({CONVENTIONS[pose_convention(meant[0]).base].meaning})"
                )
                readings.append(
                    _Reading(message, replace(pairs, **{part: corrected}), mount)
                )
    return readings


def _reread(given: PoseNumbers) -> list[tuple[list[str], SE3]]:
    """Return the poses by other conventions of the same count and unit, with the shortest names."""
    readings: dict[bytes, tuple[list[str], SE3]] = {}
    used = given.convention
    kept = [word for word in ("inverse", "opengl") if used.has(word)]
    for name, other in CONVENTIONS.items():
        if given.numbers.shape[1] not in other.counts or name == "tum":
            continue
        same_unit = other.metres_per_unit == used.metres_per_unit
        length = "" if same_unit else _LENGTHS[used.metres_per_unit]
        for angle in (
            ("", "deg" if not other.degrees else "rad") if other.has_angles else ("",)
        ):
            meant = ":".join(filter(None, (name, length, angle, *kept)))
            try:
                convention = pose_convention(meant)
                corrected = poses_from_numbers(
                    given.numbers, convention, given.camera_from
                )
            except ValueError:  # no rotations in that convention
                continue
            key = (corrected.rotation_matrix().round(6) + 0.0).tobytes()  # no -0.0
            readings.setdefault(key, ([], corrected))[0].append(meant)
    for names, _ in readings.values():
        fewest = min(name.count(":") for name in names)
        names[:] = [name for name in names if name.count(":") == fewest]
    return list(readings.values())


def _angles(poses: SE3) -> Array:
    i, j = np.triu_indices(len(poses), 1)
    return pose_distance(poses[i], poses[j])[1]


def _mismatch_rad(robot: SE3, camera: SE3) -> float:
    return float(np.quantile(np.abs(_angles(robot) - _angles(camera)), 0.25))


def _require_unit(pairs: PosePairs, mount: MountName, fit: Agreement) -> None:
    """Refuse camera lengths in another unit than the robot's."""
    free, scale = quick_fit(pairs, mount, False)
    if free.metres * _BETTER > fit.metres or free.radians > 1.5 * fit.radians + 1e-4:
        return
    for unit, name in {
        0.001: "millimetres",
        0.01: "centimetres",
        0.0254: "inches",
    }.items():
        for factor, side, other in (
            (unit, "camera", "robot"),
            (1 / unit, "robot", "camera"),
        ):
            if abs(np.log(scale / factor)) < 0.1:
                raise InputError(
                    f"the {side} poses look like {name}, the {other}'s like metres; convert them,"
                    f" or state the unit with --{side}-convention"
                )
    raise InputError(
        f"the camera's lengths fit the robot's only if multiplied by {scale:.4g}; check the board's"
        f" square or tag size and both units, or estimate the scale with --scale unknown"
    )


def _mismatch(pairs: PosePairs) -> str:
    robot = _angles(pairs.base_from_gripper)
    camera = _angles(pairs.camera_from_board)
    differences = np.abs(robot - camera)
    if np.quantile(differences, 0.25) < np.deg2rad(2.0):
        return "rotations of robot and camera agree, but no mount of the camera fits their poses"
    i, j = np.triu_indices(len(pairs), 1)
    typical = int(np.argsort(differences)[len(differences) // 2])
    return (
        f"rotations of robot and camera are inconsistent: from {pairs.names[i[typical]]} to"
        f" {pairs.names[j[typical]]} the robot rotated by {np.rad2deg(robot[typical]):.1f} deg, the"
        f" camera by {np.rad2deg(camera[typical]):.1f} deg (typical)"
    )


def _cost(fit: Agreement) -> float:
    return max(fit.metres, 1e-9) * max(fit.radians, 1e-9)


def _size(fit: Agreement) -> str:
    return f"{1000 * fit.metres:.1f} mm and {np.rad2deg(fit.radians):.2f} deg"
