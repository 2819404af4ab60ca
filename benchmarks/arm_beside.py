"""The arm in view beside a box and a board in its gripper: the same cells, other images."""

import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from benchmarks import eye_to_hand
from benchmarks.arm_faults import Cell
from benchmarks.rows import Row
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from rooms.arms import packaged_urdf
from rooms.held import Setting, render
from rooms.things import SIZES_M

IMAGES = 15
"""Images of each recording."""
ARM = "arm in view"
_JOINT_NOISE_DEG = 0.02
"""Noise of each joint value; gripper poses have `eye_to_hand.ARM`."""
_METHODS = {
    "box": (eye_to_hand.HELD,),
    "board": (eye_to_hand.SOLVED, eye_to_hand.CLOSED),
}


def beside(data: Path, seed: int) -> Iterator[tuple[str, Row | Cell]]:
    """Rows by method of what the gripper holds, and the cells for the arm in view.

    Raises:
        InputError: The room of the seed has no place for such a camera.
    """
    for thing, methods in _METHODS.items():
        scene = {"thing": thing, "images": IMAGES}
        condition = eye_to_hand.Condition(scene, IMAGES)
        setting = condition.setting(seed)
        for _ in render(setting, data):
            pass
        for method in methods:
            row = eye_to_hand.measured(method, condition, data, setting)
            # Names of the closed form's columns.
            short = {key.removeprefix("Shah_"): value for key, value in row.items()}
            yield f"{thing}: {method}", short
        yield f"{thing}: {ARM}", _cell(data, setting)


def _cell(data: Path, setting: Setting) -> Cell:
    root = data / setting.name
    truth = json.loads((root / "truth.json").read_text())
    folder = root / "recording"
    images = []
    for i in range(IMAGES):
        image = cv2.imread(str(folder / f"{i:03d}.png"))
        if image is None:
            raise InputError(f"{folder}: image {i} is missing")
        images.append(image)
    angles = np.array(truth["joints_rad"])[:IMAGES]
    noise = np.random.default_rng([setting.seed, 46]).normal(size=angles.shape)
    angles = angles + np.deg2rad(_JOINT_NOISE_DEG) * noise
    opening = SIZES_M[setting.thing][1] * truth["scale"] / 2
    joints = np.c_[angles, np.full(IMAGES, opening)]
    camera = Camera.from_dict(json.loads((folder / "camera.json").read_text()))
    pose = truth["base_from_camera"][0]
    true_camera = SE3(pose["quaternion_wxyz"], pose["translation_m"])
    return Cell(images, joints, camera, packaged_urdf("panda"), "panda", [true_camera])
