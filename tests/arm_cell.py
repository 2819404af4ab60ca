"""A small cell with an arm of boxes: a recording of a fixed camera, drawn without a renderer."""

import json
from pathlib import Path

import cv2
import numpy as np

from evercal.calibration.arm_in_view.rasterizer import Rasterizer
from evercal.geometry import SE3, Camera
from evercal.robot.link_shapes import RobotBody, robot_body
from evercal.robot.robot_model import RobotModel
from evercal.simulation.box_room import look_at

NAMES = ("turn", "shoulder", "elbow", "wrist")
CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
BASE_FROM_CAMERA = look_at(np.array([1.0, 0.7, 0.8]), np.array([0.0, 0.0, 0.35]))
_SIZES_M = {
    "foot": (0.2, 0.2, 0.1),
    "turret": (0.12, 0.12, 0.12),
    "upper": (0.08, 0.1, 0.32),
    "fore": (0.07, 0.06, 0.3),
    "hand": (0.12, 0.04, 0.08),
}
_ZOOM = 4
"""Pixels of a drawing for one of an image, along each side."""


def urdf() -> str:
    """An arm of five boxes and four joints; each joint is at the end of the box below."""
    text = '<robot name="boxes">'
    for name, size in _SIZES_M.items():
        height = size[2] / 2
        words = " ".join(map(str, size))
        text += (
            f'<link name="{name}"><visual><origin xyz="0 0 {height}"/><geometry>'
            f'<box size="{words}"/></geometry></visual></link>'
        )
    links = list(_SIZES_M)
    axes = ("0 0 1", "0 1 0", "0 1 0", "1 0 0")
    for name, parent, child, axis in zip(NAMES, links, links[1:], axes, strict=False):
        text += (
            f'<joint name="{name}" type="revolute"><parent link="{parent}"/>'
            f'<child link="{child}"/><origin xyz="0 0 {_SIZES_M[parent][2]}"/>'
            f'<axis xyz="{axis}"/><limit lower="-3" upper="3"/></joint>'
        )
    return text + "</robot>"


def joint_values(count: int, seed: int = 0) -> np.ndarray:
    """(count, 4) radians."""
    rng = np.random.default_rng(seed)
    return rng.uniform((-1.5, -0.9, -1.6, -1.2), (1.5, 0.9, 1.6, 1.2), (count, 4))


def images(body: RobotBody, values: np.ndarray, seed: int = 0) -> list[np.ndarray]:
    """Images of the arm before a still background: four drawn pixels a side, and noise."""
    rng = np.random.default_rng(seed)
    large = CAMERA.resized(_ZOOM * CAMERA.width, _ZOOM * CAMERA.height)
    background = rng.uniform(20, 110, (30, 40, 3))
    size = large.width, large.height
    background = cv2.resize(background, size, interpolation=cv2.INTER_CUBIC)
    colours = rng.uniform(150, 250, (len(body.links) + 1, 3))
    rasterizer = Rasterizer(body.links)
    pose = BASE_FROM_CAMERA.inverse().matrix()
    shots = []
    for frames in body.frames(values).swapaxes(0, 1):
        links = rasterizer.draw(pose @ frames, large)
        picture = np.where(links[..., None] >= 0, colours[links], background)
        small = cv2.resize(
            picture, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA
        )
        noisy = small + rng.normal(0, 1.5, small.shape)
        shots.append(np.clip(noisy, 0, 255).astype(np.uint8))
    return shots


def seen_by(camera: Camera, image: np.ndarray) -> np.ndarray:
    """An image of `CAMERA` as a camera with distortion takes it."""
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = camera.unproject(np.stack([x, y], -1).astype(float))
    pixels = CAMERA.project(rays).astype(np.float32)
    return cv2.remap(image, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR)


def write(folder: Path, count: int = 10, seed: int = 0, camera: Camera = CAMERA) -> SE3:
    """Write a recording, and return base_from_camera."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "robot.urdf").write_text(urdf())
    values = joint_values(count, seed)
    body = robot_body(RobotModel(folder / "robot.urdf"), NAMES)
    rows = ["image," + ",".join(NAMES)]
    for i, image in enumerate(images(body, values, seed)):
        taken = image if camera == CAMERA else seen_by(camera, image)
        cv2.imwrite(str(folder / f"{i:03d}.png"), taken)
        rows.append(f"{i:03d}.png," + ",".join(f"{value:.9f}" for value in values[i]))
    (folder / "joints.csv").write_text("\n".join(rows) + "\n")
    (folder / "camera.json").write_text(json.dumps(camera.to_dict()))
    return BASE_FROM_CAMERA
