"""Rendered data in the place of a robot's, for the examples; with your own data, leave them out."""

import time
from pathlib import Path

import cv2
import numpy as np

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.printing import board_image
from evercal.geometry import SE3
from evercal.live.recorder import pose_rows
from evercal.simulation.box_room import look_at
from evercal.simulation.cell_recording import record_cell
from evercal.simulation.cell_room import WORK_AREA_M
from evercal.simulation.virtual_cell import CellOptions, VirtualCell

K = np.array([[900.0, 0, 640], [0, 900, 480], [0, 0, 1]])
BASE_FROM_CAMERA = SE3.from_translation([1.0, 0.2, 0.5]) @ SE3.exp([0, 0, 0, 0, 2.2, 0])
GRIPPER_FROM_BOARD = SE3.exp([-0.13, -0.09, 0.05, 0, 0, 0.1])
AWAY_RAD = np.array([0.0, -1.6, 0.0, -2.8, 0.0, 1.3, 0.8])
"""Joints of an arm that is out of the way."""


def board_images(folder: Path, count: int = 20) -> None:
    """Images of a fixed camera, whose board a gripper turns, with gripper poses and intrinsics."""
    rng = np.random.default_rng(0)
    drawn = board_image(Board("charuco", 0.03, 9, 6, 0.022, "5X5_100"), unit_px=100)
    square = np.diag([0.03 / 100, 0.03 / 100, 1])
    folder.mkdir(exist_ok=True)
    grippers = []
    for i in range(count):
        turn = rng.normal(0, 0.3, 3)
        distance = rng.uniform(0.5, 0.7)
        camera_from_board = SE3.exp([-0.13, -0.09, distance, *turn])
        gripper = BASE_FROM_CAMERA @ camera_from_board @ GRIPPER_FROM_BOARD.inverse()
        grippers.append(gripper @ SE3.exp(rng.normal(0, [1e-4] * 3 + [3e-4] * 3)))
        plane = K @ camera_from_board.matrix()[:3, [0, 1, 3]] @ square
        image = cv2.warpPerspective(drawn, plane, (1280, 960), borderValue=[128])
        image = cv2.GaussianBlur(image, (0, 0), 0.7) + rng.normal(0, 3, image.shape)
        cv2.imwrite(str(folder / f"{i:02}.png"), image.clip(0, 255).astype(np.uint8))
    (folder / "poses.csv").write_text(pose_rows(SE3.stack(grippers)))
    np.savetxt(folder / "camera.txt", K)


def phone_video(file: Path, folder: Path) -> None:
    """A walk around a virtual cell, and a recording of the camera on its arm."""
    options = CellOptions(width=320, height=240)
    list(record_cell(folder, 0, 12, options))
    cell = VirtualCell(0, options)
    codec = cv2.VideoWriter.fourcc(*"mp4v")
    writer = cv2.VideoWriter(str(file), codec, 15, (320, 240))
    for radius, height in ((0.7, 0.5), (0.5, 0.7), (0.25, 0.6)):
        for angle in np.linspace(-1.8, 1.8, 12):
            x = radius * np.cos(angle)
            y = radius * np.sin(angle)
            eye = WORK_AREA_M + np.array([x, y, height])
            image = cell.render(look_at(eye, WORK_AREA_M), AWAY_RAD)
            writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    writer.release()


class VisitingCell:
    """A virtual arm that stands at another pose every second, with the camera on it."""

    def __init__(self):
        self._cell = VirtualCell()
        self._views = self._cell.reachable_poses(100)
        self._begun = time.monotonic()
        self._number = -1
        self.intrinsics = self._cell.intrinsics

    def base_from_gripper(self) -> SE3:
        """The stated pose."""
        number = int(time.monotonic() - self._begun)
        if number != self._number:
            self._cell.robot.move_to(self._views[number % len(self._views)])
            self._number = number
        return self._cell.robot.base_from_gripper()

    def read(self):
        """Time and image."""
        return self._cell.wrist_camera.read()
