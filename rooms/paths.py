"""Camera paths: smooth training and test sweeps, and calibration recordings.

A sweep moves on a dome around the work area. Training and test sweeps differ in their phases. Test
poses close to a training pose are removed, and the sweep is sampled more densely until enough
poses remain.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.simulation.box_room import look_at
from evercal.simulation.panda_arm import HOME_RAD
from rooms.room import Room
from rooms.shapes import positions

WORK_AREA_M = np.array([0.45, 0.0, 0.15])
"""Centre of the work area that cameras look at, base frame."""
NEAR_M = 0.05
NEAR_RAD = np.deg2rad(5.0)
TOO_NEAR_M = 0.012
TOO_NEAR_RAD = np.deg2rad(1.2)
NEAR_SHARE = 0.08
"""Largest fraction of test frames within NEAR_M and NEAR_RAD of a training frame."""


@dataclass(frozen=True, eq=False)
class Shot:
    """One frame before it is rendered."""

    name: str
    """Unique within the recording."""
    split: Literal["train", "test"]
    """Training or test."""
    base_from_camera: SE3
    """Camera pose, shape ()."""
    joints_rad: np.ndarray
    """(7,) joint angles of the arm."""


def sweep_shots(room: Room, frames: int, seed: int) -> list[Shot]:
    """Plan a moving camera: 70 % training frames, 30 % test frames.

    Raises:
        InputError: The room has no free path.
    """
    train_count = max(1, round(0.7 * frames))
    train = free_path(room, train_count, [seed, 1])
    test = _far_from(room, frames - train_count, train, [seed, 9])
    arm_train = _arm_path(train_count, [seed, 2], hold=12)
    arm_test = _arm_path(frames - train_count, [seed, 3], hold=12)
    return _shots("train", train, arm_train) + _shots("test", test, arm_test)


def _shots(name: str, poses: Iterable[SE3], joints_rad: np.ndarray) -> list[Shot]:
    """Numbered training frames, called train, or test frames of another name."""
    split = "train" if name == "train" else "test"
    return [
        Shot(f"{name}-{i:06d}", split, pose, joints)
        for i, (pose, joints) in enumerate(zip(poses, joints_rad, strict=True))
    ]


def changed_shots(room: Room, frames: int, train: SE3, seed: int) -> list[Shot]:
    """Plan the test frames of a moving camera in a changed room.

    `train` holds base_from_camera (n,) of the training frames before the change.

    Raises:
        InputError: The room has no free path.
    """
    path = _far_from(room, frames, train, [seed, 10])
    arm = _arm_path(frames, [seed, 11], hold=12)
    return _shots("changed", path, arm)


class FixedShots(NamedTuple):
    """Frames of a fixed camera before and after a bump."""

    before: list[Shot]
    """Frames before the bump."""
    after: list[Shot]
    """Frames after the bump."""
    bump: SE3
    """camera_before_from_camera_after."""


def fixed_shots(room: Room, frames: int, seed: int) -> FixedShots:
    """Plan a fixed camera with a moving arm, before and after a bump.

    The bump is 5 mm in a random direction for even seeds, 0.5 deg about a random axis for odd ones.
    """
    rng = np.random.default_rng([seed, 4])
    pose = free_path(room, 200, [seed, 5])[int(rng.integers(200))]
    direction = rng.standard_normal(3)
    direction /= np.linalg.norm(direction)
    tangent = np.zeros(6)
    if seed % 2 == 0:
        tangent[:3] = 0.005 * direction
    else:
        tangent[3:] = np.deg2rad(0.5) * direction
    bump = SE3.exp(tangent)
    arms = _arm_path(2 * frames, [seed, 6], hold=1, cycles=3.0)
    before = _shots("fixed", [pose] * frames, arms[:frames])
    after = _shots("bumped", [pose @ bump] * frames, arms[frames:])
    return FixedShots(before, after, bump)


def hand_camera(seed: int) -> SE3:
    """gripper_from_camera: 8 cm beside the flange, along the fingers, slightly tilted."""
    rng = np.random.default_rng([seed, 7])
    tangent = np.concatenate([rng.uniform(-0.01, 0.01, 3), rng.uniform(-0.12, 0.12, 3)])
    return SE3.from_translation((0.085, 0.0, 0.02)) @ SE3.exp(tangent)


def hand_joints(frames: int, seed: int) -> np.ndarray:
    """Random joint angles with the flange high and tilted over the table, shape (frames, 7).

    Filter them with `sees_work_area`.
    """
    rng = np.random.default_rng([seed, 8])
    start = np.array([0.0, -0.9, 0.0, -2.1, 0.0, 2.0, 0.785])
    spread = np.array([0.9, 0.35, 0.4, 0.35, 0.5, 0.35, 0.9])
    return start + spread * rng.uniform(-1, 1, (frames, 7))


def sees_work_area(base_from_camera: SE3) -> bool:
    """Whether the work area is within 25 deg of the optical axis and at least 0.5 m away."""
    middle = base_from_camera.inverse().apply(WORK_AREA_M)
    distance = float(np.linalg.norm(middle))
    return distance > 0.5 and middle[2] > np.cos(np.deg2rad(25.0)) * distance


def _arm_path(
    frames: int, seed: list[int], hold: int, cycles: float | None = None
) -> np.ndarray:
    """Joint angles around the ready position, constant for `hold` frames, shape (frames, 7)."""
    rng = np.random.default_rng(seed)
    step = np.arange(frames) // hold * hold
    t = step * (2 * np.pi * (cycles or 1.0 + frames / 400) / max(frames, 1))
    spread = np.array([0.45, 0.25, 0.3, 0.3, 0.5, 0.35, 0.6])
    phase = rng.uniform(0, 2 * np.pi, (2, 7))
    wave = 0.65 * np.sin(t[:, None] + phase[0]) + 0.35 * np.sin(
        2.3 * t[:, None] + phase[1]
    )
    return HOME_RAD + spread * wave


def free_path(room: Room, frames: int, seed: list[int]) -> SE3:
    """A sweep that avoids all objects, shape (frames,)."""
    for attempt in range(300):
        path = _sweep(frames, np.random.default_rng([*seed, room.seed, attempt]))
        if is_clear(room, path.translation_m).all():
            return path
    raise InputError(f"{room.kind} {room.seed}: no free camera path; use another seed")


def is_clear(room: Room, points: np.ndarray) -> np.ndarray:
    """Whether points (n, 3) are outside all objects and outside the arm's reach above its table."""
    near_arm = np.linalg.norm(points - (0.2, 0.0, 0.45), axis=-1) < 0.62
    return room.is_free(points) & ~near_arm


def _sweep(frames: int, rng: np.random.Generator) -> SE3:
    """A path that is smooth in direction, distance, height and gaze, shape (frames,)."""
    cycles = 1.0 + frames / 500
    t = np.linspace(0, 2 * np.pi * cycles, max(frames, 2), endpoint=False)[:frames]

    def wave(low: float, high: float, speed: float) -> np.ndarray:
        phase = rng.uniform(0, 2 * np.pi, 2)
        mix = 0.7 * np.sin(speed * t + phase[0]) + 0.3 * np.sin(
            2.6 * speed * t + phase[1]
        )
        return (low + high) / 2 + (high - low) / 2 * mix

    azimuth = wave(-1.9, 1.9, 1.0)
    distance = wave(0.85, 1.9, 1.63)
    elevation = wave(0.28, 0.95, 0.71)
    gaze = positions(
        wave(-0.45, 0.15, 0.9), wave(-0.35, 0.35, 1.2), wave(-0.1, 0.3, 1.4)
    )
    target = WORK_AREA_M + gaze
    roll = wave(-0.12, 0.12, 0.8)
    flat = np.cos(elevation)
    direction = positions(
        np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)
    )
    position = WORK_AREA_M + distance[:, None] * direction
    return SE3.stack(list(map(look_at, position, target, roll)))


def _far_from(room: Room, frames: int, train: SE3, seed: list[int]) -> SE3:
    """A sweep with few poses near a training pose and none very near, shape (frames,)."""
    if frames == 0:
        return SE3.stack([])
    for density in (1.0, 1.15, 1.3, 1.6, 2.0, 3.0):
        for attempt in range(4):
            path = free_path(room, int(np.ceil(frames * density)), [*seed, attempt])
            metres, radians = pose_distance(path[:, None], train[None])
            too_near = ((metres < TOO_NEAR_M) & (radians < TOO_NEAR_RAD)).any(1)
            near = ((metres < NEAR_M) & (radians < NEAR_RAD)).any(1)
            far = np.flatnonzero(~near)
            allowed = np.flatnonzero(near & ~too_near)[: int(NEAR_SHARE * frames)]
            selected = np.sort(np.concatenate([far, allowed]))
            if len(selected) >= frames and near[selected[:frames]].mean() <= NEAR_SHARE:
                return path[selected[:frames]]
    raise InputError(
        f"{room.kind} {room.seed}: no test path away from training; use another seed"
    )
