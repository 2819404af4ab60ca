"""Mistakes in the input, found by evidence: which other reading of the poses fits them?

A camera on the gripper rotates by the same angle as the gripper. Poses that violate this were
mostly read in a wrong convention, see `evercal.calibration.pose_pairs.readings`. Each of these
readings is tested, and one that makes the pairs agree is reported.

Exchanged files, both files inverted or camera axes of OpenGL leave the pairs in agreement. Geometry
gives them away: a camera sees its board near its optical axis, and a gripper carries what is near.
"""

import numpy as np

from evercal.calibration.pose_pairs.fit import Agreement
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.readings import (
    OTHER_CAMERA,
    OTHER_ROBOT,
    SAME_EQUATION,
    WRONG_MOUNT,
    Reading,
    angles_between,
    other_conventions,
    readings_by,
    shifted,
)
from evercal.calibration.pose_pairs.starts import quick_fit
from evercal.errors import InputError
from evercal.geometry import norms, unit_vectors
from evercal.robot.mount import MountName, mount_named

_MAX_METRES = 0.01
"""Residual of translation above which a reading fails."""
_MAX_RADIANS = np.deg2rad(1.0)
"""Residual of rotation above which a reading fails."""
_MIN_INLIERS = 0.8
"""Share of inliers below which a reading fails."""
_HOPELESS_M = 0.05
"""Residual of translation above which the pairs are refused."""
_HOPELESS_RAD = np.deg2rad(3.0)
"""Residual of rotation above which the pairs are refused."""
_BETTER = 3.0
"""Factor by which a better reading reduces the residuals of translation or of rotation."""
_SPOILT = 1.2
"""Factor by which a better reading may enlarge the other residuals."""
_MORE = 0.2
"""Share of the poses that a better reading explains in addition, if it reduces no residuals."""
_DOUBT_RAD = np.deg2rad(0.1)
"""Residual above which other conventions of tables are tested, even if the given one is usable."""
_NEAR_M = 0.1
"""Usual distance of a camera from its gripper, or of a board from the gripper that holds it."""
_FAR_FROM_BASE_M = 0.7
"""Usual distance of the other one from the base."""
_SPREAD = 0.8
"""Standard deviation of the logarithms of both distances."""
_FIELD_RAD = np.deg2rad(22.0)
"""Usual angle between board and optical axis."""
_ANYWHERE = 0.03
"""Share of boards at any angle."""
_IMAGES = 4.0
"""Number of images that count as independent."""
_CLEARLY = 4.0
"""Logarithm of the likelihood ratio at which another reading is more plausible."""
_MOST = 0.9
"""Share of boards behind the camera that makes the poses suspect."""
_COHERENT = 0.8
"""Length of the mean direction of the boards above which they count as similar."""
_OBLIQUE = np.cos(np.deg2rad(45.0))
"""Cosine of the angle from the optical axis at which similar directions are suspect."""
_LONG_M = 0.4
"""Distance of what the gripper carries that makes the poses suspect."""
_UNITS = {0.001: "millimetres", 0.01: "centimetres", 0.0254: "inches"}
"""Names of units, by metres."""
_CAUSES = (
    "check that each row belongs to its image, that the robot stood still, which frames the poses"
    " connect, their Euler or quaternion order, that the camera was fixed firmly, and that its"
    " focal length and distortion are right"
)


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
    fails = _fails(fit)
    readings: list[Reading] = []
    if fails or (~fit.inliers).sum() > 1:
        readings += shifted(pairs, mount)
    if fails:
        other = mount_named(mount).other.name
        wrong_mount = WRONG_MOUNT.format(other=other, mount=mount)
        readings.append(Reading(wrong_mount, pairs, other))
        readings += readings_by(pairs, mount, OTHER_ROBOT)
    if fails and not own_camera:
        readings += readings_by(pairs, mount, OTHER_CAMERA)
    if fails or fit.radians > _DOUBT_RAD:
        readings += other_conventions(pairs, mount, every=fails)
    _refuse_better(readings, fit, scale_known)
    if not fails and not own_camera:
        _require_plausible(
            Reading("", pairs, mount),
            fit,
            scale_known,
        )
    small = fit.metres < _HOPELESS_M and fit.radians < _HOPELESS_RAD
    if small and fit.inliers.mean() >= 0.5:
        return
    if scale_known:
        _require_unit(pairs, mount, fit)
    raise InputError(
        f"{_mismatch(pairs)}; they agree only to {_size(fit)}, and no other reading fits: no"
        f" order of angles or quaternions, inverse, mount or shift of rows; {_CAUSES}"
    )


def _fails(fit: Agreement) -> bool:
    few = fit.inliers.mean() < _MIN_INLIERS
    return bool(fit.metres > _MAX_METRES or fit.radians > _MAX_RADIANS or few)


def _refuse_better(
    readings: list[Reading],
    fit: Agreement,
    scale_known: bool,
) -> None:
    """Raise InputError for the most plausible of the readings that make the pairs agree best."""
    better = []
    for reading in readings:
        corrected = reading.fit(scale_known)
        if not _fails(corrected) and _better(corrected, fit):
            better.append((corrected, reading))
    if not better:
        return
    # Inverted robot poses, inverted camera poses and the other mount obey the same equation.
    least = min(_cost(corrected) for corrected, _ in better)
    equal = [pair for pair in better if _cost(pair[0]) < 3 * least]
    corrected, likely = max(equal, key=lambda pair: _plausibility(pair[1], pair[0]))
    advice = ""
    if "`invert`" in likely.message:
        advice = "; if `invert` or :inverse is given, leave it out"
    raise InputError(
        f"{likely.message}{advice}; corrected, the poses agree to {_size(corrected)},"
        f" as given to {_size(fit)}"
    )


def _require_plausible(
    given: Reading,
    fit: Agreement,
    scale_known: bool,
) -> None:
    """Refuse pairs that agree, but whose geometry fits another reading far better."""
    board = given.pairs.camera_from_board.translation_m
    rays = unit_vectors(board, 1e-9)
    behind = (rays[:, 2] < 0).mean() > _MOST
    mean = rays.mean(0)
    coherent = float(np.linalg.norm(mean))
    beside = coherent > _COHERENT and mean[2] < _OBLIQUE * coherent
    carried = fit.at.fixed_from_board
    if mount_named(given.mount).moves:
        carried = fit.at.parent_from_camera
    far = np.linalg.norm(carried.translation_m) > _LONG_M
    if not (behind or beside or far):
        return
    highest = -np.inf
    likely = given
    for reading in readings_by(given.pairs, given.mount, SAME_EQUATION):
        plausibility = _plausibility(reading, reading.fit(scale_known))
        if plausibility > highest:
            highest = plausibility
            likely = reading
    board = likely.pairs.camera_from_board.translation_m
    # Within 60 degrees of the optical axis, where a camera may see the board.
    ahead = (board[:, 2] > 0.5 * norms(board)).mean()
    if highest > _plausibility(given, fit) + _CLEARLY and ahead > _MOST:
        raise InputError(likely.message)
    if behind:
        raise InputError(
            "the board is behind the camera: camera poses are camera_from_board, with OpenCV's axes"
            " (z forward); see `camera_convention` and `invert`"
        )


def _better(other: Agreement, fit: Agreement) -> bool:
    ratios = [other.metres / fit.metres, other.radians / fit.radians]
    more = other.inliers.mean() - fit.inliers.mean() > _MORE
    # A pair less cannot explain two outliers, unless the rows after it are shifted.
    if len(other.inliers) < len(fit.inliers):
        more = (~fit.inliers).sum() - (~other.inliers).sum() > 1
    return bool((min(ratios) * _BETTER < 1 or more) and max(ratios) < _SPOILT)


def _plausibility(reading: Reading, fit: Agreement) -> float:
    """Logarithm of the likelihood of the distances and of the directions to the board."""
    usual = np.array([_FAR_FROM_BASE_M, _NEAR_M])
    if mount_named(reading.mount).moves:
        usual = usual[::-1]
    lengths = norms(fit.at.translations)
    lengths = np.maximum(lengths, 0.03)
    deviations = np.log(lengths / usual) / _SPREAD
    board = reading.pairs.camera_from_board.translation_m
    distance = norms(board).clip(1e-9)
    cosine = board[:, 2] / distance
    angle = np.arccos(np.clip(cosine, -1, 1))
    # Half of a normal distribution, mixed with any angle from 0 to pi.
    bell = np.exp(-0.5 * (angle / _FIELD_RAD) ** 2)
    bell = bell / (_FIELD_RAD * np.sqrt(np.pi / 2))
    density = (1 - _ANYWHERE) * bell + _ANYWHERE / np.pi
    of_directions = _IMAGES * np.log(density).mean()
    of_distances = -0.5 * (deviations**2).sum()
    return float(of_directions + of_distances)


def _require_unit(
    pairs: PosePairs,
    mount: MountName,
    fit: Agreement,
) -> None:
    """Refuse camera lengths in another unit than the robot's."""
    free, scale = quick_fit(pairs, mount, False)
    if free.metres * _BETTER > fit.metres or free.radians > 1.5 * fit.radians + 1e-4:
        return
    if scale < 0:
        raise InputError(
            "camera and robot agree only mirrored: switch the mirror of the camera off, or convert"
            " the poses of a left-handed frame"
        )
    message = (
        "the {} poses look like {}, the {}'s like metres; convert them, or state the unit with"
        " `{}_convention`"
    )
    for unit, name in _UNITS.items():
        if abs(np.log(scale / unit)) < 0.1:
            raise InputError(message.format("camera", name, "robot", "camera"))
        if abs(np.log(scale / (1 / unit))) < 0.1:
            raise InputError(message.format("robot", name, "camera", "robot"))
    raise InputError(
        f"the camera's lengths fit the robot's only if multiplied by {scale:.4g}; check the board's"
        f" square or tag size and both units, or estimate the scale with `scale` unknown"
    )


def _mismatch(pairs: PosePairs) -> str:
    robot = angles_between(pairs.base_from_gripper)
    camera = angles_between(pairs.camera_from_board)
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
