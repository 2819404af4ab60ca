"""`StatedErrors`: how the poses of a recording deviate from the stated ones.

A correction of a pose is what the parameters common to all frames explain, and an error of its own.
"""

from collections.abc import Mapping
from dataclasses import field

import numpy as np

from evercal.classes import frozen_arrays
from evercal.geometry import SE3, norms
from evercal.mapping.bundle_equations import (
    COMMON,
    INTRINSICS,
    SHARED,
    SHIFT,
    Parameters,
)
from evercal.robot.arm_offsets import JointSlopes
from evercal.robot.pose_errors import SharedErrors, SharedNoise
from evercal.typing import Array

LONG_STEP = 4
"""A gap of the recording is a step longer than this many median ones."""


@frozen_arrays
class Variances:
    """Priors of a bundle adjustment."""

    sigma: Array
    """(6,) standard deviation of stated poses, metres and radians."""
    weight: Array
    """(n,) weights of the stated poses."""
    shared: Array
    """(15 + k,) variances of the shared parameters."""
    of_kinds: Array = field(default_factory=lambda: np.zeros(0))
    """Variances of the kinds of errors that stated poses share; none before they are estimated."""

    def close_to(self, other: "Variances", tolerance: float) -> bool:
        """Whether two priors differ by less than this share."""
        return all(
            np.allclose(
                values,
                vars(other)[name],
                rtol=tolerance,
                atol=0,
            )
            for name, values in vars(self).items()
        )


class StatedErrors:
    """Corrections of the stated poses of n frames, and their prior.

    The velocity (n, 6) is the motion from frame to frame, camera frame, metres and radians; 0 if
    unknown. With `gripper_from_camera` (n,), the errors of stated poses are those of an arm: they
    arise at the gripper, and its rotation moves the camera on a lever. With `joints`, offsets of
    its joints are estimated. `kinds` are errors of an arm that its poses may share.
    """

    def __init__(
        self,
        velocity: Array,
        gripper_from_camera: SE3 | None = None,
        joints: JointSlopes | None = None,
        kinds: Mapping[str, SharedErrors] | None = None,
    ):
        self.kinds = kinds or {}
        self.n = len(velocity)
        self.gripper_from_camera = gripper_from_camera or SE3.identity((self.n,))
        self.lever = self.gripper_from_camera.adjoint()
        self.joints = joints or JointSlopes(
            np.zeros((self.n, 6, 0)), np.zeros(0, bool), np.zeros(0)
        )
        by_joints = np.linalg.solve(self.lever, self.joints.slopes)
        by_common = np.tile(np.eye(6), (self.n, 1, 1))
        self.motion = np.concatenate([by_common, velocity[..., None], by_joints], 2)
        """(n, 6, 7 + k) motion of each camera by common transform, time shift and joints."""
        self.size = SHARED + by_joints.shape[2]
        """Number of shared parameters."""
        last = self.size - INTRINSICS
        self.moving = slice(0, last)
        """Shared parameters that move cameras."""
        self.offsets = slice(COMMON + SHIFT, last)
        """Shared parameters that are offsets of joints."""

    def of_cameras(self, parameters: Parameters) -> Array:
        """(n, 6) of each correction from what the shared parameters explain."""
        moved = parameters.shared[self.moving].copy()
        moved[self.offsets] -= self.joints.at
        return parameters.correction - self.motion @ moved

    def at_origin(self, parameters: Parameters) -> Array:
        """(n, 6) the same where the errors arise: at the gripper, or at the camera."""
        return np.einsum("nij,nj->ni", self.lever, self.of_cameras(parameters))

    def of_rows(self, rows: Array) -> Array:
        """(r, n, 6) errors at their origin by rows (r, 6 n + 15 + k) of all parameters.

        Of the factor of the parameters' covariance, that of the errors.
        """
        corrections = rows[:, : 6 * self.n].reshape(-1, self.n, 6)
        shared = rows[:, 6 * self.n :][:, self.moving]
        explained = np.einsum("nij,kj->kni", self.motion, shared)
        return np.einsum("nij,knj->kni", self.lever, corrections - explained)

    def prior(
        self, parameters: Parameters, variances: Variances
    ) -> tuple[Array, Array]:
        """Normal matrix of the priors (6 n + 15 + k, 6 n + 15 + k), and their slope."""
        poses = 6 * self.n
        system = np.zeros((poses + self.size,) * 2)
        slope = np.zeros(poses + self.size)
        noise = self.noise(variances)
        back = self.lever.transpose(0, 2, 1)
        own = back @ noise.information @ self.lever
        half = (back @ noise.half.reshape(*noise.shared.shape)).reshape(poses, -1)
        errors = self.lever @ self.of_cameras(parameters)[..., None]
        pull = (back @ noise.weighted(errors))[..., 0]
        drift = back @ noise.weighted(self.lever @ self.motion)
        moving = slice(poses, poses + self.motion.shape[2])
        system[:poses, :poses] = -half @ half.T
        for i in range(self.n):
            rows = slice(6 * i, 6 * i + 6)
            system[rows, rows] += own[i]
            system[rows, moving] = -drift[i]
            system[moving, rows] = -drift[i].T
        system[moving, moving] = np.einsum("nij,nik->jk", self.motion, drift)
        slope[:poses] = pull.ravel()
        slope[moving] = -np.einsum("nij,ni->j", self.motion, pull)
        shared = np.arange(poses, len(slope))
        system[shared, shared] += 1 / variances.shared
        slope[shared] += parameters.shared / variances.shared
        return system, slope

    def noise(self, variances: Variances) -> SharedNoise:
        """Covariance of the errors where they arise."""
        own = variances.sigma**2 / variances.weight[:, None]
        kinds = self.kinds
        if not len(variances.of_kinds):
            kinds = {}
        return SharedNoise(
            own[:, :, None] * np.eye(6),
            variances.of_kinds,
            kinds,
        )


def velocity_of(poses: SE3) -> Array:
    """(n, 6) motion from frame to frame of recorded poses (n,); 0 beside gaps of the recording."""
    velocity = np.zeros((len(poses), 6))
    if len(poses) < 3:
        return velocity
    steps = (poses[:-1].inverse() @ poses[1:]).log()
    size = norms(steps)
    smooth = size < LONG_STEP * np.median(size) + 1e-9
    mean = (steps[:-1] + steps[1:]) / 2
    velocity[1:-1] = np.where(
        (smooth[:-1] & smooth[1:])[:, None],
        mean,
        0,
    )
    return velocity
