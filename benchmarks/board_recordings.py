"""Simulated recordings of a board by a camera with distortion, beside a robot with noise."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.hand_eye import pose, rotations, with_outliers
from evercal.calibration.boards.corners import BoardView, board_pose
from evercal.calibration.boards.intrinsics import calibrate_camera
from evercal.calibration.pose_pairs.pairs import BoardCorners, PosePairs
from evercal.geometry import SE3, Camera
from evercal.robot.mount import MountName
from evercal.typing import Array

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
    stretch: float = 0.0
    """Relative length by which the print is stretched along its columns."""
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

    rotvec = camera_from_board.rotation.as_rotvec()
    shift = camera_from_board.translation_m
    distortion = np.array(camera.distortion)
    pixels, _ = cv2.projectPoints(points, rotvec, shift, camera.matrix(), distortion)
    return np.asarray(pixels.reshape(-1, 2), np.float64)


def record(setting: BoardSetting, seed: int, session: int = 0) -> BoardRecording:
    """Draw one recording; other sessions share the camera, its place and the board."""
    rng = np.random.default_rng(seed)
    camera = _camera(rng)
    parent_from_camera, fixed_from_board = _places(setting, rng)
    true = board_points(setting, stated=False)
    stated = board_points(setting)
    true[:, 1] *= 1 + setting.stretch
    if setting.bend_mm or setting.dents_mm:
        true = _bent(true, setting, rng)
    if session:
        rng = np.random.default_rng([seed, session])
        fixed_from_board = _places(setting, rng)[1]
    camera_from_board = _board_poses(setting, camera, rng)
    fixed_from_parent = (
        fixed_from_board @ camera_from_board.inverse() @ parent_from_camera.inverse()
    )
    robot = fixed_from_parent
    if setting.mount == "eye_to_hand":
        robot = robot.inverse()

    def noise(*shape: int) -> Array:
        if setting.tails:
            return rng.standard_t(setting.tails, shape)
        return rng.normal(size=shape)

    views = []
    for view in camera_from_board:
        error_px = setting.noise_px * noise(len(true), 2)
        views.append(BoardView(stated, project(true, view, camera) + error_px))
    n = setting.views
    turn = Rotation.from_rotvec(np.deg2rad(setting.arm_deg) * noise(n, 3))
    turned = rotations(robot) * turn
    robot = pose(turned, robot.translation_m + 1e-3 * setting.arm_mm * noise(n, 3))
    spoiled = np.sort(rng.choice(n, setting.outliers, replace=False))
    return BoardRecording(
        setting=setting,
        views=tuple(views),
        base_from_gripper=with_outliers(robot, spoiled, rng),
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
    if setting.tails:
        noise = rng.standard_t(setting.tails, (n, 7))
    else:
        noise = rng.normal(size=(n, 7))
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
