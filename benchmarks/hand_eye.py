"""Hand-eye calibration from simulated pose pairs: errors, ellipsoids, outliers, scale, time."""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm
from tyro.conf import arg

from benchmarks.rows import median_of, save
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.solve import solve
from evercal.evaluation.metrics import share_inside
from evercal.geometry import SE3
from evercal.robot.mount import MountName


@dataclass(frozen=True)
class Setting:
    """Options of a simulation."""

    mount: MountName = "eye_in_hand"
    """Mount of the camera."""
    poses: int = 25
    """Number of pairs."""
    path: str = "random"
    """`random`: any rotation within a metre. `table`: views of a table, tilted by about 30 deg."""
    noisy: str = "camera"
    """Poses with noise: `camera`, `robot` or `both`."""
    at: str = "own"
    """Centre of rotation noise. `own`: the origin of the board or gripper. `far`: the origin of the
    camera or base, which also shifts the pose."""
    noise_mm: float = 2.0
    """Standard deviation of translation per axis."""
    noise_deg: float = 0.2
    """Standard deviation of rotation per axis."""
    outliers: int = 0
    """Pairs whose camera pose is off by 5 cm and 20 deg."""
    scale: float | None = None
    """Metres per unit of the camera's lengths; None for metres."""


@dataclass(frozen=True, eq=False)
class SimulatedPairs:
    """Simulated pairs and their truth."""

    pairs: PosePairs
    """The pairs."""
    parent_from_camera: SE3
    """True pose of the camera."""
    fixed_from_board: SE3
    """True pose of the board."""
    spoiled: tuple[int, ...]
    """Indices of outliers."""


def recording(setting: Setting, seed: int) -> SimulatedPairs:
    """Draw one recording."""
    rng = np.random.default_rng(seed)
    n = setting.poses
    on_arm = setting.mount == "eye_in_hand"
    if setting.path == "table":
        tilt = Rotation.from_rotvec(rng.normal(0, 0.5, (n, 3)))
        rotation = tilt * Rotation.from_euler("x", np.pi)
        position = np.array([0.5, 0.0, 0.5]) + rng.uniform(-1, 1, (n, 3)) * (
            0.2,
            0.2,
            0.12,
        )
    else:
        rotation = Rotation.random(n, rng=rng)
        position = rng.uniform(-0.5, 0.5, (n, 3))
    robot = pose(rotation, position)
    near = rng.normal(0, 0.07, 3)
    far = rng.normal(0, 0.4, 3)
    shifts = (near, far) if on_arm else (far, near)
    camera_in, board_in = (pose(Rotation.random(rng=rng), shift) for shift in shifts)
    fixed_from_parent = robot if on_arm else robot.inverse()
    camera = camera_in.inverse() @ fixed_from_parent.inverse() @ board_in
    if setting.path == "table" or not on_arm:  # the camera looks at the board
        middle = camera.translation_m.mean(0)
        turn = pose(Rotation.align_vectors([[0, 0, 1]], [middle])[0], np.zeros(3))
        camera = turn @ camera
        camera_in = camera_in @ turn.inverse()
    if setting.noisy in ("robot", "both"):
        robot = shaken(robot, setting, rng)
    if setting.noisy in ("camera", "both"):
        camera = shaken(camera, setting, rng)
    spoiled = np.sort(rng.choice(n, setting.outliers, replace=False))
    camera = with_outliers(camera, spoiled, rng)
    camera = SE3(camera.rotation_wxyz, camera.translation_m / (setting.scale or 1.0))
    pairs = PosePairs(tuple(f"row {i + 1}" for i in range(n)), robot, camera)
    return SimulatedPairs(pairs, camera_in, board_in, tuple(int(i) for i in spoiled))


def with_outliers(poses: SE3, indices: np.ndarray, rng: np.random.Generator) -> SE3:
    """Move some of the poses (n,) by 5 cm, and turn them by 20 degrees."""
    quaternions = poses.rotation_wxyz.copy()
    translations = poses.translation_m.copy()
    for i in indices:
        axis, direction = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        turned = rotations(poses[i]) * Rotation.from_rotvec(np.deg2rad(20) * axis)
        quaternions[i] = turned.as_quat(scalar_first=True)
        translations[i] += 0.05 * direction
    return SE3(quaternions, translations)


def pose(rotation: Rotation, translation: np.ndarray) -> SE3:
    """Combine rotations and translations."""
    return SE3(rotation.as_quat(scalar_first=True), translation)


def rotations(poses: SE3) -> Rotation:
    """Return the rotations of poses."""
    return Rotation.from_quat(poses.rotation_wxyz, scalar_first=True)


def shaken(poses: SE3, setting: Setting, rng: np.random.Generator) -> SE3:
    """Add noise to poses."""
    n = len(poses)
    rotation = Rotation.from_rotvec(
        rng.normal(0, np.deg2rad(setting.noise_deg), (n, 3))
    )
    shift = rng.normal(0, setting.noise_mm / 1000, (n, 3))
    if setting.at == "far":
        return pose(rotation, shift) @ poses
    return pose(rotations(poses) * rotation, poses.translation_m + shift)


def error(estimate: SE3, truth: SE3) -> np.ndarray:
    """Return translation in the parent's axes and rotation about the child's, shape (6,)."""
    rotation = rotations(truth).inv() * rotations(estimate)
    return np.concatenate(
        [estimate.translation_m - truth.translation_m, rotation.as_rotvec()]
    )


def trials(setting: Setting, count: int, first_seed: int = 0) -> dict[str, float]:
    """Solve many recordings of one setting, and summarize errors and times."""
    mm = []
    deg = []
    squared = []
    named = []
    ms = []
    scale = []
    for seed in range(first_seed, first_seed + count):
        drawn = recording(setting, seed)
        began = time.process_time()
        result = solve(drawn.pairs, setting.mount, setting.scale is None)
        ms.append(1000 * (time.process_time() - began))
        off = error(result.parent_from_child, drawn.parent_from_camera)
        mm.append(1000 * np.linalg.norm(off[:3]))
        deg.append(np.rad2deg(np.linalg.norm(off[3:])))
        squared.append(
            result.uncertain_pose.squared_mahalanobis(drawn.parent_from_camera)
        )
        left_out = tuple(i for i, image in enumerate(result.images) if not image.used)
        named.append(left_out == drawn.spoiled)
        if setting.scale is not None:
            scale.append(
                100 * abs(result.checks.to_dict()["scale"] / setting.scale - 1)
            )
    return {
        "median mm": median_of(mm),
        "median deg": median_of(deg),
        "largest mm": float(max(mm)),
        "inside 95 %": share_inside(squared),
        "outliers exactly": 100 * float(np.mean(named)),
        "scale off %": float(max(scale)) if scale else float("nan"),
        "median ms": median_of(ms),
        "slowest ms": float(max(ms)),
    }


def run(
    count: Annotated[int, arg(name="trials")] = 1000,
    thorough: bool = False,
    out: Path = Path("runs/handeye.csv"),
) -> None:
    """Solve simulated pose pairs: errors, 95 % ellipsoids, outliers, scale, time.

    Args:
        count: Trials of each setting.
        thorough: Add noise on robot poses and on both, about near and far points.
        out: File of the rows.
    """
    settings = [
        Setting(mount=mount, path=path, outliers=outliers)
        for path in ("random", "table")
        for mount in ("eye_in_hand", "eye_to_hand")
        for outliers in (0, 3)
    ]
    settings += [
        replace(settings[0], scale=0.37),
        replace(settings[2], scale=0.37, outliers=3),
    ]
    if thorough:
        some = [settings[0], settings[3], settings[5], settings[6]]
        settings += [replace(s, noisy="both") for s in some]
        settings += [
            replace(s, noisy=who, at="far") for s in some for who in ("camera", "robot")
        ]
    rows = []
    for setting in tqdm(settings, unit="setting"):
        row = {
            "mount": setting.mount,
            "path": setting.path,
            "noise": f"{setting.noisy}, {setting.at}",
            "outliers": setting.outliers,
            "scale": "unknown" if setting.scale else "known",
            **trials(setting, count),
        }
        rows.append(row)
    save(out, rows, {"trials": count, "poses": settings[0].poses})
