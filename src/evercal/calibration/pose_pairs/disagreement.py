"""Diagnosis of pose pairs that do not agree: test whether another pose convention would fit.

A camera fixed to the gripper rotates by the same angle as the gripper. Poses that violate this were
mostly read in a wrong convention: inverted, transposed, another order of Euler angles, shifted by a
row, another unit. Each of these readings is tested, and one that makes the pairs agree is reported.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from evercal.calibration.calibration import Mount
from evercal.calibration.pose_pairs.hand_eye import MIN_POSES, Agreement, agreement
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.errors import InputError
from evercal.geometry import SE3

Array = NDArray[np.floating]

SUSPECT_M, SUSPECT_RAD = 0.01, np.deg2rad(1.0)
"""Residuals above which other readings are tested."""
HOPELESS_M, HOPELESS_RAD = 0.05, np.deg2rad(3.0)
"""Residuals above which the pairs are refused."""
_BETTER = 3.0
"""Factor by which another reading must reduce the residuals."""
_FITTED = 24
"""Number of rotation readings to fit, sorted by angle differences."""
_FIXED = ("xyz", "zyx", "xzy", "yxz", "yzx", "zxy")
_USUAL = ("xyz", "ZYX", "XYZ", "zyx")
_ORDERS = (*_USUAL, *_FIXED[2:], *(order.upper() for order in _FIXED[2:]))
_CAUSES = (
    "check that each row belongs to its image, that the robot stood still, which frames the poses"
    " connect, their Euler or quaternion order, and that the camera was fixed firmly"
)


class _Reading(NamedTuple):
    """The pairs in another convention."""

    message: str
    """The mistake and its correction."""
    pairs: PosePairs


class _Angles(NamedTuple):
    """Rotation angles between all pairs of poses, radians."""

    mismatch: float
    """Lower quartile of the differences between robot and camera."""
    robot: Array
    camera: Array


def require_agreement(pairs: PosePairs, mount: Mount, scale_known: bool, fit: Agreement) -> None:
    """Check that pose pairs agree, and diagnose them otherwise.

    Raises:
        InputError: Another reading of the poses fits far better, or the residuals are too large.
    """
    few = fit.inliers.mean() < 0.6
    if fit.metres < SUSPECT_M and fit.radians < SUSPECT_RAD and not few:
        return
    best, message = fit, ""
    for reading in _readings(pairs, mount, scale_known):
        other = agreement(reading.pairs.equation(mount, scale_known))
        clear = other.metres * _BETTER < fit.metres and other.radians * _BETTER < fit.radians
        if clear and _cost(other) < 0.5 * _cost(best):
            best, message = other, reading.message
    if message:
        raise InputError(
            f"{message}; corrected, the poses agree to {_size(best)}, as given to {_size(fit)}"
        )
    if scale_known:
        _require_unit(pairs, mount, fit)
    enough = fit.inliers.mean() >= 0.5
    if not (fit.metres < HOPELESS_M and fit.radians < HOPELESS_RAD and enough):
        raise InputError(f"{_mismatch(pairs)}; {_CAUSES}")


def _readings(pairs: PosePairs, mount: Mount, scale_known: bool) -> Iterator[_Reading]:
    robot, camera = pairs.base_from_gripper, pairs.camera_from_board
    inverted = replace(pairs, base_from_gripper=robot.inverse())
    yield _Reading(_inversion(inverted, mount, scale_known), inverted)
    for name, part in (("robot", "base_from_gripper"), ("camera", "camera_from_board")):
        poses: SE3 = getattr(pairs, part)
        conjugate = poses.rotation_wxyz * np.array([1.0, -1.0, -1.0, -1.0])
        yield _Reading(
            f"the rotations of the {name} poses look transposed (their translations do not): swap"
            f" rows and columns of the matrices, or the sign of the quaternions' x y z",
            replace(pairs, **{part: SE3(conjugate, poses.translation_m)}),
        )
    for shift, late in ((1, "robot"), (-1, "camera")):
        rows = slice(max(shift, 0), len(pairs) + min(shift, 0))
        others = slice(max(-shift, 0), len(pairs) + min(-shift, 0))
        shifted = replace(pairs[np.arange(len(pairs))[rows]], camera_from_board=camera[others])
        if len(shifted) >= MIN_POSES:
            yield _Reading(
                f"rows and images are shifted by one: the {late} poses have an extra pose at the"
                f" beginning; pair each row with its own image",
                shifted,
            )
    yield from _rotation_readings(pairs)


def _inversion(inverted: PosePairs, mount: Mount, scale_known: bool) -> str:
    """Return the message for pairs that agree after inversion of the robot poses.

    Inverted robot poses, inverted camera poses and the other mount obey the same equation. The
    estimated distances decide between them.
    """
    at = agreement(inverted.equation(mount, scale_known)).at
    camera = float(np.linalg.norm(at.parent_from_camera.translation_m))
    board = float(np.linalg.norm(at.fixed_from_board.translation_m))
    other = "eye_to_hand" if mount == "eye_in_hand" else "eye_in_hand"
    in_front = bool((inverted.camera_from_board.translation_m[:, 2] > 0).all())
    # A camera on the arm is nearer to the gripper than the board is to the base; a fixed camera is
    # farther from the base than the board is from the gripper.
    if (camera < board) == (mount == "eye_in_hand"):
        return (
            f"the robot poses look inverted (gripper_from_base): invert them (--invert robot), or,"
            f" if they are base_from_gripper, use --mount {other}"
        )
    if in_front:
        return (
            f"the mount looks wrong: use --mount {other}, or, if it is {mount}, invert the camera"
            f" poses (--invert camera): they look like board_from_camera"
        )
    return (
        f"the camera poses look inverted (board_from_camera): invert them (--invert camera), or, if"
        f" they are camera_from_board, use --mount {other}"
    )


def _rotation_readings(pairs: PosePairs) -> Iterator[_Reading]:
    """Yield other readings of the rotations, sorted by angle differences."""
    readings: list[tuple[float, int, _Reading]] = []
    for part, name in {"base_from_gripper": "robot", "camera_from_board": "camera"}.items():
        poses: SE3 = getattr(pairs, part)
        other = pairs.camera_from_board if name == "robot" else pairs.base_from_gripper
        for rank, (message, rotation) in enumerate(_misread(poses)):
            corrected = SE3(rotation.as_quat(scalar_first=True), poses.translation_m)
            mismatch = round(np.rad2deg(_angles(corrected, other).mismatch))
            reading = _Reading(f"the {name} {message}", replace(pairs, **{part: corrected}))
            readings.append((mismatch, rank, reading))
    # Cyclic orders often have equal mismatch; the usual orders come first.
    readings.sort(key=lambda entry: entry[:2])
    yield from (reading for _, _, reading in readings[:_FITTED])


def _misread(poses: SE3) -> Iterator[tuple[str, Rotation]]:
    """Yield the rotations after correction of each possible misreading, with its message."""
    wxyz = poses.rotation_wxyz
    given = Rotation.from_quat(wxyz, scalar_first=True)
    yield (
        "quaternions look read in the order w x y z but written as x y z w; state their order",
        Rotation.from_quat(wxyz),
    )
    yield (
        "quaternions look read in the order x y z w but written as w x y z; state their order",
        Rotation.from_quat(wxyz[:, [1, 2, 3, 0]], scalar_first=True),
    )
    # Rotation about moving axes in one order equals fixed axes in reverse order.
    orders = [(used, meant) for used in _FIXED for meant in _ORDERS if used != meant]
    orders.sort(key=lambda pair: _ORDERS.index(pair[0]) + _ORDERS.index(pair[1]))
    for used, meant in orders:
        yield (
            f"angles look read in a wrong Euler order: {used} and {meant} seem mixed up (small"
            f" letters: fixed axes; capitals: moving axes); state their order",
            Rotation.from_euler(meant, given.as_euler(used, suppress_warnings=True)),
        )


def _angles(robot: SE3, camera: SE3) -> _Angles:
    i, j = np.triu_indices(len(robot), 1)
    angles = []
    for poses in (robot, camera):
        q = poses.rotation_wxyz
        angles.append(2 * np.arccos(np.minimum(np.abs((q[i] * q[j]).sum(1)), 1.0)))
    return _Angles(float(np.quantile(np.abs(angles[0] - angles[1]), 0.25)), *angles)


def _require_unit(pairs: PosePairs, mount: Mount, fit: Agreement) -> None:
    """Refuse camera lengths in another unit than the robot's."""
    free = agreement(pairs.equation(mount, False))
    if free.metres * _BETTER > fit.metres or free.radians > 1.5 * fit.radians + 1e-4:
        return
    scale = free.at.scale
    units = {0.001: "millimetres", 0.01: "centimetres", 0.0254: "inches"}
    for unit, name in units.items():
        if abs(np.log(scale / unit)) < 0.1:
            raise InputError(f"the camera poses look like {name}, the robot's like metres; convert")
        if abs(np.log(scale * unit)) < 0.1:
            raise InputError(f"the robot poses look like {name}, the camera's like metres; convert")
    raise InputError(
        f"the camera's lengths fit the robot's only if multiplied by {scale:.4g}; check the board's"
        f" square or tag size and both units, or estimate the scale with --scale unknown"
    )


def _mismatch(pairs: PosePairs) -> str:
    angles = _angles(pairs.base_from_gripper, pairs.camera_from_board)
    if angles.mismatch < np.deg2rad(2.0):
        return "rotations of robot and camera agree, but no mount of the camera fits their poses"
    i, j = np.triu_indices(len(pairs), 1)
    differences = np.abs(angles.robot - angles.camera)
    typical = int(np.argsort(differences)[len(differences) // 2])
    return (
        f"robot and camera agree in no rotation: from {pairs.names[i[typical]]} to"
        f" {pairs.names[j[typical]]} the robot turned by {np.rad2deg(angles.robot[typical]):.1f}"
        f" deg, the camera by {np.rad2deg(angles.camera[typical]):.1f} deg; most pairs differ"
        f" by as much"
    )


def _cost(fit: Agreement) -> float:
    return max(fit.metres, 1e-9) * max(fit.radians, 1e-9)


def _size(fit: Agreement) -> str:
    return f"{1000 * fit.metres:.1f} mm and {np.rad2deg(fit.radians):.2f} deg"
