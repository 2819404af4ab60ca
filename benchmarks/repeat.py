"""Wrist recordings before repeated texture: a chessboard on a curtain, drawn with exact poses."""

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from benchmarks.accuracy import pose_error, wrong
from benchmarks.rows import Row, save, show
from evercal.errors import InputError
from evercal.evaluation.metrics import CHI2_6
from evercal.geometry import SE3, Camera
from evercal.map import Map
from evercal.recordings import Frame, Recording

CAMERA = Camera(960, 600, 760.0, 760.0, 479.5, 299.5)
SQUARES = (28, 17)
SQUARE_M = 0.015
BEHIND_M = 0.25
NOISE_M = 2e-4
NOISE_DEG = 0.02
PIXELS_PER_M = 4000
FOLDS = 3
NOTHING: Row = {"mm": np.nan, "deg": np.nan, "squared_mahalanobis": np.nan}
"""Errors of a recording or an image that was refused."""


def run(
    out: Path = Path("runs/repeat"),
    seeds: int = 3,
    images: int = 30,
    curtain: float = 0.1,
) -> None:
    """Estimate gripper_from_camera before a chessboard, and locate images that were left out.

    Two thirds of each recording are learned and one third is located, in three folds. A wrong
    answer is located, more than 10 mm off, and more than five of its own standard deviations off.

    Args:
        out: Folder for stores and rows.
        seeds: Recordings.
        images: Images of a recording.
        curtain: Contrast of the curtain behind the board; 0 is a plain one.
    """
    out.mkdir(parents=True, exist_ok=True)
    mounts: list[Row] = []
    located: list[Row] = []
    for seed in tqdm(range(seeds), "recordings"):
        recording, truth = chessboard_recording(seed, images, curtain)
        for fold in range(FOLDS):
            store = out / f"{seed}-{fold}-{time.time_ns()}.evercal"
            mount, rows = _fold(recording, truth, fold, store)
            mounts.append({"seed": seed, "fold": fold, **mount})
            located += [{"seed": seed, "fold": fold, **row} for row in rows]
    save(out / "mounts.csv", mounts)
    save(out / "images.csv", located)
    show([summary(mounts, located)])


def summary(mounts: list[Row], located: list[Row]) -> Row:
    """Return one row for all recordings."""
    good = [row for row in located if np.isfinite(float(row["mm"]))]
    errors = np.array([float(row["mm"]) for row in good] or [np.inf])
    squares = np.array([float(row["squared_mahalanobis"]) for row in good] or [np.inf])
    found = [row for row in mounts if np.isfinite(float(row["mm"]))]
    return {
        "mounts": len(mounts),
        "refused": len(mounts) - len(found),
        "median mm": float(np.median([float(row["mm"]) for row in found] or [np.inf])),
        "in ellipsoid": sum(
            float(row["squared_mahalanobis"]) < CHI2_6 for row in found
        ),
        "images": len(located),
        "located": len(good),
        "median mm of images": float(np.median(errors)),
        "wrong": int(wrong(errors, squares).sum()),
        "images in ellipsoid": float((squares < CHI2_6).mean()),
    }


def _fold(
    recording: Recording, truth: SE3, fold: int, store: Path
) -> tuple[Row, list[Row]]:
    train = tuple(f for i, f in enumerate(recording.train) if i % FOLDS != fold)
    cell = Map.open(store)
    try:
        report = cell.learn(replace(recording, train=train), memory="30%")
    except InputError as error:
        return NOTHING | {"reason": str(error)[:80]}, []
    assert report.hand_eye is not None
    estimate = report.hand_eye.parent_from_camera
    rows = []
    for true, frame in zip(recording.test, recording.train, strict=True):
        if frame in train:
            continue
        answer = cell.localize(frame.read_image())
        pose = true.base_from_camera
        assert pose is not None
        row = NOTHING | {"status": answer.status}
        if answer.uncertain_pose is not None:
            row |= pose_error(answer.uncertain_pose, pose)
        rows.append(row)
    return pose_error(estimate, truth) | {
        "warnings": len(report.hand_eye.warnings)
    }, rows


def chessboard_recording(
    seed: int, images: int, curtain: float
) -> tuple[Recording, SE3]:
    """Return a recording of gripper poses, with its true camera poses as test, and the mount."""
    rng = np.random.default_rng(seed)
    board = _board(rng)
    back = _curtain(rng, curtain)
    mount = SE3(
        Rotation.random(rng=rng).as_quat(scalar_first=True), rng.uniform(-0.1, 0.1, 3)
    )
    base_from_board = SE3(
        Rotation.random(rng=rng).as_quat(scalar_first=True), np.zeros(3)
    )
    sigma = np.repeat([NOISE_M, np.deg2rad(NOISE_DEG)], 3)
    train = []
    test = []
    for i, board_from_camera in enumerate(_orbit(rng, images)):
        image = draw(board, back, board_from_camera)
        noisy = np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)
        pose = base_from_board @ board_from_camera
        gripper = pose @ mount.inverse() @ SE3.exp(rng.normal(0, sigma))
        frame = Frame(f"{i:03d}", noisy, CAMERA, None, gripper)
        train.append(frame)
        test.append(replace(frame, base_from_camera=pose, base_from_gripper=None))
    name = f"chessboard-{seed}"
    return Recording(name=name, train=tuple(train), test=tuple(test)), mount


def _orbit(rng: np.random.Generator, images: int) -> Iterator[SE3]:
    """Yield poses board_from_camera that look at points of the board from 0.45 to 0.7 m."""
    for _ in range(images):
        tilt = np.deg2rad(rng.uniform(5, 40))
        turn = rng.uniform(0, 2 * np.pi)
        away = np.array(
            [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)]
        )
        aim = np.array([*rng.uniform(-0.06, 0.06, 2), 0.0])
        position = aim + rng.uniform(0.45, 0.7) * away
        roll = np.deg2rad(rng.uniform(-30, 30))
        z = (aim - position) / np.linalg.norm(aim - position)
        x = np.cross([-np.sin(roll), np.cos(roll), 0], z)
        x /= np.linalg.norm(x)
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack([x, np.cross(z, x), z], 1)
        matrix[:3, 3] = position
        yield SE3.from_matrix(matrix)


def _board(rng: np.random.Generator) -> np.ndarray:
    side = round(SQUARE_M * PIXELS_PER_M)
    squares = np.add.outer(np.arange(SQUARES[1]), np.arange(SQUARES[0])) % 2
    texture = np.pad(np.kron(squares, np.ones((side, side))), side, constant_values=1)
    return (25 + 200 * texture + _smooth(rng, texture.shape, 40, 3)).astype(np.float32)


def _curtain(rng: np.random.Generator, contrast: float) -> np.ndarray:
    """Return the texture of a dark curtain of 4 m with folds every 60 mm, 1 mm a pixel."""
    folds = np.sin(2 * np.pi * np.arange(4000) / 60)[None].repeat(4000, 0)
    noise = _smooth(rng, (4000, 4000), 4, 1) + 2 * _smooth(rng, (4000, 4000), 25, 1)
    return (50 + 200 * contrast * (0.5 * folds + 0.3 * noise)).astype(np.float32)


def _smooth(
    rng: np.random.Generator, shape: tuple[int, ...], px: float, size: float
) -> np.ndarray:
    """Return noise with a correlation length of `px` and a standard deviation of `size`."""
    step = max(1, int(px / 3))
    small = tuple(-(-n // step) + 1 for n in shape)
    noise = cv2.GaussianBlur(
        rng.normal(size=small).astype(np.float32), (0, 0), px / step
    )
    noise = cv2.resize(
        noise, (small[1] * step, small[0] * step), interpolation=cv2.INTER_CUBIC
    )
    return size * (noise / noise.std())[: shape[0], : shape[1]]


def draw(board: np.ndarray, back: np.ndarray, board_from_camera: SE3) -> np.ndarray:
    """Return the image (600, 960, 3) of the board and the curtain behind it, four rays a pixel."""
    total = np.zeros((CAMERA.height, CAMERA.width))
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    for du, dv in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
        rays = CAMERA.unproject(np.stack([u + du, v + dv], -1).astype(float))
        rays = rays @ board_from_camera.rotation_matrix().T
        origin = board_from_camera.translation_m
        far = _texture(back, origin, rays, BEHIND_M, 1000.0)
        near = _texture(board, origin, rays, 0.0, PIXELS_PER_M)
        total += np.where(near < 0, far, near)
    return (total / 4)[..., None].repeat(3, -1)


def _texture(
    texture: np.ndarray, origin: np.ndarray, rays: np.ndarray, z_m: float, per_m: float
) -> np.ndarray:
    points = origin[:2] + rays[..., :2] * ((z_m - origin[2]) / rays[..., 2:])
    middle = (np.array(texture.shape[::-1]) - 1) / 2
    where = (points * per_m + middle).astype(np.float32)
    return cv2.remap(
        texture,
        where[..., 0],
        where[..., 1],
        cv2.INTER_LINEAR,
        None,
        cv2.BORDER_CONSTANT,
        [-1.0],
    )
