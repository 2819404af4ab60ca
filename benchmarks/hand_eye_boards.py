"""Hand-eye calibration from simulated images of a board, through a lens found from the same images.

A camera with radial and tangential distortion views a chessboard; its corners have Gaussian or
heavy-tailed noise, the arm has noise of its own. Every solver gets the same corners: the lens is
calibrated from them first, as most people do.
"""

import time
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from tqdm import tqdm
from tyro.conf import arg

from benchmarks.hand_eye import error, pose, rotations
from benchmarks.rows import Row, once, save
from evercal.calibration.boards.corners import BoardView, board_pose, lens_vector
from evercal.calibration.boards.intrinsics import calibrate_camera, moved_camera
from evercal.calibration.pose_pairs.pairs import BoardCorners, PosePairs
from evercal.calibration.pose_pairs.solve import solve, solve_pairs
from evercal.errors import InputError
from evercal.evaluation.metrics import share_inside
from evercal.geometry import SE3, Camera, pose_distance
from evercal.robot.mount import MountName

Array = NDArray[Any]
LENS = (-0.26, 0.11, 0.0004, -0.0003, -0.03)
"""Distortion k1 k2 p1 p2 k3 of the true lens: 20 pixels in the corners of the image."""


@dataclass(frozen=True)
class BoardSetting:
    """Options of a simulated recording."""

    mount: MountName = "eye_in_hand"
    """Mount of the camera."""
    views: int = 20
    """Number of images."""
    tilt_deg: float = 35.0
    """Largest tilt of the board; the camera rolls as far."""
    noise_px: float = 0.1
    """Standard deviation of a corner coordinate."""
    tails: float = 0.0
    """Degrees of freedom of a Student t distribution of all noise; 0 for Gaussian noise."""
    arm_mm: float = 0.05
    """Standard deviation of the arm's position per axis."""
    arm_deg: float = 0.01
    """Standard deviation of the arm's rotation per axis."""
    outliers: int = 0
    """Images whose arm pose is off by 5 cm and 20 deg."""
    square_error: float = 0.0
    """Relative error of the stated size of a square: 0.01 for a stated size 1 % too large."""
    depth_noise: float = 0.0
    """Relative standard deviation of the depth of each board pose (poses only)."""
    depth_error: float = 0.0
    """Relative error of all depths (poses only)."""
    columns: int = 9
    rows: int = 6
    square_m: float = 0.025
    bend_mm: float = 0.0
    """Departure of the board from a plane at 150 mm from its middle, where it bends most."""
    dents_mm: float = 0.0
    """Height of two dented corners of the board; a dent is 60 mm long."""

    @property
    def size(self) -> float:
        """Size in that of a board of 9x6 corners and 25 mm; distances grow with it."""
        return self.square_m * max((self.columns - 1) / 0.2, (self.rows - 1) / 0.125)


@dataclass(frozen=True, eq=False)
class BoardRecording:
    """A simulated recording and its truth."""

    setting: BoardSetting
    views: tuple[BoardView, ...]
    base_from_gripper: SE3
    parent_from_camera: SE3
    fixed_from_board: SE3
    camera: Camera
    camera_from_board: SE3
    spoiled: tuple[int, ...] = field(default=())


def board_points(setting: BoardSetting, stated: bool = True) -> Array:
    """Return corners (k, 3) with the stated or the true size of a square."""
    size = setting.square_m * (1 + setting.square_error if stated else 1)
    x, y = np.meshgrid(
        np.arange(float(setting.columns)), np.arange(float(setting.rows))
    )
    return size * np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)


def project(points: Array, camera_from_board: SE3, camera: Camera) -> Array:
    """Return pixels (k, 2)."""
    import cv2

    rotvec = Rotation.from_quat(
        camera_from_board.rotation_wxyz, scalar_first=True
    ).as_rotvec()
    lens = np.array(camera.distortion) if camera.distortion else None
    args = (rotvec, camera_from_board.translation_m, camera.matrix(), lens)
    return cv2.projectPoints(points, *args)[0].reshape(-1, 2)


def record(setting: BoardSetting, seed: int, session: int = 0) -> BoardRecording:
    """Draw one recording; other sessions share the camera, its place and the board."""
    rng = np.random.default_rng(seed)
    camera = _camera(rng)
    parent_from_camera, fixed_from_board = _places(setting, rng)
    true = board_points(setting, stated=False)
    stated = board_points(setting)
    if setting.bend_mm or setting.dents_mm:
        true = _bent(true, setting, rng)
    if session:
        rng = np.random.default_rng([seed, session])
        fixed_from_board = _places(setting, rng)[1]
    camera_from_board = _board_poses(setting, camera, rng)
    fixed_from_parent = (
        fixed_from_board @ camera_from_board.inverse() @ parent_from_camera.inverse()
    )
    robot = (
        fixed_from_parent
        if setting.mount == "eye_in_hand"
        else fixed_from_parent.inverse()
    )

    def noise(*shape: int) -> Array:
        if setting.tails:
            return rng.standard_t(setting.tails, shape)
        return rng.normal(size=shape)

    views = tuple(
        BoardView(
            stated, project(true, p, camera) + setting.noise_px * noise(len(true), 2)
        )
        for p in camera_from_board
    )
    n = setting.views
    turned = rotations(robot) * Rotation.from_rotvec(
        np.deg2rad(setting.arm_deg) * noise(n, 3)
    )
    robot = pose(turned, robot.translation_m + 1e-3 * setting.arm_mm * noise(n, 3))
    spoiled = np.sort(rng.choice(n, setting.outliers, replace=False))
    quaternion = robot.rotation_wxyz.copy()
    translation = robot.translation_m.copy()
    for i in spoiled:
        axis, direction = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        other = rotations(robot[i]) * Rotation.from_rotvec(np.deg2rad(20) * axis)
        quaternion[i] = other.as_quat(scalar_first=True)
        translation[i] += 0.05 * direction
    return BoardRecording(
        setting=setting,
        views=views,
        base_from_gripper=SE3(quaternion, translation),
        parent_from_camera=parent_from_camera,
        fixed_from_board=fixed_from_board,
        camera=camera,
        camera_from_board=camera_from_board,
        spoiled=tuple(int(i) for i in spoiled),
    )


def _camera(rng: np.random.Generator) -> Camera:
    focal = rng.uniform(560, 680)
    wobble = 1 + rng.uniform(-0.1, 0.1)
    ratio, (dx, dy) = rng.uniform(0.998, 1.002), rng.normal(0, 8, 2)
    lens = tuple(wobble * k for k in LENS)
    return Camera(640, 480, focal, focal * ratio, 319.5 + dx, 239.5 + dy, lens)


def _bent(points: Array, setting: BoardSetting, rng: np.random.Generator) -> Array:
    """Bend a board in any direction, and across it by up to half as much; dent two corners."""
    turn = points.max(0) / 2
    angle = rng.uniform(0, np.pi)
    axes = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    curved = (((points - turn)[:, :2] @ axes) / 0.15) ** 2 @ [1, rng.uniform(-0.5, 0.5)]
    height = setting.bend_mm * rng.choice([-1, 1]) * curved
    for corner in rng.choice(4, 2, replace=False):
        place = points.max(0) * (corner % 2, corner // 2, 0)
        near = np.clip(1 - np.linalg.norm(points - place, axis=1) / 0.06, 0, None)
        height += setting.dents_mm * rng.choice([-1, 1]) * near
    return points + 1e-3 * np.outer(height, [0, 0, 1])


def _places(setting: BoardSetting, rng: np.random.Generator) -> tuple[SE3, SE3]:
    near = pose(Rotation.random(rng=rng), rng.uniform(-0.12, 0.12, 3))
    if setting.mount == "eye_in_hand":
        return near, pose(
            Rotation.from_rotvec(rng.normal(0, 0.3, 3)), np.array([0.5, 0.1, 0.02])
        )
    look = Rotation.from_euler("x", np.pi / 2 + 0.6) * Rotation.from_rotvec(
        rng.normal(0, 0.2, 3)
    )
    return pose(look, max(1.0, setting.size / 3) * np.array([1.1, 0.2, 0.7])), near


def _board_poses(
    setting: BoardSetting, camera: Camera, rng: np.random.Generator
) -> SE3:
    """Return (n,) camera_from_board that show the whole board."""
    points = board_points(setting, stated=False)
    poses = []
    while len(poses) < setting.views:
        axis = rng.normal(size=3)
        angle = rng.uniform(0, 1.5) * np.deg2rad(setting.tilt_deg)
        turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle)
        distance = setting.size * rng.uniform(0.3, 0.55)
        aim = np.array([*rng.uniform(-0.28, 0.28, 2) * distance, distance])
        trial = pose(turn, aim - turn.apply(points.mean(0)))
        pixels = project(points, trial, camera)
        inside = (pixels > 8) & (pixels < np.array([632, 472]))
        if inside.all() and abs(turn.as_matrix()[2, 2]) > 0.35:
            poses.append(trial)
    return SE3.stack(poses)


def pose_pairs(recording: BoardRecording, seed: int) -> PosePairs:
    """Return pairs of poses without corners: lateral, depth and rotation noise of each image."""
    setting = recording.setting
    rng = np.random.default_rng(10000 + seed)
    n = len(recording.views)
    board = recording.camera_from_board
    noise = (
        rng.standard_t(setting.tails, (n, 7))
        if setting.tails
        else rng.normal(size=(n, 7))
    )
    moved = board.translation_m + 3e-4 * noise[:, :3]
    moved = moved * (1 + max(setting.depth_noise, 0.003) * noise[:, 3:4])
    moved[:, 2] *= 1 + setting.depth_error
    turned = rotations(board) * Rotation.from_rotvec(np.deg2rad(0.15) * noise[:, 4:])
    names = tuple(f"row {i + 1}" for i in range(n))
    scale = 1 + setting.square_error
    return PosePairs(names, recording.base_from_gripper, pose(turned, scale * moved))


def corner_pairs(recording: BoardRecording) -> tuple[PosePairs, BoardCorners]:
    """Return pairs with corners, the lens calibrated from the same corners."""
    camera = calibrate_camera(recording.views, 640, 480).camera
    board = [board_pose(view, camera).camera_from_board for view in recording.views]
    names = tuple(f"{i}.png" for i in range(len(board)))
    pairs = PosePairs(names, recording.base_from_gripper, SE3.stack(board))
    size = recording.setting.square_m * (1 + recording.setting.square_error)
    return pairs, BoardCorners(camera, recording.views, size_m=size)


def opencv_solvers(pairs: PosePairs, mount: MountName) -> dict[str, SE3]:
    """Return parent_from_camera by each solver of OpenCV; empty where OpenCV has none (5.0)."""
    import cv2

    found: dict[str, SE3] = {}
    robot = (
        pairs.base_from_gripper
        if mount == "eye_in_hand"
        else pairs.base_from_gripper.inverse()
    )
    arrays = [list(part) for p in (robot, pairs.camera_from_board)
              for part in (p.rotation_matrix(), p.translation_m)]  # fmt: skip
    solve_hand_eye = getattr(cv2, "calibrateHandEye", None)
    if solve_hand_eye is None:
        return found
    for name in ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS"):
        rotation, shift = solve_hand_eye(
            *arrays, method=getattr(cv2, f"CALIB_HAND_EYE_{name}")
        )
        if np.isfinite(rotation).all() and abs(np.linalg.det(rotation) - 1) < 1e-3:
            found[name.title()] = pose(Rotation.from_matrix(rotation), np.ravel(shift))
    return found


def reprojection(
    recording: BoardRecording, pairs: PosePairs, corners: BoardCorners, start: SE3
) -> SE3:
    """Return parent_from_camera that minimizes all reprojection errors over X, Z and the lens.

    The arm is taken for exact, as in textbook bundle adjustment; soft L1 loss.
    """
    robot = recording.base_from_gripper
    robot = robot if recording.setting.mount == "eye_in_hand" else robot.inverse()
    board = (robot @ start @ pairs.camera_from_board)[0]
    points = recording.views[0].points_m
    pixels = np.stack([v.pixels for v in recording.views])
    lens = lens_vector(corners.camera)
    scale = np.maximum(np.abs(lens), 0.1)

    def residual(step: Array) -> Array:
        x = start @ SE3.exp(step[:6])
        z = board @ SE3.exp(step[6:12])
        camera = moved_camera(corners.camera, step[12:] * scale)
        seen = (robot @ x).inverse() @ z
        return (np.stack([project(points, p, camera) for p in seen]) - pixels).ravel()

    step = least_squares(
        residual, np.zeros(12 + len(lens)), loss="soft_l1", f_scale=0.3
    ).x
    return start @ SE3.exp(step[:6])


CORNER = BoardSetting()
POSES = BoardSetting(views=25)
CONDITIONS: dict[str, tuple[BoardSetting, bool]] = {
    "corners, clean": (CORNER, True),
    "corners, fixed camera": (replace(CORNER, mount="eye_to_hand"), True),
    "corners, 3 outliers": (replace(CORNER, outliers=3), True),
    "corners, 6 views": (replace(CORNER, views=6), True),
    "corners, 10 deg": (replace(CORNER, tilt_deg=10), True),
    "corners, heavy tails": (replace(CORNER, tails=3.0), True),
    "corners, arm 0.5 mm 0.1 deg": (replace(CORNER, arm_mm=0.5, arm_deg=0.1), True),
    "corners, square 1 % wrong": (replace(CORNER, square_error=0.01), True),
    "corners, square 5 % wrong": (replace(CORNER, square_error=0.05), True),
    "poses, clean": (POSES, False),
    "poses, fixed camera": (replace(POSES, mount="eye_to_hand"), False),
    "poses, 3 outliers": (replace(POSES, outliers=3), False),
    "poses, 6 views": (replace(POSES, views=6), False),
    "poses, 10 deg": (replace(POSES, tilt_deg=10), False),
    "poses, heavy tails": (replace(POSES, tails=3.0), False),
    "poses, depth noise 2 %": (replace(POSES, depth_noise=0.02), False),
    "poses, shared depth 0.3 %": (replace(POSES, depth_error=0.003), False),
    "poses, arm 0.5 mm 0.3 deg": (replace(POSES, arm_mm=0.5, arm_deg=0.3), False),
}
"""Setting and whether corners are given."""
BENT = BoardSetting(columns=11, rows=8, square_m=0.03, arm_mm=0.1, arm_deg=0.02)
SESSIONS = {
    f"two sessions, bend {bend:g} mm, dents {dents:g} mm": replace(
        BENT, bend_mm=bend, dents_mm=dents
    )
    for bend, dents in (
        (0, 0),
        (0.5, 0),
        (1, 0),
        (3, 0),
        (0, 0.5),
        (0, 1),
        (1, 1),
        (3, 3),
    )
}
"""Settings of two sessions of one camera before one board."""


def measure_sessions(name: str, count: int) -> Row:
    """Solve two sessions of one camera; compare their answers, and their intrinsics."""
    answers = []
    lenses = []
    squared = []
    mm = []
    refused = 0
    for seed in range(count):
        setting = replace(
            SESSIONS[name], mount=("eye_in_hand", "eye_to_hand")[seed % 2]
        )
        drawn = [record(setting, seed, session) for session in range(2)]
        try:
            fits = [
                solve_pairs(p, setting.mount, corners=c)
                for p, c in map(corner_pairs, drawn)
            ]
        except InputError:
            refused += 1
            continue
        both = [fit.calibration() for fit in fits]
        truth = drawn[0].parent_from_camera
        squared += [b.uncertain_pose.squared_mahalanobis(truth) for b in both]
        mm += [1000 * float(pose_distance(b.parent_from_child, truth)[0]) for b in both]
        step = error(both[0].parent_from_child, both[1].parent_from_child)
        answers.append(
            step @ np.linalg.solve(both[0].covariance + both[1].covariance, step)
        )
        change = np.diff(
            [lens_vector(fit.camera) for fit in fits if fit.camera], axis=0
        )[0]
        own = slice(12, 12 + len(change))
        spread = sum(f.fit.factor * f.fit.covariance[own, own] for f in fits)
        lenses.append(change @ np.linalg.solve(spread, change))
    row: Row = {"condition": name, "trials": count, "refused": refused}
    row |= {"median_mm": float(np.median(mm)), "p95_mm": float(np.quantile(mm, 0.95))}
    row |= {"inside_95": share_inside(squared), "truth_d2": float(np.mean(squared))}
    return row | {
        "answers_d2": float(np.mean(answers)),
        "lens_d2": float(np.mean(lenses)),
    }


def measure(name: str, count: int, references: int) -> Row:
    """Solve many recordings of one condition; the first `references` also by other solvers."""
    setting, with_corners = CONDITIONS[name]
    squared = []
    flagged = []
    ms = []
    refused = 0
    mm: dict[str, list[float]] = {"evercal": []}
    for seed in range(count):
        drawn = record(setting, seed)
        pairs, corners = (
            corner_pairs(drawn) if with_corners else (pose_pairs(drawn, seed), None)
        )
        began = time.process_time()
        try:
            result = solve(pairs, setting.mount, corners=corners)
        except InputError:
            refused += 1
            continue
        ms.append(1000 * (time.process_time() - began))
        truth = drawn.parent_from_camera
        squared.append(result.uncertain_pose.squared_mahalanobis(truth))
        flagged.append(any("than stated" in text for text in result.checks["warnings"]))
        estimates = {"evercal": result.parent_from_child}
        if seed < references:
            others = opencv_solvers(pairs, setting.mount)
            estimates |= others
            if corners is not None:
                start = result.parent_from_child
                estimates["reprojection"] = reprojection(drawn, pairs, corners, start)
        for solver, estimate in estimates.items():
            mm.setdefault(solver, []).append(
                1000 * float(pose_distance(estimate, truth)[0])
            )
    row: Row = {"condition": name, "trials": count, "refused": refused}
    row |= {
        "median_mm": float(np.median(mm["evercal"])),
        "p95_mm": float(np.quantile(mm["evercal"], 0.95)),
    }
    row |= {
        "inside_95": share_inside(squared),
        "size_flagged": 100 * float(np.mean(flagged)),
    }
    row |= {"ms": float(np.median(ms))}
    rest = {
        name: float(np.median(values))
        for name, values in mm.items()
        if name != "evercal"
    }
    return row | {f"{name}_mm": value for name, value in rest.items()}


def run(
    count: Annotated[int, arg(name="trials")] = 300,
    references: int = 30,
    out: Path = Path("runs/handeye-boards.csv"),
) -> None:
    """Simulated boards through a distorted lens that is found from the same images.

    Rows of two sessions have squared Mahalanobis distances in the mean: of the truth and of the
    other answer (6 expected), and of the other session's intrinsics (9 expected).

    Args:
        count: Trials of each condition.
        references: Trials that are also solved by OpenCV's solvers (OpenCV 4) and by a full
            reprojection fit; their medians are over these trials.
        out: File of the rows.
    """
    rows: list[Row] = []
    for name in tqdm([*CONDITIONS, *SESSIONS], unit="condition"):
        again = partial(measure_sessions, name, count)
        draw = again if name in SESSIONS else partial(measure, name, count, references)
        rows.append(once(out.with_suffix("") / f"{name}.json", draw))
    save(out, rows, {"trials": count})
