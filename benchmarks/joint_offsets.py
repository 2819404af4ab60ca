"""Offsets of an arm's joints from a wrist recording: their errors, and those of gripper and mount.

Rooms and cameras are those of the virtual cell; arms are a Panda, and a six- and a five-joint arm
of 0.6 m. The true offsets of the first and the last joint are zero: they define the frames of base
and gripper, and no image shows them. Every recording is also solved without joint values.
"""

import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import stats
from tqdm import tqdm

from benchmarks.accuracy import pose_error
from benchmarks.rows import Row, grouped, median_of, numbers, once, save
from evercal.calibration.calibration import Calibration
from evercal.errors import InputError
from evercal.evaluation.metrics import share_inside
from evercal.geometry import SE3, Camera
from evercal.map import Map
from evercal.recordings.frame import Frame, Recording
from evercal.robot.arm import Arm, MovingJoint
from evercal.simulation import panda_arm
from evercal.simulation.box_room import look_at
from evercal.simulation.cell_room import WORK_AREA_M, cell_room
from evercal.simulation.virtual_cell import CellOptions, VirtualCell

FIRST_SEED = 310
"""Seeds below it are for development."""
CAMERA = Camera(320, 240, 320.0, 320.0, 159.5, 119.5)
NOISE = 2.0
"""Standard deviation of the noise of an image, of 255."""
HELD_OUT = 30
"""Poses of the gripper that no image shows."""
FIXED_IMAGES = 8
"""Images of a fixed camera in the learned map."""


@dataclass(frozen=True, eq=False)
class Robot:
    """An arm, and where its joints move in a recording, radians."""

    arm: Arm
    middle: np.ndarray
    spread: np.ndarray
    forward: np.ndarray
    """(3, 3) axes of a nominal camera in the gripper."""


@dataclass(frozen=True)
class Condition:
    """Errors of an arm, and how many images there are."""

    robot: str
    offset_deg: float = 1.0
    images: int = 25
    encoder_deg: float = 0.02
    """Standard deviation of the noise of a joint value."""
    backlash_deg: float = 0.0
    """Play of each joint: it lags by half of it."""
    sag_deg: float = 0.0
    """Deflection of the second joint of a level arm by its weight."""
    fixed: bool = False
    """Whether a fixed camera sees a box in the gripper of the Panda, instead of a wrist camera."""


CONDITIONS = {
    **{
        f"{robot}, {offset:g} deg": Condition(robot, offset)
        for robot in ("panda", "six", "five")
        for offset in (0.0, 0.2, 1.0, 3.0)
    },
    **{f"six, 1 deg, {n} images": Condition("six", images=n) for n in (50, 100)},
    "six, 1 deg, encoder 0.1 deg": Condition("six", encoder_deg=0.1),
    "six, 1 deg, backlash 0.5 deg": Condition("six", backlash_deg=0.5),
    "six, 1 deg, sag 0.5 deg": Condition("six", sag_deg=0.5),
    "five, 1 deg, backlash 0.5 deg": Condition("five", backlash_deg=0.5),
    **{
        f"panda, {offset:g} deg, fixed camera": Condition("panda", offset, fixed=True)
        for offset in (0.0, 1.0, 3.0)
    },
}


def run(
    out: Path = Path("runs/joint-offsets"), only: tuple[str, ...] = (), draws: int = 10
) -> None:
    """Learn wrist recordings of arms whose joints have offsets, with and without joint values.

    Args:
        out: Folder of the rows; complete recordings are not repeated.
        only: Conditions; all if omitted.
        draws: Recordings of each condition.
    """
    rows: list[Row] = []
    for name in tqdm(only or CONDITIONS, unit="condition"):
        for seed in range(FIRST_SEED, FIRST_SEED + draws):
            file = out / f"{name.replace(' ', '-')}-{seed}.json"
            rows += once(file, lambda n=name, s=seed: _measured(n, s))
    save(out / "joint-offsets.csv", summary(rows), {"draws": draws})


def robot(name: str) -> Robot:
    """The arm of a condition."""
    if name == "panda":
        before = []
        for a, d, alpha in panda_arm.LINKS:
            c = np.cos(alpha)
            s = np.sin(alpha)
            before.append(
                np.array(
                    [[1, 0, 0, a], [0, c, -s, -d * s], [0, s, c, d * c], [0, 0, 0, 1]]
                )
            )
        motions = tuple(
            MovingJoint(b, np.array([0, 0, 1.0]), True, i)
            for i, b in enumerate(before[:7])
        )
        spread = np.array([0.9, 0.4, 0.5, 0.4, 0.6, 0.5, 0.9])
        return Robot(
            Arm(_names(7), motions, before[7]), panda_arm.HOME_RAD, spread, np.eye(3)
        )
    forward = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
    x, y, z = np.eye(3)
    if name == "six":
        steps = [
            (0.15 * z, z),
            (0.05 * z, y),
            (0.3 * z, y),
            (0.28 * x, x),
            (0.04 * x, y),
            (0.06 * x, x),
        ]
        middle = (0, -0.2, 0.3, 0, 1.2, 0)
        spread = (0.8, 0.35, 0.4, 0.5, 0.4, 0.8)
    else:
        steps = [
            (0.15 * z, z),
            (0.03 * x + 0.05 * z, y),
            (0.28 * z, y),
            (0.27 * x, y),
            (0.06 * x, x),
        ]
        middle = (0, -0.1, 0.2, 1.1, 0)
        spread = (0.8, 0.4, 0.5, 0.5, 0.9)
    motions = tuple(
        MovingJoint(SE3.from_translation(at).matrix(), axis, True, i)
        for i, (at, axis) in enumerate(steps)
    )
    arm = Arm(_names(len(steps)), motions, SE3.from_translation(0.06 * x).matrix())
    return Robot(arm, np.array(middle), np.array(spread), forward)


def _names(count: int) -> tuple[str, ...]:
    return tuple(f"joint{i + 1}" for i in range(count))


def _mount(of: Robot, rng: np.random.Generator) -> SE3:
    nominal = np.eye(4)
    nominal[:3, :3] = of.forward
    nominal[:3, 3] = of.forward @ (0.06, 0.0, 0.02)
    tangent = np.r_[rng.uniform(-0.01, 0.01, 3), rng.uniform(-0.12, 0.12, 3)]
    return SE3.from_matrix(nominal) @ SE3.exp(tangent)


def _joints(of: Robot, mount: SE3, count: int, rng: np.random.Generator) -> np.ndarray:
    """Joint values (count, k) at which the camera sees the table, in the order of a tour."""

    def drawn() -> Iterator[np.ndarray]:
        while True:
            values = of.middle + of.spread * rng.uniform(-1, 1, (200, len(of.middle)))
            for joints, pose in zip(values, of.arm.poses(values) @ mount, strict=True):
                aim = pose.inverse().apply(WORK_AREA_M)
                distance = float(np.linalg.norm(aim))
                ahead = aim[2] > np.cos(np.deg2rad(35)) * distance
                if ahead and 0.18 < distance < 0.9 and pose.translation_m[2] > 0.12:
                    yield joints

    source = drawn()
    rest = [next(source) for _ in range(count)]
    tour = [rest.pop(0)]
    while rest:
        away = [float(np.abs(joints - tour[-1]).sum()) for joints in rest]
        tour.append(rest.pop(int(np.argmin(away))))
    return np.array(tour)


class Recorded(NamedTuple):
    """A recording of an arm with errors, and its truth."""

    recording: Recording
    parent_from_camera: SE3
    offsets: np.ndarray
    held_out: np.ndarray
    """(HELD_OUT, k) true joint values of other poses."""
    stated: np.ndarray
    """(HELD_OUT, k) values that the robot reports there."""


def record(condition: Condition, seed: int) -> Recorded:
    """Draw a recording."""
    of = robot(condition.robot)
    rng = np.random.default_rng([seed, 5])
    arm = of.arm
    room = cell_room(seed)
    mount = _mount(of, rng)
    camera = CAMERA
    cell = VirtualCell(seed, CellOptions())
    cell.hold(True)
    if condition.fixed:
        camera = cell.intrinsics
        mount = cell.truth.base_from_tripod
        joints, held_out = (
            _near(cell.holding_poses(n, n)) for n in (condition.images, HELD_OUT)
        )
    else:
        joints = _joints(of, mount, condition.images, rng)
        held_out = _joints(of, mount, HELD_OUT, rng)
    offsets = np.deg2rad(condition.offset_deg) * rng.normal(size=len(arm.joints))
    offsets[[0, -1]] = 0
    stated, stated_out = (
        _stated(condition, v, offsets, rng) for v in (joints, held_out)
    )
    frames = []
    for i, (true, gripper) in enumerate(
        zip(arm.poses(joints), arm.poses(stated), strict=True)
    ):
        if condition.fixed:
            plain = cell.render(mount, joints[i])
        else:
            plain = room.render(CAMERA, true @ mount)
        values = tuple(stated[i].tolist())
        frames.append(
            Frame(
                f"{i:03d}", _noisy(plain, rng), camera, None, gripper, joints_rad=values
            )
        )
    recording = Recording("cell", tuple(frames), (), arm=arm)
    return Recorded(recording, mount, offsets, held_out, stated_out)


def _near(poses: SE3) -> np.ndarray:
    """Joint values of the Panda (n, 7) at poses (n,), each near the one before."""
    values = [panda_arm.HOME_RAD]
    for pose in poses:
        values.append(panda_arm.joints_for(pose, values[-1]))
    return np.array(values[1:])


def _noisy(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.clip(image + rng.normal(0, NOISE, image.shape), 0, 255).astype(np.uint8)


def _measured(name: str, seed: int) -> list[Row]:
    condition = CONDITIONS[name]
    drawn = record(condition, seed)
    rows: list[Row] = []
    for method in ("joint offsets", "poses only"):
        row: Row = {"condition": name, "seed": seed, "method": method}
        arm = robot(condition.robot).arm
        row["gripper_before_mm"] = _gripper_mm(arm, drawn.held_out, drawn.stated)
        rows.append(row)
        recording = drawn.recording
        recording = (
            recording if method == "joint offsets" else replace(recording, arm=None)
        )
        began = time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            cell = Map.open(Path(folder) / "map")
            try:
                if condition.fixed:
                    answer = cell.eye_to_hand(recording, on_progress=lambda *_: None)
                else:
                    cell.learn(recording, on_progress=lambda *_: None)
                    answer = cell.calibration()
                    row |= _of_another_camera(cell, seed)
            except InputError as error:
                row["refused"] = str(error)
                continue
        row |= pose_error(answer.uncertain_pose, drawn.parent_from_camera)
        row["seconds"] = time.process_time() - began
        if method == "joint offsets":
            row |= _offset_error(answer, drawn.offsets)
            corrected = drawn.stated + [joint.offset for joint in answer.joints]
            row["gripper_after_mm"] = _gripper_mm(arm, drawn.held_out, corrected)
    return rows


def _of_another_camera(cell: Map, seed: int) -> Row:
    """Error of a fixed camera in the learned map."""
    rng = np.random.default_rng([seed, 6])
    truth = look_at(WORK_AREA_M + np.array([0.1, -0.45, 0.5]), WORK_AREA_M, 0.05)
    plain = cell_room(seed).render(CAMERA, truth)
    views = [_noisy(plain, rng) for _ in range(FIXED_IMAGES)]
    error = pose_error(cell.calibrate(views, camera=CAMERA).uncertain_pose, truth)
    return {f"fixed_{key}": value for key, value in error.items()}


def _stated(
    condition: Condition,
    joints: np.ndarray,
    offsets: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Joint values that the robot reports at true ones."""
    noise = np.deg2rad(condition.encoder_deg) * rng.normal(size=joints.shape)
    steps = np.diff(
        joints, axis=0, prepend=joints[:1] - rng.normal(size=joints[:1].shape)
    )
    lag = np.deg2rad(condition.backlash_deg) / 2 * np.sign(steps)
    sag = np.zeros_like(joints)
    sag[:, 1] = np.deg2rad(condition.sag_deg) * np.cos(joints[:, 1])
    return joints - offsets - noise + lag - sag


def _gripper_mm(arm: Arm, true: np.ndarray, stated: np.ndarray) -> float:
    away = arm.poses(true).translation_m - arm.poses(stated).translation_m
    return 1000 * float(np.linalg.norm(away, axis=1).mean())


def _offset_error(calibration: Calibration, offsets: np.ndarray) -> Row:
    joints = calibration.joints
    free = [i for i, joint in enumerate(joints) if not joint.open]
    error = np.array([joints[i].offset - offsets[i] for i in free])
    covariance = calibration.joint_covariance[np.ix_(free, free)]
    squared = float(error @ np.linalg.solve(covariance, error))
    return {
        "offset_deg": float(np.rad2deg(np.sqrt((error**2).mean()))),
        "offset_sigma_deg": float(np.rad2deg(np.sqrt(np.diag(covariance).mean()))),
        "offset_inside": float(squared < stats.chi2.ppf(0.95, len(free))),
        "offset_squared": squared / len(free),
        "open_joints": len(joints) - len(free),
    }


def summary(rows: list[Row]) -> list[Row]:
    """One row for each condition and method."""
    lines: list[Row] = []
    for (condition, method), group in grouped(rows, "condition", "method").items():
        solved = [row for row in group if "mm" in row]
        line: Row = {"condition": condition, "method": method, "draws": len(group)}
        line["refused"] = len(group) - len(solved)
        medians = ["gripper_before_mm", "mm", "deg", "sigma_mm"]
        prefixes = [""]
        if len(numbers(solved, "fixed_mm")):
            medians += ["fixed_mm", "fixed_deg"]
            prefixes.append("fixed_")
        line |= {name: median_of(numbers(solved, name)) for name in medians}
        for prefix in prefixes:
            squared = numbers(solved, f"{prefix}squared_mahalanobis")
            line[f"{prefix}inside_95"] = share_inside(squared)
            line[f"{prefix}squared"] = float(squared.mean())
        if method == "joint offsets":
            after = numbers(solved, "gripper_after_mm")
            line["gripper_after_mm"] = median_of(after)
            line["gripper_after_max_mm"] = float(after.max())
            for name in ("offset_deg", "offset_sigma_deg"):
                line[name] = median_of(numbers(solved, name))
            inside = numbers(solved, "offset_inside")
            line["offset_inside_95"] = 100 * float(inside.mean())
            line["offset_squared"] = float(numbers(solved, "offset_squared").mean())
        lines.append(line)
    return lines
