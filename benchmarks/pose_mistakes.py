"""Mistakes that turn correct pose pairs into those of wrong files or settings."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from evercal.calibration.pose_pairs.pairs import PoseNumbers, PosePairs
from evercal.geometry import SE3
from evercal.recordings.poses.conventions import (
    CONVENTIONS,
    numbers_from_poses,
    pose_convention,
    poses_from_numbers,
)
from evercal.robot.mount import MountName

Mistake = Callable[[PosePairs], PosePairs]
FLIP = SE3(np.array([0.0, 1.0, 0.0, 0.0]), np.zeros(3))
"""Half a turn about the x axis: the camera axes of OpenGL in those of OpenCV."""
OTHER: dict[MountName, MountName] = {
    "eye_in_hand": "eye_to_hand",
    "eye_to_hand": "eye_in_hand",
}
"""The mount that a camera has not."""


def misread(side: str, written: str, read: str) -> tuple[Mistake, str]:
    """Poses of `robot` or `camera` written in one convention and read in another, and its name."""
    part = "base_from_gripper" if side == "robot" else "camera_from_board"

    def mistake(pairs: PosePairs) -> PosePairs:
        numbers = numbers_from_poses(getattr(pairs, part), pose_convention(written))
        used = pose_convention(read)
        given = PoseNumbers(numbers, used, side == "camera")
        poses = poses_from_numbers(numbers, used)
        return replace(pairs, **{part: poses, f"{side}_numbers": given})

    same = [name for name in CONVENTIONS if order_of(name) == order_of(written)]
    return mistake, rf"`{side}_convention` ({'|'.join(same)})(:\w+)*[; ]"


def order_of(convention: str) -> str:
    """Return what two conventions share that differ in units only; fixed axes as moving ones."""
    layout = pose_convention(convention).layout
    fixed_axes = layout.islower() and layout not in ("wxyz", "xyzw", "vector")
    return layout[::-1].upper() if fixed_axes else layout


def _later(poses: SE3) -> SE3:
    return poses[np.r_[1 : len(poses), len(poses) - 1]]


def _robot(change: Callable[[SE3], SE3]) -> Mistake:
    return lambda p: replace(p, base_from_gripper=change(p.base_from_gripper))


def _camera(change: Callable[[SE3], SE3]) -> Mistake:
    return lambda p: replace(p, camera_from_board=change(p.camera_from_board))


MISTAKES: dict[str, tuple[Mistake, str]] = {
    "board behind the camera (OpenGL axes)": (_camera(lambda c: FLIP @ c), ":opengl"),
    "files exchanged": (
        lambda p: replace(
            p,
            base_from_gripper=p.camera_from_board,
            camera_from_board=p.base_from_gripper,
        ),
        "exchange `robot_poses` and `camera_poses`",
    ),
    "both files inverted": (
        lambda p: replace(
            p,
            base_from_gripper=p.base_from_gripper.inverse(),
            camera_from_board=p.camera_from_board.inverse(),
        ),
        "`invert` both",
    ),
    "robot inverted": (_robot(SE3.inverse), "`invert` robot"),
    "camera inverted": (_camera(SE3.inverse), "`invert` camera"),
    "other mount": (lambda p: p, "use `mount`"),
    "robot rows one late": (_robot(_later), "shifted by one"),
    "camera rows one late": (_camera(_later), "shifted by one"),
    "camera in millimetres": (lambda p: p.scaled(1000), "millimetres"),
    "robot in millimetres": (
        _robot(lambda r: SE3(r.rotation_wxyz, 1000 * r.translation_m)),
        "millimetres",
    ),
    "rpy read as rotation vector": misread("robot", "rpy", "ur"),
    "rotation vector read as rpy": misread("robot", "ur", "rpy"),
    "camera: rpy read as rotation vector": misread("camera", "rpy", "ur"),
    "camera: rotation vector read as rpy": misread("camera", "ur", "rpy"),
    "KUKA read as Staubli": misread("robot", "kuka", "staubli"),
    "Staubli read as KUKA": misread("robot", "staubli", "kuka"),
    "Yaskawa read as KUKA": misread("robot", "yaskawa", "kuka"),
    "xyzw read as wxyz": misread("robot", "xyzw", "wxyz"),
    "wxyz read as xyzw": misread("robot", "wxyz", "xyzw"),
    "camera: xyzw read as wxyz": misread("camera", "xyzw", "wxyz"),
    "moving ZYZ read as KUKA": misread("robot", "kawasaki", "kuka"),
    "moving YXZ read as Yaskawa": misread("robot", "moving_yxz:mm:deg", "yaskawa"),
    "degrees read as radians": (misread("robot", "rpy:deg", "rpy:rad")[0], "rpy:deg"),
}
"""A change of correct pairs, and a pattern of the message that names its correction."""
