"""Other readings of pose pairs: what a mistake in the input would have made of them.

Poses inverted or transposed, the other mount, another order of angles, rows shifted by one.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evercal.calibration.pose_pairs.fit import MIN_POSES, Agreement
from evercal.calibration.pose_pairs.pairs import PoseNumbers, PosePairs
from evercal.calibration.pose_pairs.starts import quick_fit
from evercal.geometry import SE3, pose_distance
from evercal.recordings.poses.conventions import (
    CAMERA_AXES,
    CONVENTIONS,
    OPENGL_FROM_OPENCV,
    pose_convention,
    poses_from_numbers,
)
from evercal.robot.mount import MountName, mount_named
from evercal.typing import Array

_LENGTHS = {1.0: "m", 0.001: "mm"}
"""Words of conventions for units, by metres."""


class Reading(NamedTuple):
    """The pairs in another convention; the message names the mistake and its correction."""

    message: str
    pairs: PosePairs
    mount: MountName

    def fit(self, scale_known: bool) -> Agreement:
        """How well the pairs agree in this convention."""
        return quick_fit(self.pairs, self.mount, scale_known)[0]


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
WRONG_MOUNT = (
    "the mount looks wrong: use `mount` {other}, or, if it is {mount}, invert the robot poses"
    " (`invert` robot)"
)
SAME_EQUATION: dict[str, _Change] = {
    "the files look exchanged: the camera poses look like gripper poses; exchange `robot_poses`"
    " and `camera_poses`": lambda robot, camera: (camera, robot),
    "robot and camera poses look inverted (gripper_from_base and board_from_camera): invert both"
    " (`invert` both)": lambda robot, camera: (robot.inverse(), camera.inverse()),
    "the board is behind the camera, as if the camera poses had OpenGL's axes (y up, z back):"
    " append :opengl to `camera_convention`, or convert the poses to OpenCV's axes (y down, z"
    " forward)": lambda robot, camera: (robot, OPENGL_FROM_OPENCV @ camera),
}
"""Readings that agree as well as the given one, by message."""
OTHER_ROBOT: dict[str, _Change] = {
    "the robot poses look inverted (gripper_from_base): invert them (`invert` robot), or, if they"
    " are base_from_gripper, use `mount` {other}": lambda robot, camera: (
        robot.inverse(),
        camera,
    ),
    _TRANSPOSED.format("robot"): lambda robot, camera: (_transposed(robot), camera),
}
"""Readings with the robot poses in other frames, by message."""
OTHER_CAMERA: dict[str, _Change] = {
    "the camera poses look inverted (board_from_camera): invert them (`invert` camera), or, if they"
    " are camera_from_board, use `mount` {other}": lambda robot, camera: (
        robot,
        camera.inverse(),
    ),
    _TRANSPOSED.format("camera"): lambda robot, camera: (robot, _transposed(camera)),
}
"""Readings with the camera poses in other frames, by message."""


def readings_by(
    pairs: PosePairs, mount: MountName, changes: Mapping[str, _Change]
) -> list[Reading]:
    """Return the pairs after each of the changes."""
    other = mount_named(mount).other.name
    readings = []
    for message, change in changes.items():
        poses = change(pairs.base_from_gripper, pairs.camera_from_board)
        read = PosePairs(pairs.names, *poses)
        readings.append(
            Reading(
                message.format(other=other),
                read,
                mount,
            )
        )
    return readings


def shifted(pairs: PosePairs, mount: MountName) -> list[Reading]:
    """Return the pairs without one extra row of either file, where successive angles fit best."""
    if len(pairs) <= MIN_POSES:
        return []
    robot = pairs.base_from_gripper
    camera = pairs.camera_from_board
    rows = np.arange(len(pairs))
    readings = []
    for role in ("robot", "camera"):
        robot_rows = camera_rows = rows[:-1]
        if role == "robot":
            k = _extra_row(robot, camera)
            robot_rows = np.delete(rows, k)
        else:
            k = _extra_row(camera, robot)
            camera_rows = np.delete(rows, k)
        read = PosePairs(
            pairs.names[:-1],
            robot[robot_rows],
            camera[camera_rows],
        )
        message = _SHIFTED.format(pairs.names[k], role)
        readings.append(Reading(message, read, mount))
    return readings


def _extra_row(poses: SE3, other: SE3) -> int:
    """Row of `poses` without which their successive angles fit those of the other poses best."""
    turned = steps_rad(poses)
    same = steps_rad(other)
    before = np.abs(turned - same)
    after = np.abs(turned[1:] - same[:-1])
    rows = range(len(poses) - 2)
    means = [np.mean([*before[: max(k - 1, 0)], *after[k:]]) for k in rows]
    return int(np.argmin(means))


def steps_rad(poses: SE3) -> Array:
    """(n - 1,) angles between successive poses."""
    return pose_distance(poses[:-1], poses[1:])[1]


def other_conventions(
    pairs: PosePairs,
    mount: MountName,
    every: bool,
) -> list[Reading]:
    """Return the pairs in other conventions of one file: `every`, or those that agree better."""
    robot = pairs.base_from_gripper
    camera = pairs.camera_from_board
    readings: list[Reading] = []

    def read(
        role: str,
        field: str,
        numbers: PoseNumbers | None,
        other: SE3,
    ) -> None:
        if not numbers:  # its file leaves no choice
            return
        for names, poses in _reread(numbers):
            if every or _mismatch_rad(poses, other) < _mismatch_rad(robot, camera):
                meaning = CONVENTIONS[pose_convention(names[0]).base].meaning
                message = (
                    f"the {role} poses look written as {' or '.join(names)} and read as"
                    f" {numbers.convention.name}; give `{role}_convention` {names[0]} ({meaning})"
                )
                corrected = replace(pairs, **{field: poses})
                readings.append(Reading(message, corrected, mount))

    read("robot", "base_from_gripper", pairs.robot_numbers, camera)
    read("camera", "camera_from_board", pairs.camera_numbers, robot)
    return readings


def _reread(numbers: PoseNumbers) -> list[tuple[list[str], SE3]]:
    """Return the poses by other conventions of the same count and unit, with the shortest names."""
    readings: dict[bytes, tuple[list[str], SE3]] = {}
    used = numbers.convention
    kept = [word for word in ("inverse", *CAMERA_AXES) if used.has(word)]
    for name, other in CONVENTIONS.items():
        if numbers.numbers.shape[1] not in other.counts or name == "tum":
            continue
        words = [name]
        if other.metres_per_unit != used.metres_per_unit:
            words.append(_LENGTHS[used.metres_per_unit])
        candidates = [words]
        if other.has_angles:
            candidates.append([*words, "rad" if other.degrees else "deg"])
        for candidate in candidates:
            full_name = ":".join([*candidate, *kept])
            try:
                poses = poses_from_numbers(
                    numbers.numbers, pose_convention(full_name), numbers.camera_from
                )
            except ValueError:  # no rotations in that convention
                continue
            key = (poses.rotation_matrix().round(6) + 0.0).tobytes()  # no -0.0
            readings.setdefault(key, ([], poses))[0].append(full_name)
    for names, _ in readings.values():
        fewest = min(name.count(":") for name in names)
        names[:] = [name for name in names if name.count(":") == fewest]
    return list(readings.values())


def angles_between(poses: SE3) -> Array:
    """Return the angles (n (n - 1) / 2,) between every two of n poses."""
    i, j = np.triu_indices(len(poses), 1)
    return pose_distance(poses[i], poses[j])[1]


def _mismatch_rad(robot: SE3, camera: SE3) -> float:
    return float(
        np.quantile(np.abs(angles_between(robot) - angles_between(camera)), 0.25)
    )
