"""Why robot and camera poses do not fit together: which other reading of them would.

A camera that is fixed to the gripper turns by the same angle as the gripper, and the board that it
sees moves by one rigid law. Where poses break it, they were mostly read in a wrong convention:
inverted, transposed, in another order of Euler angles, shifted by a row, in other units. Each of
these is tried; one that makes the pairs agree is named.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

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
"""Disagreement from which other readings are tried."""
HOPELESS_M, HOPELESS_RAD = 0.05, np.deg2rad(3.0)
"""Disagreement from which no answer is given."""
_BETTER = 3.0
"""How many times better another reading must agree, in metres and in radians."""
_FITTED = 24
"""Readings of Euler angles that are fitted, those whose angles agree best."""
_FIXED = ("xyz", "zyx", "xzy", "yxz", "yzx", "zxy")
_USUAL = ("xyz", "ZYX", "XYZ", "zyx")
_ORDERS = (*_USUAL, *_FIXED[2:], *(order.upper() for order in _FIXED[2:]))


@dataclass(frozen=True, eq=False)
class _Reading:
    """The pairs as they would be in another convention."""

    sentence: str
    """What was mistaken and what to do."""
    pairs: PosePairs


def require_agreement(pairs: PosePairs, mount: Mount, scale_known: bool, found: Agreement) -> None:
    """Checks that a fit is good enough to be an answer, and says what is wrong if it is not.

    Args:
        pairs: those that were fitted.
        mount: as given.
        scale_known: as given.
        found: how well they agree.

    Raises:
        InputError: Another reading of the poses fits far better, or they hardly agree at all.
    """
    few = found.inliers.mean() < 0.6
    if found.metres < SUSPECT_M and found.radians < SUSPECT_RAD and not few:
        return
    best, sentence = found, ""
    for reading in _readings(pairs, mount, scale_known):
        other = agreement(reading.pairs.equation(mount, scale_known))
        clear = other.metres * _BETTER < found.metres and other.radians * _BETTER < found.radians
        if clear and _cost(other) < 0.5 * _cost(best):
            best, sentence = other, reading.sentence
    if sentence:
        raise InputError(
            f"{sentence}; read so, the poses agree to {_size(best)}, as given to {_size(found)}"
        )
    if scale_known:
        _require_unit(pairs, mount, found)
    enough = found.inliers.mean() >= 0.5
    if found.metres < HOPELESS_M and found.radians < HOPELESS_RAD and enough:
        return
    raise InputError(f"{_mismatch(pairs)}; {_CAUSES}")


_CAUSES = (
    "check that each row belongs to its image, that the robot stood still, which frames the poses"
    " connect, their Euler or quaternion order, and that the camera was fixed firmly"
)


def _readings(pairs: PosePairs, mount: Mount, scale_known: bool) -> Iterator[_Reading]:
    robot, camera = pairs.base_from_gripper, pairs.camera_from_board
    inverted = replace(pairs, base_from_gripper=robot.inverse())
    yield _Reading(_inversion(inverted, mount, scale_known), inverted)
    for name, part in (("robot", "base_from_gripper"), ("camera", "camera_from_board")):
        poses: SE3 = getattr(pairs, part)
        conjugate = poses.rotation_wxyz * np.array([1.0, -1.0, -1.0, -1.0])
        turned = replace(pairs, **{part: SE3(conjugate, poses.translation_m)})
        yield _Reading(
            f"the rotations of the {name} poses look transposed (their translations do not): swap"
            f" rows and columns of the matrices, or the sign of the quaternions' x y z",
            turned,
        )
    for shift in (1, -1):
        rows = slice(max(shift, 0), len(pairs) + min(shift, 0))
        others = slice(max(-shift, 0), len(pairs) + min(-shift, 0))
        moved = replace(pairs[np.arange(len(pairs))[rows]], camera_from_board=camera[others])
        late = "robot" if shift > 0 else "camera"
        if len(moved) >= MIN_POSES:
            yield _Reading(
                f"rows and images are shifted by one: the {late} poses have one too many at the"
                f" beginning; pair each row with its own image",
                moved,
            )
    yield from _rotation_readings(pairs)


def _inversion(inverted: PosePairs, mount: Mount, scale_known: bool) -> str:
    """What to say of poses that agree once the robot's are inverted.

    Inverted robot poses, inverted camera poses and the other mount obey one equation; the distances
    tell which of them it is.
    """
    at = agreement(inverted.equation(mount, scale_known)).at
    near = float(np.linalg.norm(at.parent_from_camera.translation_m))
    far = float(np.linalg.norm(at.fixed_from_board.translation_m))
    other = "eye_to_hand" if mount == "eye_in_hand" else "eye_in_hand"
    ahead = bool((inverted.camera_from_board.translation_m[:, 2] > 0).all())
    # A camera on the arm is nearer to the gripper than a board to the base; the camera beside the
    # robot is farther from the base than the board from the gripper.
    if (near < far) == (mount == "eye_in_hand"):
        return (
            f"the robot poses look inverted (gripper_from_base): invert them (--invert robot), or,"
            f" if they are base_from_gripper, use --mount {other}"
        )
    if ahead:
        return (
            f"the mount looks like the other one: use --mount {other}, or, if it is {mount}, invert"
            f" the camera poses (--invert camera): they look like board_from_camera"
        )
    return (
        f"the camera poses look inverted (board_from_camera): invert them (--invert camera), or, if"
        f" they are camera_from_board, use --mount {other}"
    )


def _rotation_readings(pairs: PosePairs) -> Iterator[_Reading]:
    """Numbers of rotations that were taken for others; those whose angles agree best."""
    found: list[tuple[float, int, str, PosePairs]] = []
    parts = {"base_from_gripper": "robot", "camera_from_board": "camera"}
    for part, name in parts.items():
        poses: SE3 = getattr(pairs, part)
        other = pairs.camera_from_board if name == "robot" else pairs.base_from_gripper
        for rank, (sentence, rotation) in enumerate(_misread(poses)):
            turned = SE3(rotation.as_quat(scalar_first=True), poses.translation_m)
            mismatch = _angle_mismatch(turned, other)[0]
            reading = replace(pairs, **{part: turned})
            found.append((mismatch, rank, f"the {name} {sentence}", reading))
    # Of orders whose angles agree alike, and cyclic ones do, the usual ones come first.
    found.sort(key=lambda entry: (round(np.rad2deg(entry[0])), entry[1]))
    for _, _, sentence, turned in found[:_FITTED]:
        yield _Reading(sentence, turned)


def _misread(poses: SE3) -> Iterator[tuple[str, Rotation]]:
    """What rotations would be if their numbers had been meant otherwise."""
    wxyz = poses.rotation_wxyz
    given = Rotation.from_quat(wxyz, scalar_first=True)
    yield (
        "quaternions look read in the order w x y z where x y z w is meant; name their order",
        Rotation.from_quat(wxyz),
    )
    yield (
        "quaternions look read in the order x y z w where w x y z is meant; name their order",
        Rotation.from_quat(wxyz[:, [1, 2, 3, 0]], scalar_first=True),
    )
    # Of two orders one may be taken as one about fixed axes: moving axes reverse both.
    pairs = [(used, meant) for used in _FIXED for meant in _ORDERS if used != meant]
    pairs.sort(key=lambda pair: _ORDERS.index(pair[0]) + _ORDERS.index(pair[1]))
    for used, meant in pairs:
        yield (
            f"angles look read in a wrong Euler order: {used} and {meant} seem mixed up (small"
            f" letters: fixed axes; capitals: moving axes); name their order",
            Rotation.from_euler(meant, given.as_euler(used, suppress_warnings=True)),
        )


def _angle_mismatch(a: SE3, b: SE3) -> tuple[float, Array, Array]:
    """By how much the angles between two poses differ, in the better quarter of all pairs.

    Returns:
        Radians, and the angles (n (n - 1) / 2,) of both.
    """
    i, j = np.triu_indices(len(a), 1)
    angles = []
    for poses in (a, b):
        q = poses.rotation_wxyz
        angles.append(2 * np.arccos(np.minimum(np.abs((q[i] * q[j]).sum(1)), 1.0)))
    return float(np.quantile(np.abs(angles[0] - angles[1]), 0.25)), angles[0], angles[1]


def _require_unit(pairs: PosePairs, mount: Mount, found: Agreement) -> None:
    """Lengths of the camera in another unit than the robot's."""
    free = agreement(pairs.equation(mount, False))
    if free.metres * _BETTER > found.metres or free.radians > 1.5 * found.radians + 1e-4:
        return
    scale = free.at.scale
    powers = {0.001: "millimetres", 0.01: "centimetres", 0.0254: "inches"}
    for unit, name in powers.items():
        if abs(np.log(scale / unit)) < 0.1:
            raise InputError(f"the camera poses look like {name}, the robot's like metres; convert")
        if abs(np.log(scale * unit)) < 0.1:
            raise InputError(f"the robot poses look like {name}, the camera's like metres; convert")
    raise InputError(
        f"the camera's lengths fit the robot's only if multiplied by {scale:.4g}; check the board's"
        f" square or tag size and both units, or say --scale unknown"
    )


def _mismatch(pairs: PosePairs) -> str:
    mismatch, robot, camera = _angle_mismatch(pairs.base_from_gripper, pairs.camera_from_board)
    if mismatch < np.deg2rad(2.0):
        return "robot and camera turn alike, but their poses do not fit any mount of the camera"
    i, j = np.triu_indices(len(pairs), 1)
    worst = int(np.argsort(np.abs(robot - camera))[len(robot) // 2])
    first, second = pairs.names[i[worst]], pairs.names[j[worst]]
    return (
        f"robot and camera agree in no rotation: from {first} to {second} the robot turned by"
        f" {np.rad2deg(robot[worst]):.1f} deg, the camera by {np.rad2deg(camera[worst]):.1f} deg,"
        f" and so it is for most pairs"
    )


def _cost(found: Agreement) -> float:
    return max(found.metres, 1e-9) * max(found.radians, 1e-9)


def _size(found: Agreement) -> str:
    return f"{1000 * found.metres:.1f} mm and {np.rad2deg(found.radians):.2f} deg"
