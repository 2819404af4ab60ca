"""The equation of hand-eye calibration, its derivatives, and how noise enters it.

For every pose, `fixed_from_parent @ parent_from_camera @ camera_from_board = fixed_from_board`.
With the camera on the arm the parent is the gripper and `fixed` the robot's base; with the camera
beside the robot and the board in its hand the parent is the base and `fixed` the gripper. The noise
of a robot turns its gripper about the gripper's origin or about the base's, and both are the
origins of `parent` and `fixed`, so one model serves both mounts.

Residuals are (translation, rotation vector) in the axes of `fixed`, metres and radians.
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
    """What the equation is solved for: X = `parent_from_camera` and Z = `fixed_from_board`."""

    rotations: Array
    """(2, 3, 3) of X and Z."""
    translations: Array
    """(2, 3) of X and Z, metres."""
    scale: float = 1.0
    """Metres per unit of the camera's translations."""
    offset_s: float = 0.0
    """By how much later than its stamp says the robot was where it was at an image, seconds."""

    @classmethod
    def of(cls, parent_from_camera: SE3, fixed_from_board: SE3, scale: float = 1.0) -> Self:
        """From the transforms, single ones."""
        both = SE3.stack([parent_from_camera, fixed_from_board])
        return cls(both.rotation_matrix(), both.translation_m, scale)

    @property
    def parent_from_camera(self) -> SE3:
        """Single: the answer."""
        return se3(self.rotations[0], self.translations[0])

    @property
    def fixed_from_board(self) -> SE3:
        """Single."""
        return se3(self.rotations[1], self.translations[1])

    def moved(self, step: Array, scale_known: bool) -> "Unknowns":
        """By (p,): translation and rotation of X and of Z, logarithm of the scale, time offset.

        Translations change in the parent's axes, rotations on their right, as in `Calibration`.
        The last two are there where they are unknown.
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
    """The poses of one recording, n of them, as plain arrays: they are used in every step."""

    robot_rotation: Array
    """(n, 3, 3) of `fixed_from_parent`."""
    robot_translation: Array
    """(n, 3) metres."""
    camera_rotation: Array
    """(n, 3, 3) of `camera_from_board`."""
    camera_translation: Array
    """(n, 3) metres, or units of unknown length."""
    camera_covariance: Array
    """(n, 6, 6) known part of the noise of `camera_from_board`: (translation in the camera's axes,
    rotation in the board's); zeros where nothing is known."""
    scale_known: bool = True
    """Whether the camera's translations are in metres."""
    base_is_fixed: bool = True
    """Whether `fixed` is the robot's base and `parent` its gripper, or the other way round."""
    velocity: Array | None = None
    """(n, 6) how the robot moves: translation of the parent's origin and rotation, m/s and rad/s in
    the axes of `fixed`; given where a time offset is unknown as well."""

    @classmethod
    def of(
        cls,
        fixed_from_parent: SE3,
        camera_from_board: SE3,
        camera_covariance: Array | None = None,
        scale_known: bool = True,
        base_is_fixed: bool = True,
    ) -> Self:
        """From (n,) poses of both."""
        n = len(fixed_from_parent)
        return cls(
            fixed_from_parent.rotation_matrix(),
            fixed_from_parent.translation_m,
            camera_from_board.rotation_matrix(),
            camera_from_board.translation_m,
            np.zeros((n, 6, 6)) if camera_covariance is None else camera_covariance,
            scale_known,
            base_is_fixed,
        )

    def __getitem__(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> Self:
        """Some of the poses."""
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
        """The number of poses."""
        return len(self.robot_translation)

    def freed(self) -> Self:
        """With the scale unknown."""
        return replace(self, scale_known=False)

    @property
    def unknowns(self) -> int:
        """12, one more for the scale, one more for the time offset, in this order."""
        return 12 + (not self.scale_known) + (self.velocity is not None)

    def residuals(self, at: Unknowns) -> Array:
        """(n, 6): where the board lies by each pose, minus where it lies."""
        turned = self.robot_rotation @ at.rotations[0]
        lever = (turned @ (at.scale * self.camera_translation[..., None]))[..., 0]
        placed = lever + self.robot_rotation @ at.translations[0] + self.robot_translation
        turn = turned @ self.camera_rotation @ at.rotations[1].T
        rotation = Rotation.from_matrix(turn, assume_valid=True).as_rotvec()
        residual = np.concatenate([placed - at.translations[1], rotation], 1)
        if self.velocity is None or at.offset_s == 0.0:
            return residual
        return residual + at.offset_s * self.jacobian(at, residual)[:, :, -1]

    def jacobian(self, at: Unknowns, residual: Array) -> Array:
        """(n, 6, unknowns) derivatives of the residuals; time offset in seconds.

        Args:
            at: where.
            residual: (n, 6) `residuals(at)`.
        """
        robot = self.robot_rotation
        turned = robot @ at.rotations[0]
        board_in_camera = at.scale * self.camera_translation
        slope = _log_slope(residual[:, 3:])
        jacobian = np.zeros((len(self), 6, self.unknowns))
        jacobian[:, :3, 0:3] = robot
        jacobian[:, :3, 3:6] = -turned @ cross_matrix(board_in_camera)
        jacobian[:, 3:, 3:6] = slope @ turned
        jacobian[:, :3, 6:9] = -np.eye(3)
        jacobian[:, 3:, 9:12] = -slope.transpose(0, 2, 1) @ at.rotations[1]
        if not self.scale_known:
            jacobian[:, :3, 12] = (turned @ board_in_camera[..., None])[..., 0]
        if self.velocity is not None:
            lever = (turned @ board_in_camera[..., None])[..., 0] + robot @ at.translations[0]
            spin = self.velocity[:, 3:]
            jacobian[:, :3, -1] = self.velocity[:, :3] + np.cross(spin, lever)
            jacobian[:, 3:, -1] = (slope @ spin[..., None])[..., 0]
        return jacobian

    def known_noise(self, at: Unknowns) -> Array:
        """(n, 6, 6) covariances of the residuals by `camera_covariance`."""
        if not self.camera_covariance.any():
            return self.camera_covariance
        turned = self.robot_rotation @ at.rotations[0]
        turn = np.zeros((len(self), 6, 6))
        turn[:, :3, :3] = at.scale * turned
        turn[:, 3:, 3:] = turned @ self.camera_rotation
        return turn @ self.camera_covariance @ turn.transpose(0, 2, 1)

    def noise_directions(self, at: Unknowns, plain: bool = False) -> dict[str, Array]:
        """Per kind of noise (n, 6, c): the residuals by c errors of one metre or one radian each.

        A rotation about a point that lies far from the board moves the board.

        Args:
            at: where.
            plain: without the kinds that many poses are needed to tell apart from the others.
        """
        n = len(self)
        board, parent = at.translations[1], self.robot_translation
        camera = self.robot_rotation @ at.translations[0] + parent
        gripper, base = (parent, np.zeros((n, 3)))[:: 1 if self.base_is_fixed else -1]
        about = {"board": np.broadcast_to(board, (n, 3)), "camera": camera, "gripper": gripper}
        if not plain:
            about["base"] = base
        kinds = {f"turn about {name}": _turn(board - point) for name, point in about.items()}
        kinds["translation"] = np.broadcast_to(np.eye(6, 3), (n, 6, 3))
        if not plain:
            ray = board - camera
            depth = np.zeros((n, 6, 1))
            depth[:, :3, 0] = ray / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-9)
            kinds["depth"] = depth
        return kinds


def se3(rotation: Array, translation: Array) -> SE3:
    """From rotation matrices (..., 3, 3) and translations (..., 3)."""
    quaternion = Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True)
    return SE3(quaternion, np.asarray(translation, dtype=np.float64))


def _log_slope(rotvec: Array) -> Array:
    """(n, 3, 3) derivative of a rotation vector by a small rotation on the left.

    Transposed, by one on the right. Series of the inverse Jacobian of SO(3), within 1e-4 up to a
    radian.
    """
    matrix = cross_matrix(rotvec)
    square = matrix @ matrix
    angle2 = (rotvec**2).sum(1)[:, None, None]
    return np.eye(3) - 0.5 * matrix + (1 / 12 + angle2 / 720 + angle2**2 / 30240) * square


def _turn(lever: Array) -> Array:
    """(n, 6, 3) turns of one radian about axes through points `lever` (n, 3) off the board."""
    return np.concatenate([-cross_matrix(lever), np.broadcast_to(np.eye(3), (len(lever), 3, 3))], 1)
