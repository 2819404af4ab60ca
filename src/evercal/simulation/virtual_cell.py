"""A robot cell without a robot: an arm with a wrist camera, and a fixed camera on a tripod.

The cell offers what a real one offers (`live.robot`, `live.camera`): stated gripper poses, motions
that take time, and images. The truth is separate and serves tests.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.random import Generator, default_rng

from evercal.classes import frozen, frozen_arrays
from evercal.errors import InputError, require_numbers
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
from evercal.typing import Array, Image

RESERVED = 9000
"""Seeds from here on are reserved for final evaluation."""
NEAREST_M = 0.28
"""Minimum distance of the camera from the work area in reachable views, metres."""
FARTHEST_M = 0.75
"""Maximum distance of the camera from the work area in reachable views, metres."""
OFF_AXIS_DEG = 22.0
"""Maximum angle between the optical axis and the work area in reachable views, degrees."""
LOWEST_M = 0.2
"""Minimum height of the flange over the table in reachable views, metres."""
HELD_TURN_DEG = 40.0
"""Maximum rotation about each axis of the flange that holds a box, degrees."""
HIDDEN_DEG = 60.0
"""The arm hides a held box from a camera within this angle of the flange's back, degrees."""

_ARM_POSES_RAD = np.array(
    [
        (0.0, 0.8),
        (-0.6, 0.6),
        (0.0, 0.5),
        (-2.2, 0.5),
        (0.0, 0.7),
        (1.75, 0.55),
        (0.785, 1.2),
    ]
)
"""(7, 2) mean of random angles of each joint and their maximum deviation, radians."""
_BLUR_RAD = 0.002
"""Joint step between two copies of a blurred image, radians: they shift by about a pixel."""
_MOST_BLUR_STEPS = 16
"""Maximum number of steps between the copies of a blurred image."""


@frozen
class CellOptions:
    """Noise, image size and time of a virtual cell."""

    width: int = 640
    """Image width, pixels."""
    height: int = 480
    """Image height, pixels."""
    arm_noise_mm: float = 0.1
    """Standard deviation of the arm's true position about the stated one, mm per axis."""
    arm_noise_deg: float = 0.02
    """Standard deviation of the arm's true rotation about the stated one, degrees per axis."""
    image_noise: float = 0.008
    """Standard deviation of a pixel, as a fraction of full scale."""
    exposure_s: float = 0.01
    """Exposure time, seconds; a moving camera blurs its image."""
    realtime: bool = False
    """Whether motions take wall time; otherwise the time of the cell jumps."""
    show_arm: bool = True
    """Whether cameras see the arm."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        require_numbers(self, ("width", "height"), 1)
        numbers = ("arm_noise_mm", "arm_noise_deg", "image_noise", "exposure_s")
        require_numbers(self, numbers, 0)


@frozen_arrays
class CellTruth:
    """What a calibration should find."""

    gripper_from_camera: SE3
    """Pose of the wrist camera on the flange."""
    base_from_tripod: SE3
    """Pose of the fixed camera."""


class VirtualCamera:
    """A camera of the cell: on the gripper by gripper_from_camera, or fixed in the base."""

    def __init__(
        self,
        cell: "VirtualCell",
        mounted: SE3,
        on_gripper: bool,
    ):
        self._cell = cell
        self._mounted = mounted
        self._on_gripper = on_gripper

    def read(self) -> tuple[float, Image]:
        """Take an image: time in seconds, and (H, W, 3) RGB."""
        cell = self._cell
        now = cell.clock.now()
        half_s = cell.options.exposure_s / 2
        start = now - half_s
        end = now + half_s
        _, first = cell.robot.true_state(start)
        _, last = cell.robot.true_state(end)
        turn_rad = np.abs(first - last).max()
        steps = min(math.ceil(turn_rad / _BLUR_RAD), _MOST_BLUR_STEPS)
        times = [now]
        if steps:
            times = np.linspace(start, end, steps + 1).tolist()
        copies = [self._render(time) for time in times]
        mean = np.asarray(np.mean(copies, axis=0), np.float32)
        noise = cell.noise.standard_normal(mean.shape, np.float32)
        noisy = mean + 255 * cell.options.image_noise * noise
        rounded = np.clip(np.round(noisy), 0, 255)
        return now, rounded.astype(np.uint8)

    def _render(self, now_s: float) -> Image:
        cell = self._cell
        base_from_gripper, joints = cell.robot.true_state(now_s)
        base_from_camera = self._mounted
        if self._on_gripper:
            base_from_camera = base_from_gripper @ self._mounted
        return cell.render(base_from_camera, joints, base_from_gripper)


class VirtualCell:
    """A cell generated from a seed: that of room, mount, tripod and noise, below 9000."""

    def __init__(self, seed: int = 0, options: CellOptions | None = None):
        options = options or CellOptions()
        self.options = options
        if not 0 <= seed < RESERVED:
            raise InputError(
                f"seed {seed}: use 0 to {RESERVED - 1}; higher ones are reserved"
            )
        if min(options.width, options.height) < 64:
            raise InputError(f"size {options.width}x{options.height}: at least 64x64")
        rng = default_rng([seed, 33])
        self.clock = Clock(options.realtime)
        self.intrinsics = default_camera(options.width, options.height)
        noise_m = options.arm_noise_mm / 1000
        noise_rad = float(np.deg2rad(options.arm_noise_deg))
        self.robot = VirtualRobot(self.clock, noise_m, noise_rad, seed)
        self.truth = CellTruth(_mount(rng), _tripod(rng))
        self.wrist_camera = VirtualCamera(
            self,
            mounted=self.truth.gripper_from_camera,
            on_gripper=True,
        )
        self.tripod_camera = VirtualCamera(
            self,
            mounted=self.truth.base_from_tripod,
            on_gripper=False,
        )
        self._holds = False
        self.seed = seed
        self.noise = default_rng([seed, 34])

    def reachable_poses(self, count: int, seed: int = 0) -> SE3:
        """Random gripper poses (count,) from which a nominally mounted camera sees the table."""

        def usable(gripper: SE3) -> bool:
            base_from_camera = gripper @ nominal_mount()
            work_area = base_from_camera.inverse().apply(WORK_AREA_M)
            distance = float(np.linalg.norm(work_area))
            least_depth = np.cos(np.deg2rad(OFF_AXIS_DEG)) * distance
            ahead = work_area[2] > least_depth
            near = NEAREST_M < distance < FARTHEST_M
            high = gripper.translation_m[2] > LOWEST_M
            return ahead and near and high

        return _random_poses(count, [self.seed, 35, seed], usable)

    def hold(self, thing: bool) -> None:
        """Let the gripper hold a textured box, which hides the scene from its camera, or let go."""
        self._holds = thing

    def holding_poses(self, count: int, seed: int = 0) -> SE3:
        """Random gripper poses (count,) at which the fixed camera sees all of the held thing."""
        base_from_camera = self.truth.base_from_tripod
        camera_from_base = base_from_camera.inverse()
        middle_from_base = base_from_flange(_ARM_POSES_RAD[:, 0]).inverse()
        unit_cube = np.indices((2, 2, 2)).reshape(3, 8).T
        corners = THING_LOW_M + THING_SIZE_M * unit_cube
        image = self.intrinsics.size

        def usable(gripper: SE3) -> bool:
            points = gripper.apply(corners)
            in_camera = camera_from_base.apply(points)
            pixels = self.intrinsics.project(in_camera)
            visible = np.all((pixels > 0) & (pixels < image))
            gripper_from_camera = gripper.inverse() @ base_from_camera
            to_camera = gripper_from_camera.translation_m - corners.mean(0)
            distance = np.linalg.norm(to_camera)
            behind = -np.cos(np.deg2rad(HIDDEN_DEG)) * distance
            turn = (middle_from_base @ gripper).log()[3:]
            upright = np.abs(turn).max() < np.deg2rad(HELD_TURN_DEG)
            above = points[:, 2].min() > 0
            unhidden = to_camera[2] > behind
            return bool(visible and unhidden and upright and above)

        return _random_poses(count, [self.seed, 37, seed], usable)

    def render(
        self,
        base_from_camera: SE3,
        joints_rad: Array,
        base_from_gripper: SE3 | None = None,
    ) -> Image:
        """An ideal image, (H, W, 3), of a camera at a pose while the arm has joint angles (7,).

        `base_from_gripper` is the pose of what the gripper holds. Default: that of the joints.
        """
        moving = []
        if self.options.show_arm:
            moving = arm_surfaces(joints_rad)
        if self._holds:
            gripper = base_from_gripper or base_from_flange(joints_rad)
            moving += thing_surfaces(self.seed, gripper)
        return cell_room(self.seed).render(self.intrinsics, base_from_camera, moving)


def nominal_mount() -> SE3:
    """gripper_from_camera as in the drawing of the cell: beside the flange, along the fingers."""
    about_z = np.pi / 4
    turn = SE3.exp([0, 0, 0, 0, 0, about_z])
    shift = SE3.from_translation((0.05, -0.05, 0.03))
    return shift @ turn


def _random_poses(
    count: int,
    seed: Sequence[int],
    usable: Callable[[SE3], bool],
) -> SE3:
    """Usable gripper poses (count,) for random joint angles."""
    rng = default_rng(seed)
    mean, spread = _ARM_POSES_RAD.T
    poses = []
    while len(poses) < count:
        joints = mean + spread * rng.uniform(-1, 1, 7)
        gripper = base_from_flange(joints)
        if usable(gripper):
            poses.append(gripper)
    return SE3.stack(poses)


def _mount(rng: Generator) -> SE3:
    shift = rng.uniform(-0.02, 0.02, 3)
    turn = rng.uniform(-0.1, 0.1, 3)
    return nominal_mount() @ SE3.exp(np.concatenate([shift, turn]))


def _tripod(rng: Generator) -> SE3:
    side = 1.0
    if rng.random() >= 0.5:
        side = -1.0
    lowest = (-0.1, 0.4, 0.6)
    highest = (0.2, 0.6, 0.8)
    position = rng.uniform(lowest, highest)
    most_m = (0.08, 0.08, 0.02)
    aside = rng.uniform(-1, 1, 3) * most_m
    return look_at(
        position * (1.0, side, 1.0),
        WORK_AREA_M + aside,
        roll_rad=rng.uniform(-0.05, 0.05),
    )
