"""`Episode`: a fixed camera in one recorded episode, and the pose that a data set states of it."""

from collections.abc import Mapping, Sequence
from dataclasses import field

import numpy as np

from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.recordings.frame import Frame
from evercal.recordings.images import StoredImage
from evercal.recordings.poses.joint_tables import radians_per
from evercal.robot.robot_model import RobotModel
from evercal.typing import Array, Floats, Strings


@frozen_arrays
class Episode:
    """Some images of a camera in an episode, with joint values."""

    name: str
    """Name of the episode; names sort by time."""
    camera: str = ""
    """What names its stated pose: a feature, or the serial number of the camera."""
    frames: tuple[Frame, ...] = ()
    """Spread over the episode, taken where the arm is slow."""
    joints: Strings = ()
    """Names of the values in `Frame.joints_rad`."""
    stated: Mapping[str, Floats] = field(default_factory=dict)
    """Stated poses of all fixed cameras."""
    problem: str = ""
    """Why the episode cannot be read."""


def slow_rows(values: Array, count: int) -> list[int]:
    """Indices of the slowest of (n, k) joint values in each of `count` parts.

    Times of images and of joint values differ by milliseconds, in which a slow arm moves little.
    """
    steps = np.abs(np.diff(values, axis=0, prepend=values[:1])).max(1)
    speed = steps + np.append(steps[1:], 0.0)
    parts = np.array_split(np.arange(len(values)), min(count, len(values)))
    return [int(part[speed[part].argmin()]) for part in parts]


def values_of_joints(
    model: RobotModel, names: Sequence[str], values: Array, unit: str | None
) -> tuple[Strings, Array]:
    """Names and values (n, k) of the joints of a URDF, from named numbers of a data set.

    If the URDF knows none of the names, the numbers but the gripper's are its first joints.
    """
    kept = [i for i, name in enumerate(names) if model.has_joint(name)]
    joints = [names[i] for i in kept]
    if not kept:
        kept = [i for i, name in enumerate(names) if "gripper" not in name.lower()]
        joints = model.drivers()[: len(kept)]
    if not 0 < len(kept) == len(joints):
        raise InputError(
            f"{model.path}: has {len(joints)} joints that move, the data set states {len(kept)};"
            f" give `urdf` of the robot"
        )
    factors = radians_per(model, joints, [unit] * len(kept))
    return tuple(joints), values[:, kept] * factors


def frames_of(
    images: Sequence[StoredImage], values: Array, camera: Camera
) -> tuple[Frame, ...]:
    """Frames of images at (n, k) joint values."""
    frames = []
    for i, (image, row) in enumerate(zip(images, values.tolist(), strict=True)):
        frames.append(Frame(str(i), image, camera, joints_rad=tuple(row)))
    return tuple(frames)
