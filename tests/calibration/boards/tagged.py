"""Simulated photographs of things that carry tags, with known corners."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from evercal.calibration.boards.tags import square
from evercal.geometry import SE3, Camera

CAMERA = Camera(640, 480, 620, 621, 322.3, 238.1)
Places = dict[int, tuple[SE3, float]]
"""Poses of tags on a thing, x right, y up, z out of the print, and their sides, by number."""
_CELL = 8
_FINER = 2


def placed(x: float, y: float, z: float = 0, turn: tuple = (0, 0, 0)) -> SE3:
    """A pose from metres and fixed angles about x, y, z in degrees."""
    rotation = Rotation.from_euler("xyz", turn, degrees=True)
    return SE3.of(rotation, np.array([x, y, z]))


PLATE: Places = {
    3: (placed(0, 0), 0.04),
    7: (placed(0.12, 0.01), 0.04),
    12: (placed(0.115, -0.09, 0, (0, 0, 90)), 0.05),
    20: (placed(0.01, -0.1, 0, (0, 0, 35)), 0.03),
}
"""A flat plate with tags of several sizes and angles."""
BOX: Places = {
    0: (placed(0, 0, 0.06), 0.05),
    1: (placed(0.06, 0, 0, (0, 90, 0)), 0.05),
    2: (placed(0, -0.06, 0, (90, 0, 0)), 0.05),
    3: (placed(-0.06, 0, 0, (0, -90, 0)), 0.05),
    4: (placed(0, 0.06, 0, (-90, 0, 0)), 0.05),
}
"""A cube with a tag on each of five sides."""


def photographed(
    places: Places,
    camera_from_thing: SE3,
    camera: Camera = CAMERA,
    seed: int = 0,
    dictionary: str = "APRILTAG_36h11",
) -> np.ndarray:
    """Return an image (h, w, 3) uint8 of the tags that face the camera."""
    large = np.full((camera.height * _FINER, camera.width * _FINER), 170, np.uint8)
    middle = (_FINER - 1) / 2
    finer = np.array([[_FINER, 0, middle], [0, _FINER, middle], [0, 0, 1]])
    code = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}"))
    cells = code.markerSize + 2
    for number, (pose, side) in places.items():
        own = camera_from_thing @ pose
        if own.rotation_matrix()[:, 2] @ own.translation_m > -0.02:
            continue
        tag = cv2.aruco.generateImageMarker(code, number % 1000, cells * _CELL)
        tag = np.pad(tag, _CELL, constant_values=255) // 255 * 210 + 20
        corners = camera.project(own.apply(square(side)))
        inside = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * cells * _CELL
        to_image = cv2.getPerspectiveTransform(
            (inside + _CELL - 0.5).astype(np.float32), corners.astype(np.float32)
        )
        size = large.shape[::-1]
        drawn = cv2.warpPerspective(tag, finer @ to_image, size)
        mask = cv2.warpPerspective(np.full_like(tag, 255), finer @ to_image, size)
        large = np.where(mask > 127, drawn, large)
    size = camera.size
    small = cv2.resize(large, size, interpolation=cv2.INTER_AREA).astype(float)
    small = cv2.GaussianBlur(small, (0, 0), 0.6)
    small += np.random.default_rng(seed).normal(0, 2, small.shape)
    grey = np.clip(small, 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, 2)


def around(
    count: int,
    centre: np.ndarray,
    seed: int = 0,
    tilt: float = 40,
    distance: float = 0.4,
) -> list[SE3]:
    """Return camera_from_thing of a camera that looks at a thing from above, z up."""
    rng = np.random.default_rng(seed)
    poses = []
    for _ in range(count):
        angle = rng.uniform(0, 2 * np.pi)
        size = np.deg2rad(tilt) * rng.uniform(0.4, 1)
        axis = np.array([np.cos(angle), np.sin(angle), 0])
        rotation = Rotation.from_euler("z", rng.uniform(-180, 180), degrees=True)
        rotation = rotation * Rotation.from_rotvec(size * axis)
        rotation = rotation * Rotation.from_euler("x", 180, degrees=True)
        place = np.array([0, 0, distance]) + rng.uniform(-0.04, 0.04, 3)
        poses.append(SE3.of(rotation, place - rotation.apply(centre)))
    return poses
