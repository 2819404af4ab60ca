"""A robot cell without a robot: an arm with a wrist camera, and a fixed camera on a tripod.

The cell offers what a real one offers (`live.robot`, `live.camera`): stated gripper poses, motions
that take time, and images. The truth is separate and serves tests.
"""

from dataclasses import dataclass

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.simulation.box_room import default_camera, look_at
from evercal.simulation.cell_room import (
    THING_LOW_M,
    THING_SIZE_M,
    WORK_AREA_M,
    arm_surfaces,
    cell_room,
    thing_surfaces,
)
from evercal.simulation.panda_arm import base_from_flange
from evercal.simulation.virtual_robot import Clock, VirtualRobot
from evercal.typing import Image

RESERVED = 9000
"""Seeds from here on are reserved for final evaluation."""
NEAREST_M, FARTHEST_M, OFF_AXIS_DEG = 0.28, 0.75, 22.0
"""Reachable views have the work area within these distances, and this near the optical axis."""
LOWEST_M = 0.2
"""Height of the flange over the table."""
HELD_TURN_DEG, HIDDEN_DEG = 40.0, 60.0
"""Poses for a held thing are turned by at most this about each axis; the arm hides the thing from a
camera within this angle of the flange's back."""

_CENTRE_RAD = np.array([0.0, -0.6, 0.0, -2.2, 0.0, 1.75, 0.785])
_SPREAD_RAD = np.array([0.8, 0.6, 0.5, 0.5, 0.7, 0.55, 1.2])
_BLUR_RAD = 0.002
_MOST_BLUR_STEPS = 16


@dataclass(frozen=True)
class CellOptions:
    """Noise, image size and time of a virtual cell."""

    width: int = 640
    height: int = 480
    arm_noise_mm: float = 0.1
    """Standard deviation of the arm's true position about the stated one, per axis."""
    arm_noise_deg: float = 0.02
    """The same for the rotation."""
    image_noise: float = 0.008
    """Standard deviation of a pixel, as a fraction of full scale."""
    exposure_s: float = 0.01
    """Time over which a moving camera blurs its image."""
    realtime: bool = False
    """Whether motions take wall time; otherwise the time of the cell jumps."""
    show_arm: bool = True
    """Whether cameras see the arm."""


@dataclass(frozen=True, eq=False)
class CellTruth:
    """What a calibration should find."""

    gripper_from_camera: SE3
    base_from_tripod: SE3


class VirtualCamera:
    """A camera of the cell: on the gripper by gripper_from_camera, or fixed in the base."""

    def __init__(self, cell: "VirtualCell", mounted: SE3, on_gripper: bool):
        self._cell = cell
        self._mounted = mounted
        self._on_gripper = on_gripper

    def read(self) -> tuple[float, Image]:
        """Take an image: time in seconds, and (H, W, 3) RGB."""
        options = self._cell.options
        stamp = self._cell.clock.now()
        ends = stamp - options.exposure_s / 2, stamp + options.exposure_s / 2
        first, last = (self._cell.robot.true_state(time)[1] for time in ends)
        # A joint step moves the image by about a pixel, so that copies join to a smear.
        steps = int(
            min(np.ceil(np.abs(first - last).max() / _BLUR_RAD), _MOST_BLUR_STEPS)
        )
        times = np.linspace(*ends, steps + 1) if steps else [stamp]
        images = [self._render(float(time)) for time in times]
        mean = np.asarray(np.mean(images, axis=0), np.float32)
        noise = self._cell.noise.standard_normal(mean.shape, np.float32)
        noisy = mean + 255 * options.image_noise * noise
        return stamp, np.clip(np.round(noisy), 0, 255).astype(np.uint8)

    def _render(self, now_s: float) -> Image:
        cell = self._cell
        base_from_gripper, joints = cell.robot.true_state(now_s)
        pose = base_from_gripper @ self._mounted if self._on_gripper else self._mounted
        return cell.render(pose, joints, base_from_gripper)


class VirtualCell:
    """A cell generated from a seed: that of room, mount, tripod and noise, below 9000."""

    def __init__(self, seed: int = 0, options: CellOptions | None = None):
        self.options = options or CellOptions()
        if not 0 <= seed < RESERVED:
            raise InputError(
                f"seed {seed}: use 0 to {RESERVED - 1}; higher ones are reserved"
            )
        if min(self.options.width, self.options.height) < 64:
            raise InputError(
                f"size {self.options.width}x{self.options.height}: at least 64x64"
            )
        rng = np.random.default_rng([seed, 33])
        self.clock = Clock(self.options.realtime)
        self.intrinsics = default_camera(self.options.width, self.options.height)
        sigma = (
            self.options.arm_noise_mm / 1000,
            float(np.deg2rad(self.options.arm_noise_deg)),
        )
        self.robot = VirtualRobot(self.clock, *sigma, seed)
        self.truth = CellTruth(_mount(rng), _tripod(rng))
        self.wrist_camera = VirtualCamera(self, self.truth.gripper_from_camera, True)
        self.tripod_camera = VirtualCamera(self, self.truth.base_from_tripod, False)
        self._holds = False
        self.seed = seed
        self.noise = np.random.default_rng([seed, 34])

    def reachable_poses(self, count: int, seed: int = 0) -> SE3:
        """Random gripper poses (count,) from which a nominally mounted camera sees the table."""
        rng = np.random.default_rng([self.seed, 35, seed])
        poses: list[SE3] = []
        while len(poses) < count:
            gripper = base_from_flange(
                _CENTRE_RAD + _SPREAD_RAD * rng.uniform(-1, 1, 7)
            )
            middle = (gripper @ nominal_mount()).inverse().apply(WORK_AREA_M)
            distance = float(np.linalg.norm(middle))
            ahead = middle[2] > np.cos(np.deg2rad(OFF_AXIS_DEG)) * distance
            near = NEAREST_M < distance < FARTHEST_M
            if ahead and near and gripper.translation_m[2] > LOWEST_M:
                poses.append(gripper)
        return SE3.stack(poses)

    def hold(self, thing: bool) -> None:
        """Let the gripper hold a textured box, which hides the scene from its camera, or let go."""
        self._holds = thing

    def holding_poses(self, count: int, seed: int = 0) -> SE3:
        """Random gripper poses (count,) at which the fixed camera sees all of the held thing."""
        rng = np.random.default_rng([self.seed, 37, seed])
        base_from_camera = self.truth.base_from_tripod
        middle = base_from_flange(_CENTRE_RAD)
        corners = THING_LOW_M + THING_SIZE_M * np.indices((2, 2, 2)).reshape(3, 8).T
        image = self.intrinsics.width, self.intrinsics.height
        poses: list[SE3] = []
        while len(poses) < count:
            gripper = base_from_flange(
                _CENTRE_RAD + _SPREAD_RAD * rng.uniform(-1, 1, 7)
            )
            points = gripper.apply(corners)
            turn = (middle.inverse() @ gripper).log()[3:]
            pixels = self.intrinsics.project(base_from_camera.inverse().apply(points))
            to_camera = (
                gripper.inverse() @ base_from_camera
            ).translation_m - corners.mean(0)
            seen = ((pixels > 0) & (pixels < image)).all()
            front = to_camera[2] > -np.cos(np.deg2rad(HIDDEN_DEG)) * np.linalg.norm(
                to_camera
            )
            near = np.abs(turn).max() < np.deg2rad(HELD_TURN_DEG)
            if seen and front and near and points[:, 2].min() > 0:
                poses.append(gripper)
        return SE3.stack(poses)

    def render(
        self,
        base_from_camera: SE3,
        joints_rad: np.ndarray,
        base_from_gripper: SE3 | None = None,
    ) -> Image:
        """An ideal image, (H, W, 3), of a camera at a pose while the arm has joint angles (7,).

        `base_from_gripper` is the pose of what the gripper holds. Default: that of the joints.
        """
        moving = arm_surfaces(joints_rad) if self.options.show_arm else []
        if self._holds:
            gripper = base_from_gripper or base_from_flange(joints_rad)
            moving += thing_surfaces(self.seed, gripper)
        return cell_room(self.seed).render(self.intrinsics, base_from_camera, moving)


def nominal_mount() -> SE3:
    """gripper_from_camera as in the drawing of the cell: beside the flange, along the fingers."""
    turned = SE3.exp(np.array([0, 0, 0, 0, 0, np.pi / 4]))
    return SE3.from_translation((0.05, -0.05, 0.03)) @ turned


def _mount(rng: np.random.Generator) -> SE3:
    tangent = np.concatenate([rng.uniform(-0.02, 0.02, 3), rng.uniform(-0.1, 0.1, 3)])
    return nominal_mount() @ SE3.exp(tangent)


def _tripod(rng: np.random.Generator) -> SE3:
    side = 1.0 if rng.random() < 0.5 else -1.0
    low = (-0.1, 0.4, 0.6)
    high = (0.2, 0.6, 0.8)
    position = rng.uniform(low, high) * (1.0, side, 1.0)
    target = WORK_AREA_M + rng.uniform(-1, 1, 3) * (0.08, 0.08, 0.02)
    return look_at(position, target, float(rng.uniform(-0.05, 0.05)))
