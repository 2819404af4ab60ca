"""Hand-eye solving on simulated poses: errors, the 95 % ellipsoid, outliers, scale, time."""

import time
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from tabulate import tabulate
from tqdm import tqdm

from evercal.calibration.calibration import Mount
from evercal.calibration.pose_pairs.closed_form import motions, park, shah
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.solve import solve
from evercal.evaluation.metrics import share_inside
from evercal.geometry import SE3, pose_distance, squared_mahalanobis


@dataclass(frozen=True)
class Setting:
    """How pose pairs are simulated."""

    mount: Mount = "eye_in_hand"
    """Where the camera is."""
    poses: int = 25
    """Pairs."""
    path: str = "random"
    """`random`: any rotation within a metre; `table`: views of a table, tilted by 30 deg or so."""
    noisy: str = "camera"
    """Whose poses have noise: `camera`, `robot` or `both`."""
    at: str = "own"
    """Where rotations turn: `own`, about the board's or the gripper's origin; `far`, about the
    camera's or the base's, which also shifts the pose."""
    noise_mm: float = 2.0
    """Standard deviation per axis."""
    noise_deg: float = 0.2
    """The same of rotation."""
    outliers: int = 0
    """Pairs whose camera pose is off by 5 cm and 20 deg."""
    scale: float | None = None
    """Metres per unit of the camera's lengths; None for metres."""


@dataclass(frozen=True, eq=False)
class SimulatedPairs:
    """Simulated pairs and what is true."""

    pairs: PosePairs
    parent_from_camera: SE3
    """Single."""
    fixed_from_board: SE3
    """Single."""
    spoiled: tuple[int, ...]
    """Outliers."""


def recording(setting: Setting, seed: int) -> SimulatedPairs:
    """Draws one recording."""
    rng, n = np.random.default_rng(seed), setting.poses
    on_arm = setting.mount == "eye_in_hand"
    if setting.path == "table":
        turn = Rotation.from_rotvec(rng.normal(0, 0.5, (n, 3))) * Rotation.from_euler("x", np.pi)
        place = np.array([0.5, 0.0, 0.5]) + rng.uniform(-1, 1, (n, 3)) * (0.2, 0.2, 0.12)
    else:
        turn, place = Rotation.random(n, rng=rng), rng.uniform(-0.5, 0.5, (n, 3))
    robot = pose(turn, place)
    near, far = rng.normal(0, 0.07, 3), rng.normal(0, 0.4, 3)
    shifts = (near, far) if on_arm else (far, near)
    camera_in, board_in = (pose(Rotation.random(rng=rng), shift) for shift in shifts)
    fixed_from_parent = robot if on_arm else robot.inverse()
    seen = camera_in.inverse() @ fixed_from_parent.inverse() @ board_in
    if setting.noisy in ("robot", "both"):
        robot = shaken(robot, setting, rng)
    if setting.noisy in ("camera", "both"):
        seen = shaken(seen, setting, rng)
    spoiled = np.sort(rng.choice(n, setting.outliers, replace=False))
    rotation, translation = seen.rotation_wxyz.copy(), seen.translation_m.copy()
    for i in spoiled:
        axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        off = rotations(seen[i]) * Rotation.from_rotvec(np.deg2rad(20) * axis)
        rotation[i], translation[i] = off.as_quat(scalar_first=True), translation[i] + 0.05 * way
    seen = SE3(rotation, translation / (setting.scale or 1.0))
    pairs = PosePairs(tuple(f"row {i + 1}" for i in range(n)), robot, seen)
    return SimulatedPairs(pairs, camera_in, board_in, tuple(int(i) for i in spoiled))


def pose(rotation: Rotation, translation: np.ndarray) -> SE3:
    """From a rotation and a translation of one shape."""
    return SE3(rotation.as_quat(scalar_first=True), translation)


def rotations(poses: SE3) -> Rotation:
    """Of poses."""
    return Rotation.from_quat(poses.rotation_wxyz, scalar_first=True)


def shaken(poses: SE3, setting: Setting, rng: np.random.Generator) -> SE3:
    """Poses with noise."""
    n = len(poses)
    turn = Rotation.from_rotvec(rng.normal(0, np.deg2rad(setting.noise_deg), (n, 3)))
    shift = rng.normal(0, setting.noise_mm / 1000, (n, 3))
    if setting.at == "far":
        return pose(turn, shift) @ poses
    return pose(rotations(poses) * turn, poses.translation_m + shift)


def error(found: SE3, truth: SE3) -> np.ndarray:
    """(6,) translation in the parent's axes and rotation about the child's, as a covariance is."""
    turn = rotations(truth).inv() * rotations(found)
    return np.concatenate([found.translation_m - truth.translation_m, turn.as_rotvec()])


def trials(setting: Setting, count: int, first_seed: int = 0) -> dict[str, float]:
    """What many recordings of one setting give."""
    mm, deg, squared, named, ms, scale = [], [], [], [], [], []
    for seed in range(first_seed, first_seed + count):
        drawn = recording(setting, seed)
        began = time.process_time()
        found = solve(drawn.pairs, setting.mount, setting.scale is None)
        ms.append(1000 * (time.process_time() - began))
        off = error(found.parent_from_child, drawn.parent_from_camera)
        mm.append(1000 * np.linalg.norm(off[:3]))
        deg.append(np.rad2deg(np.linalg.norm(off[3:])))
        squared.append(
            squared_mahalanobis(found.parent_from_child, found.covariance, drawn.parent_from_camera)
        )
        left_out = tuple(i for i, image in enumerate(found.images) if not image.used)
        named.append(left_out == drawn.spoiled)
        if setting.scale is not None:
            scale.append(100 * abs(found.checks["scale"] / setting.scale - 1))
    return {
        "median mm": float(np.median(mm)),
        "median deg": float(np.median(deg)),
        "largest mm": float(max(mm)),
        "inside 95 %": share_inside(squared),
        "outliers exactly": 100 * float(np.mean(named)),
        "scale off %": float(max(scale)) if scale else float("nan"),
        "median ms": float(np.median(ms)),
        "slowest ms": float(max(ms)),
    }


def closed_forms(setting: Setting, count: int) -> dict[str, tuple[float, float]]:
    """Median errors (mm, deg) of the classical methods alone, without any robustness."""
    errors: dict[str, list[tuple[float, float]]] = {"Park": [], "Shah": []}
    for seed in range(count):
        drawn = recording(setting, seed)
        robot = drawn.pairs.base_from_gripper
        fixed_from_parent = robot if setting.mount == "eye_in_hand" else robot.inverse()
        a, b = motions(fixed_from_parent, drawn.pairs.camera_from_board)
        found = {
            "Park": park(a, b)[0],
            "Shah": shah(fixed_from_parent, drawn.pairs.camera_from_board).parent_from_camera,
        }
        for name, answer in found.items():
            metres, radians = pose_distance(answer, drawn.parent_from_camera)
            errors[name].append((1000 * float(metres), float(np.rad2deg(radians))))
    return {name: tuple(np.median(rows, 0).tolist()) for name, rows in errors.items()}


def run(count: int, thorough: bool) -> None:
    """Prints a table of settings."""
    settings = [
        Setting(mount=mount, path=path, outliers=outliers)
        for path in ("random", "table")
        for mount in ("eye_in_hand", "eye_to_hand")
        for outliers in (0, 3)
    ]
    settings += [replace(settings[0], scale=0.37), replace(settings[2], scale=0.37, outliers=3)]
    if thorough:
        some = [settings[0], settings[3], settings[5], settings[6]]
        settings += [replace(s, noisy="both") for s in some]
        settings += [replace(s, noisy=who, at="far") for s in some for who in ("camera", "robot")]
    rows = []
    for setting in tqdm(settings, unit="setting"):
        classical = closed_forms(setting, min(count, 200)) if setting.scale is None else {}
        row = {
            "mount": setting.mount,
            "path": setting.path,
            "noise": f"{setting.noisy}, {setting.at}",
            "outliers": setting.outliers,
            "scale": "unknown" if setting.scale else "known",
            **trials(setting, count),
        }
        row |= {f"{name} mm": mm for name, (mm, _) in classical.items()}
        rows.append(row)
    print(f"{count} trials each, {settings[0].poses} poses, 2 mm and 0.2 deg per axis")
    print(tabulate(rows, headers="keys", floatfmt=".3g", tablefmt="github", missingval=""))
