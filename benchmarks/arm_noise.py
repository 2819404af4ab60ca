"""Errors of the poses of a hobby arm: independent noise, backlash and drift."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.hand_eye import rotations
from evercal.geometry import SE3
from evercal.recordings import Recording

ARM_MM = 5.0
"""Root mean square length of the errors of positions, millimetres."""
ARM_DEG = 1.0
"""Root mean square angle of the errors of rotations, degrees."""


def arm_errors(poses: SE3, rng: np.random.Generator) -> np.ndarray:
    """Draw errors along a path of the arm.

    Three parts have a third of the variance each. Noise is independent. Backlash is a constant on
    every axis, with the sign of the last motion. Drift is a slow sine with a period of one to two
    paths and a random phase, like joint offsets that change with temperature and load.

    Positions and rotations err independently, because the arm has no kinematics here. Errors are in
    base axes, where a constant one cannot be confused with an error of the mount.

    Args:
        poses: (n,) base_from_gripper in the order of the motion.
        rng: Source of the errors.

    Returns:
        (n, 6) metres, and radians about the gripper's origin.
    """
    sigma = np.repeat([ARM_MM / 1000, np.deg2rad(ARM_DEG)], 3) / np.sqrt(3)
    noise = rng.normal(size=(len(poses), 6))
    turned = rotations(poses)
    turns = (turned[1:] * turned[:-1].inv()).as_rotvec()
    signs = np.sign(np.c_[np.diff(poses.translation_m, axis=0), turns])
    backlash = np.r_[signs[:1], signs]
    periods = rng.uniform(1, 2, 6)
    phases = rng.uniform(0, 2 * np.pi, 6)
    along = np.linspace(0, 1, len(poses))[:, None]
    drift = np.sqrt(2) * np.sin(2 * np.pi * along / periods + phases)
    return sigma * (noise + backlash + drift) / np.sqrt(3)


def with_arm_errors(recording: Recording, rng: np.random.Generator) -> Recording:
    """Return a wrist recording whose gripper poses have the errors of a hobby arm."""
    poses = grippers(recording)
    errors = arm_errors(poses, rng)
    turned = Rotation.from_rotvec(errors[:, 3:]) * rotations(poses)
    quaternions = turned.as_quat(canonical=True, scalar_first=True)
    noisy = SE3(quaternions, poses.translation_m + errors[:, :3])
    train = (
        replace(frame, base_from_gripper=pose)
        for frame, pose in zip(recording.train, noisy, strict=True)
    )
    return replace(recording, train=tuple(train))


def grippers(recording: Recording) -> SE3:
    """(n,) gripper poses of the training frames."""
    poses = [frame.base_from_gripper for frame in recording.train]
    return SE3.stack([pose for pose in poses if pose is not None])
