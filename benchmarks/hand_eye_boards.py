"""Hand-eye calibration from simulated images of a board, through a lens found from the same images.

A camera with radial and tangential distortion views a chessboard; its corners have Gaussian or
heavy-tailed noise, the arm has noise of its own. Every solver gets the same corners: the lens is
calibrated from them first, as most people do.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.hand_eye import pose
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.calibration import Mount
from evercal.geometry import SE3, Camera

Array = NDArray[np.float64]
LENS = (-0.26, 0.11, 0.0004, -0.0003, -0.03)
"""Distortion k1 k2 p1 p2 k3 of the true lens: 20 pixels in the corners of the image."""


@dataclass(frozen=True)
class BoardSetting:
    """Options of a simulated recording."""

    mount: Mount = "eye_in_hand"
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
    grid = np.stack(np.meshgrid(np.arange(setting.columns), np.arange(setting.rows)), -1)
    return np.pad(size * grid.reshape(-1, 2).astype(float), ((0, 0), (0, 1)))


def project(points: Array, camera_from_board: SE3, camera: Camera) -> Array:
    """Return pixels (k, 2)."""
    import cv2

    rotvec = Rotation.from_quat(camera_from_board.rotation_wxyz, scalar_first=True).as_rotvec()
    lens = np.array(camera.distortion) if camera.distortion else None
    args = (rotvec, camera_from_board.translation_m, camera.matrix(), lens)
    return cv2.projectPoints(points, *args)[0].reshape(-1, 2)


def record(setting: BoardSetting, seed: int) -> BoardRecording:
    """Draw one recording."""
    rng = np.random.default_rng(seed)
    focal = rng.uniform(560, 680)
    wobble = 1 + rng.uniform(-0.1, 0.1)
    lens = tuple(wobble * k for k in LENS)
    camera = Camera(640, 480, focal, focal * rng.uniform(0.998, 1.002), *rng.normal(0, 8, 2)
                    + np.array([319.5, 239.5]), lens)  # fmt: skip
    on_arm = setting.mount == "eye_in_hand"
    near = pose(Rotation.random(rng=rng), rng.uniform(-0.12, 0.12, 3))
    if on_arm:
        far = pose(Rotation.from_rotvec(rng.normal(0, 0.3, 3)), np.array([0.5, 0.1, 0.02]))
        parent_from_camera, fixed_from_board = near, far
    else:
        look = Rotation.from_euler("x", np.pi / 2 + 0.6) * Rotation.from_rotvec(
            rng.normal(0, 0.2, 3)
        )
        parent_from_camera, fixed_from_board = pose(look, np.array([1.1, 0.2, 0.7])), near
    points = board_points(setting, stated=False)
    middle = points.mean(0)
    poses = []
    while len(poses) < setting.views:
        limit = np.deg2rad(setting.tilt_deg)
        axis = rng.normal(size=3) * (1, 1, 1.0)
        turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * rng.uniform(0, 1.5) * limit)
        distance = rng.uniform(0.3, 0.55)
        aim = np.array([*rng.uniform(-0.28, 0.28, 2) * distance, distance])
        trial = pose(turn, aim - turn.apply(middle))
        pixels = project(points, trial, camera)
        inside = (pixels > 8) & (pixels < np.array([632, 472]))
        if inside.all() and abs(turn.as_matrix()[2, 2]) > 0.35:
            poses.append(trial)
    camera_from_board = SE3.stack(poses)
    fixed_from_parent = (
        fixed_from_board @ camera_from_board.inverse() @ parent_from_camera.inverse()
    )
    robot = fixed_from_parent if on_arm else fixed_from_parent.inverse()

    def noise(*shape: int) -> Array:
        if setting.tails:
            return rng.standard_t(setting.tails, shape)
        return rng.normal(size=shape)

    views = tuple(
        BoardView(
            board_points(setting),
            project(points, p, camera) + setting.noise_px * noise(len(points), 2),
        )
        for p in camera_from_board
    )
    n = setting.views
    robot = pose(
        Rotation.from_quat(robot.rotation_wxyz, scalar_first=True)
        * Rotation.from_rotvec(np.deg2rad(setting.arm_deg) * noise(n, 3)),
        robot.translation_m + 1e-3 * setting.arm_mm * noise(n, 3),
    )
    spoiled = np.sort(rng.choice(n, setting.outliers, replace=False))
    quaternion, translation = robot.rotation_wxyz.copy(), robot.translation_m.copy()
    for i in spoiled:
        axis, direction = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        turned = Rotation.from_quat(quaternion[i], scalar_first=True) * Rotation.from_rotvec(
            np.deg2rad(20) * axis
        )
        quaternion[i] = turned.as_quat(scalar_first=True)
        translation[i] += 0.05 * direction
    return BoardRecording(
        setting, views, SE3(quaternion, translation), parent_from_camera, fixed_from_board,
        camera, camera_from_board, tuple(int(i) for i in spoiled),
    )  # fmt: skip
