"""Mistakes in pose files: each is made in simulated recordings and must be refused and named."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from benchmarks.hand_eye_boards import BoardSetting, corner_pairs, pose_pairs, record
from benchmarks.rows import save
from evercal.calibration.calibration import Mount
from evercal.calibration.pose_pairs.pairs import PoseNumbers, PosePairs
from evercal.calibration.pose_pairs.solve import solve
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.conventions import (
    numbers_from_poses,
    pose_convention,
    poses_from_numbers,
)

Mistake = Callable[[PosePairs], PosePairs]
_FLIP = SE3(np.array([0.0, 1.0, 0.0, 0.0]), np.zeros(3))
OTHER: dict[Mount, Mount] = {"eye_in_hand": "eye_to_hand", "eye_to_hand": "eye_in_hand"}
FIRST_SEED = 700
"""Seeds below were used while the messages were written."""


def misread(side: str, written: str, read: str) -> Mistake:
    """Poses of `robot` or `camera` written in one convention and read in another."""
    part = "base_from_gripper" if side == "robot" else "camera_from_board"

    def mistake(pairs: PosePairs) -> PosePairs:
        numbers = numbers_from_poses(getattr(pairs, part), pose_convention(written))
        used = pose_convention(read)
        given = PoseNumbers(numbers, used, side == "camera")
        poses = poses_from_numbers(numbers, used)
        return replace(pairs, **{part: poses, f"{side}_numbers": given})

    return mistake


def _later(poses: SE3) -> SE3:
    return poses[np.r_[1 : len(poses), len(poses) - 1]]


def _robot(change: Callable[[SE3], SE3]) -> Mistake:
    return lambda p: replace(p, base_from_gripper=change(p.base_from_gripper))


def _camera(change: Callable[[SE3], SE3]) -> Mistake:
    return lambda p: replace(p, camera_from_board=change(p.camera_from_board))


def _named(side: str, convention: str) -> str:
    return rf"--{side}-convention ({convention})[; ]"


MISTAKES: dict[str, tuple[Mistake, str]] = {
    "board behind the camera (OpenGL axes)": (_camera(lambda c: _FLIP @ c), ":opengl"),
    "files exchanged": (
        lambda p: replace(
            p, base_from_gripper=p.camera_from_board, camera_from_board=p.base_from_gripper
        ),
        "exchange --robot-poses and --camera-poses",
    ),
    "both files inverted": (
        lambda p: replace(
            p,
            base_from_gripper=p.base_from_gripper.inverse(),
            camera_from_board=p.camera_from_board.inverse(),
        ),
        "--invert both",
    ),
    "robot inverted": (_robot(SE3.inverse), "--invert robot"),
    "camera inverted": (_camera(SE3.inverse), "--invert camera"),
    "other mount": (lambda p: p, "use --mount"),
    "robot rows one late": (_robot(_later), "shifted by one"),
    "camera rows one late": (_camera(_later), "shifted by one"),
    "camera in millimetres": (lambda p: p.scaled(1000), "millimetres"),
    "robot in millimetres": (
        _robot(lambda r: SE3(r.rotation_wxyz, 1000 * r.translation_m)),
        "millimetres",
    ),
    "rpy read as rotation vector": (misread("robot", "rpy", "ur"), _named("robot", "rpy")),
    "rotation vector read as rpy": (misread("robot", "ur", "rpy"), _named("robot", "ur")),
    "camera: rpy read as rotation vector": (
        misread("camera", "rpy", "ur"),
        _named("camera", "rpy"),
    ),
    "camera: rotation vector read as rpy": (
        misread("camera", "ur", "rpy"),
        _named("camera", "ur"),
    ),
    "KUKA read as Staubli": (misread("robot", "kuka", "staubli"), _named("robot", "kuka")),
    "Staubli read as KUKA": (misread("robot", "staubli", "kuka"), _named("robot", "staubli")),
    "Yaskawa read as KUKA": (
        misread("robot", "yaskawa", "kuka"),
        _named("robot", "yaskawa|fanuc|kuka:[a-z]+"),
    ),
    "xyzw read as wxyz": (misread("robot", "xyzw", "wxyz"), _named("robot", "xyzw")),
    "wxyz read as xyzw": (misread("robot", "wxyz", "xyzw"), _named("robot", "wxyz")),
    "camera: xyzw read as wxyz": (misread("camera", "xyzw", "wxyz"), _named("camera", "xyzw")),
    "moving ZYZ read as KUKA": (misread("robot", "kawasaki", "kuka"), _named("robot", "kawasaki")),
    "moving YXZ read as Yaskawa": (
        misread("robot", "moving_yxz:mm:deg", "yaskawa"),
        _named("robot", "moving_yxz:mm:deg"),
    ),
    "degrees read as radians": (misread("robot", "rpy:deg", "rpy:rad"), "rpy:deg"),
}
"""A change of correct pairs, and a pattern of the message that names its correction."""


def measure(mount: Mount, name: str, draws: int) -> dict[str, object]:
    """Make one mistake in many recordings."""
    mistake, pattern = MISTAKES[name]
    named, refused, messages = 0, 0, list[str]()
    for seed in range(FIRST_SEED, FIRST_SEED + draws):
        drawn = record(BoardSetting(mount=mount), seed)
        stated = OTHER[mount] if name == "other mount" else mount
        try:
            solve(mistake(pose_pairs(drawn, seed)), stated)
        except InputError as error:
            refused += 1
            named += bool(re.search(pattern, str(error)))
            if not re.search(pattern, str(error)):
                messages.append(str(error)[:120])
        else:
            messages.append("accepted")
    percent = {"refused": 100 * refused / draws, "named": 100 * named / draws}
    return {"mistake": name, "mount": mount, **percent, "otherwise": "; ".join(messages[:1])}


def false_alarms(mount: Mount, corners: bool, draws: int) -> dict[str, object]:
    """Solve recordings without a mistake."""
    refused, warned, messages = 0, 0, list[str]()
    for seed in range(FIRST_SEED, FIRST_SEED + draws):
        drawn = record(BoardSetting(mount=mount), seed)
        pairs, seen = corner_pairs(drawn) if corners else (pose_pairs(drawn, seed), None)
        try:
            warned += bool(solve(pairs, mount, corners=seen).checks["warnings"])
        except InputError as error:
            refused += 1
            messages.append(str(error)[:120])
    name = f"none, {draws} recordings with {'corners' if corners else 'poses'}"
    shares = {"refused": 100 * refused / draws, "warned": 100 * warned / draws}
    return {"mistake": name, "mount": mount, **shares, "otherwise": "; ".join(messages[:1])}


def origins(draws: int) -> dict[str, object]:
    """Renumber the corners from each end of the board; return the largest change of the answer."""
    largest, spread = 0.0, 0.0
    for seed in range(FIRST_SEED, FIRST_SEED + draws):
        drawn = record(BoardSetting(), seed)
        pairs, corners = corner_pairs(drawn)
        base = solve(pairs, "eye_in_hand", corners=corners)
        sigma = np.sqrt(np.diag(base.covariance))
        points = drawn.views[0].points_m
        for corner in (8, 45, 53):  # the other ends of 9x6 corners
            moved = tuple(replace(v, points_m=v.points_m - points[corner]) for v in corners.views)
            shift = SE3.from_translation(points[corner])
            poses = replace(pairs, camera_from_board=pairs.camera_from_board @ shift)
            other = solve(poses, "eye_in_hand", corners=replace(corners, views=moved))
            change = (base.parent_from_child.inverse() @ other.parent_from_child).log()
            largest = max(largest, float((np.abs(change) / sigma).max()))
            ratio = np.sqrt(np.diag(other.covariance)) / sigma
            spread = max(spread, float(np.abs(ratio - 1).max()))
    return {"draws": draws, "largest_change_sigma": largest, "largest_change_of_sigma": spread}


def run(draws: int = 20, clean: int = 100, out: Path = Path("runs/mistakes.csv")) -> None:
    """Mistakes in pose files, recordings without mistakes, and other origins of the board.

    Args:
        draws: Recordings of each mistake and mount.
        clean: Recordings without a mistake, of each mount, with and without corners.
        out: File of the rows.
    """
    mounts: tuple[Mount, ...] = ("eye_in_hand", "eye_to_hand")
    settings: dict[str, object] = {"draws": draws, "clean": clean}
    rows: list[dict[str, object]] = []
    for name in tqdm(MISTAKES, unit="mistake"):
        rows += [measure(mount, name, draws) for mount in mounts]
    for mount in mounts:
        rows += [false_alarms(mount, corners, clean) for corners in (False, True)]
    settings |= origins(draws)
    save(out, rows, settings)
    print(settings)
