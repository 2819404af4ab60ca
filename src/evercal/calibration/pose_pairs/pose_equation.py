"""The hand-eye equation, its derivatives and its noise model.

For every pose, `fixed_from_parent @ parent_from_camera @ camera_from_board = fixed_from_board`.
For a camera on the arm, `parent` is the gripper and `fixed` is the robot base. For a fixed camera
with the board in the gripper, `parent` is the base and `fixed` is the gripper. The noise of a robot
rotates its gripper about the origin of the gripper or of the base. These are the origins of
`parent` and `fixed`, so one model serves both mounts.

Residuals are (translation, rotation vector) in the frame `fixed`, metres and radians.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from evercal.geometry import SE3, cross_matrix

Array = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Unknowns of the equation: X = `parent_from_camera` and Z = `fixed_from_board`."""

    rotations: Array
    """(2, 3, 3) of X and Z."""
    translations: Array
    """(2, 3) of X and Z, metres."""
    scale: float = 1.0
    """Metres per unit of the camera's translations."""
    offset_s: float = 0.0
    """Time to add to a camera stamp to get the robot's time, seconds."""

    @property
    def parent_from_camera(self) -> SE3:
        """The calibration."""
        return se3(self.rotations[0], self.translations[0])

    @property
    def fixed_from_board(self) -> SE3:
        """Board pose in the fixed frame."""
        return se3(self.rotations[1], self.translations[1])

    def moved(self, step: Array, scale_known: bool) -> "Unknowns":
        """Return the unknowns after a (p,) step.

        The step holds translation and rotation of X, then of Z, then the logarithm of the scale and
        the time offset if they are unknown. Translations change in the parent frame, rotations by a
        factor on the right, as in `Calibration`.
        """
        both = step[:12].reshape(2, 6)
        rest = step[12:] if scale_known else step[13:]
        growth = 1.0 if scale_known else float(np.exp(np.clip(step[12], -1, 1)))
        return Unknowns(
            self.rotations @ Rotation.from_rotvec(both[:, 3:]).as_matrix(),
            self.translations + both[:, :3],
            self.scale * growth,
            self.offset_s + float(rest.sum()),
        )


@dataclass(frozen=True, eq=False)
class PoseEquation:
    """The n poses of one recording as plain arrays, which every step uses."""

    robot_rotation: Array
    """(n, 3, 3) of `fixed_from_parent`."""
    robot_translation: Array
    """(n, 3) metres."""
    camera_rotation: Array
    """(n, 3, 3) of `camera_from_board`."""
    camera_translation: Array
    """(n, 3) metres, or another unit if the scale is unknown."""
    camera_covariance: Array
    """(n, 6, 6) known covariance of `camera_from_board`: (translation in the camera frame, rotation
    about the board's axes); zero if it is unknown."""
    scale_known: bool = True
    """Whether the camera's translations are in metres."""
    base_is_fixed: bool = True
    """Whether `fixed` is the robot base and `parent` the gripper, not the reverse."""
    velocity: Array | None = None
    """(n, 6) velocity of the parent in the frame `fixed`, m/s and rad/s; required for a time
    offset."""

    def __getitem__(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> Self:
        """Return a subset of the poses."""
        return replace(
            self,
            robot_rotation=self.robot_rotation[index],
            robot_translation=self.robot_translation[index],
            camera_rotation=self.camera_rotation[index],
            camera_translation=self.camera_translation[index],
            camera_covariance=self.camera_covariance[index],
            velocity=None if self.velocity is None else self.velocity[index],
        )

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.robot_translation)

    @property
    def unknowns(self) -> int:
        """Number of unknowns: 12, then one for the scale and one for the time offset."""
        return 12 + (not self.scale_known) + (self.velocity is not None)

    def residuals(self, at: Unknowns) -> Array:
        """Return (n, 6) differences between the board pose by each image and the estimate."""
        fixed_from_camera = self.robot_rotation @ at.rotations[0]
        lever = (fixed_from_camera @ (at.scale * self.camera_translation[..., None]))[..., 0]
        board = lever + self.robot_rotation @ at.translations[0] + self.robot_translation
        difference = fixed_from_camera @ self.camera_rotation @ at.rotations[1].T
        rotation = Rotation.from_matrix(difference, assume_valid=True).as_rotvec()
        residual = np.concatenate([board - at.translations[1], rotation], 1)
        if self.velocity is None or at.offset_s == 0.0:
            return residual
        return residual + at.offset_s * self.jacobian(at, residual)[:, :, -1]

    def jacobian(self, at: Unknowns, residual: Array) -> Array:
        """Return the (n, 6, unknowns) derivatives of the residuals (n, 6)."""
        robot = self.robot_rotation
        fixed_from_camera = robot @ at.rotations[0]
        board_in_camera = at.scale * self.camera_translation
        slope = _log_slope(residual[:, 3:])
        jacobian = np.zeros((len(self), 6, self.unknowns))
        jacobian[:, :3, 0:3] = robot
        jacobian[:, :3, 3:6] = -fixed_from_camera @ cross_matrix(board_in_camera)
        jacobian[:, 3:, 3:6] = slope @ fixed_from_camera
        jacobian[:, :3, 6:9] = -np.eye(3)
        jacobian[:, 3:, 9:12] = -slope.transpose(0, 2, 1) @ at.rotations[1]
        if not self.scale_known:
            jacobian[:, :3, 12] = (fixed_from_camera @ board_in_camera[..., None])[..., 0]
        if self.velocity is not None:
            lever = (fixed_from_camera @ board_in_camera[..., None])[..., 0]
            lever = lever + robot @ at.translations[0]
            angular = self.velocity[:, 3:]
            jacobian[:, :3, -1] = self.velocity[:, :3] + np.cross(angular, lever)
            jacobian[:, 3:, -1] = (slope @ angular[..., None])[..., 0]
        return jacobian

    def known_noise(self, at: Unknowns) -> Array:
        """Return the (n, 6, 6) covariance of the residuals due to `camera_covariance`."""
        if not self.camera_covariance.any():
            return self.camera_covariance
        fixed_from_camera = self.robot_rotation @ at.rotations[0]
        slope = np.zeros((len(self), 6, 6))
        slope[:, :3, :3] = at.scale * fixed_from_camera
        slope[:, 3:, 3:] = fixed_from_camera @ self.camera_rotation
        return slope @ self.camera_covariance @ slope.transpose(0, 2, 1)

    def noise_directions(self, at: Unknowns, plain: bool = False) -> dict[str, Array]:
        """Return the residuals due to unit errors of each kind of noise, (n, 6, c) by kind.

        A unit is one metre or one radian. A rotation about a distant point also moves the board.
        With `plain`, kinds that only many poses can separate from the others are omitted.
        """
        n = len(self)
        board, parent = at.translations[1], self.robot_translation
        camera = self.robot_rotation @ at.translations[0] + parent
        gripper, base = (parent, np.zeros((n, 3)))[:: 1 if self.base_is_fixed else -1]
        about = {"board": np.broadcast_to(board, (n, 3)), "camera": camera, "gripper": gripper}
        if not plain:
            about["base"] = base
        kinds = {
            f"rotation about {name}": _rotation_errors(board - point)
            for name, point in about.items()
        }
        kinds["translation"] = np.broadcast_to(np.eye(6, 3), (n, 6, 3))
        if not plain:
            ray = board - camera
            depth = np.zeros((n, 6, 1))
            depth[:, :3, 0] = ray / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-9)
            kinds["depth"] = depth
        return kinds


def se3(rotation: Array, translation: Array) -> SE3:
    """Create poses from rotation matrices (..., 3, 3) and translations (..., 3)."""
    quaternion = Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True)
    return SE3(quaternion, np.asarray(translation, dtype=np.float64))


def _log_slope(rotvec: Array) -> Array:
    """Return the (n, 3, 3) derivative of a rotation vector by a small rotation on its left.

    The transpose is the derivative by a rotation on the right. This is a series of the inverse
    Jacobian of SO(3), accurate to 1e-4 up to one radian.
    """
    matrix = cross_matrix(rotvec)
    square = matrix @ matrix
    angle2 = (rotvec**2).sum(1)[:, None, None]
    return np.eye(3) - 0.5 * matrix + (1 / 12 + angle2 / 720 + angle2**2 / 30240) * square


def _rotation_errors(lever: Array) -> Array:
    """Return (n, 6, 3) residuals of unit rotations about points at a distance of `lever` (n, 3)."""
    return np.concatenate([-cross_matrix(lever), np.broadcast_to(np.eye(3), (len(lever), 3, 3))], 1)
