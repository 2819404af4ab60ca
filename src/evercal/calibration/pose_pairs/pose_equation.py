"""The hand-eye equation with all unknowns, its derivatives and its kinds of noise.

For every pose, `fixed_from_parent @ parent_from_camera @ camera_from_board = fixed_from_board`.
For a camera on the arm, `parent` is the gripper and `fixed` the robot base; for a fixed camera with
the board in the gripper, the reverse. Further unknowns with a Gaussian prior, the extras, change
every camera pose: intrinsics, the size of a square, a depth error that all images share.

Residuals are (translation, rotation vector) in the frame `fixed`, metres and radians.
"""

from collections.abc import Mapping
from dataclasses import field, replace
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

from evercal.classes import frozen_arrays
from evercal.geometry import SE3, cross_matrix, unit_vectors
from evercal.robot.pose_errors import SharedErrors
from evercal.typing import Array, BoolArray, IntArray, JsonObject, Strings


@frozen_arrays
class Unknowns:
    """X = `parent_from_camera`, Z = `fixed_from_board`, and the extras."""

    rotations: Array
    """(2, 3, 3) of X and Z."""
    translations: Array
    """(2, 3) of X and Z, metres."""
    extras: Array
    """(q,)."""

    @property
    def parent_from_camera(self) -> SE3:
        """The calibration."""
        return self._pose(0)

    @property
    def fixed_from_board(self) -> SE3:
        """Board pose in the fixed frame."""
        return self._pose(1)

    def _pose(self, row: int) -> SE3:
        rotation = Rotation.from_matrix(self.rotations[row])
        return SE3.of(rotation, self.translations[row])

    def moved(self, step: Array) -> "Unknowns":
        """Return the unknowns after a (12 + q,) step of (translation, rotation) of X, Z, extras."""
        poses = step[:12].reshape(2, 6)
        turn = Rotation.from_rotvec(poses[:, 3:]).as_matrix()
        return Unknowns(
            rotations=self.rotations @ turn,
            translations=self.translations + poses[:, :3],
            extras=self.extras + step[12:],
        )


@frozen_arrays
class Extras:
    """q further unknowns with a Gaussian prior; groups of them are independent."""

    names: Strings
    """(q,)."""
    groups: Strings
    """(q,) `intrinsics`, `shared depth`, `size` or `clock`."""
    slopes: Array
    """(n, 6, q) derivatives of `camera_from_board`; zero for a time offset."""
    information: Array
    """(q, q) inverse covariance of the prior; zero for an unknown without prior."""
    mean: Array
    """(q,)."""

    @classmethod
    def nothing(cls, n: int) -> Self:
        """No extras of n poses."""
        return cls(
            (),
            (),
            np.zeros((n, 6, 0)),
            np.zeros((0, 0)),
            np.zeros(0),
        )

    def with_one(
        self,
        name: str,
        slopes: Array,
        sigma: float,
    ) -> Self:
        """Add an unknown with slopes (n, 6), mean 0 and a standard deviation, which may be inf."""
        information = np.pad(self.information, (0, 1))
        information[-1, -1] = sigma**-2.0
        return replace(
            self,
            names=(*self.names, name),
            groups=(*self.groups, name),
            slopes=np.concatenate([self.slopes, slopes[:, :, None]], 2),
            information=information,
            mean=np.append(self.mean, 0.0),
        )

    def indices(self, group: str) -> IntArray:
        """Return the indices of a group."""
        return np.flatnonzero([name == group for name in self.groups])

    def without_prior(self, name: str) -> Self:
        """Free an unknown."""
        information = self.information.copy()
        k = self.names.index(name)
        information[k] = 0.0
        information[:, k] = 0.0
        return replace(self, information=information)


@frozen_arrays
class System:
    """The linear system of n poses at an estimate."""

    residual: Array
    """(n, 6)."""
    jacobian: Array
    """(n, 6, 12 + q)."""
    known: Array
    """(n, 6, 6) known covariance."""
    directions: dict[str, Array]
    """(n, 6, c) residuals due to unit errors of each kind of noise, by kind."""
    shared: dict[str, SharedErrors]
    """Residuals due to unit effects of each kind of errors that poses share, by kind."""
    prior: Array
    """(12 + q, 12 + q) information of the prior on the unknowns."""
    change: Array
    """(12 + q,) difference of the estimate from the mean of the prior."""


@frozen_arrays
class PoseEquation:
    """The n poses of one recording as plain arrays."""

    robot_rotation: Array
    """(n, 3, 3) of `fixed_from_parent`."""
    robot_translation: Array
    """(n, 3) metres."""
    camera_rotation: Array
    """(n, 3, 3) of `camera_from_board`."""
    camera_translation: Array
    """(n, 3) metres."""
    camera_covariance: Array
    """(n, 6, 6) known covariance of `camera_from_board`; zero if it is unknown."""
    extras: Extras
    base_is_fixed: bool = True
    """Whether `fixed` is the robot base and `parent` the gripper, not the reverse."""
    velocity: Array | None = None
    """(n, 6) velocity of the parent in the frame `fixed`, for the last extra `clock`: the time to
    add to a camera stamp."""
    shared: Mapping[str, SharedErrors] = field(default_factory=dict)
    """Kinds of errors of gripper poses that they share, by name."""

    def __getitem__(self, index: IntArray | BoolArray) -> Self:
        changed: JsonObject = {}
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                changed[name] = value[index]
        extras = replace(self.extras, slopes=self.extras.slopes[index])
        shared = {name: kind.of_rows(index) for name, kind in self.shared.items()}
        return replace(self, extras=extras, shared=shared, **changed)

    def __len__(self) -> int:
        return len(self.robot_translation)

    @property
    def unknowns(self) -> int:
        """Number of unknowns."""
        return 12 + len(self.extras.names)

    def system(self, at: Unknowns) -> System:
        """Linearize at an estimate."""
        n = len(self)
        change = self.extras.slopes @ at.extras
        board = self.camera_translation + change[:, :3]
        turned = self.camera_rotation @ Rotation.from_rotvec(change[:, 3:]).as_matrix()
        fixed_from_camera = self.robot_rotation @ at.rotations[0]
        # From the origin of the parent to the board.
        lever = (fixed_from_camera @ board[..., None])[..., 0]
        from_parent = self.robot_rotation @ at.translations[0]
        lever = lever + from_parent
        difference = fixed_from_camera @ turned @ at.rotations[1].T
        rotation = Rotation.from_matrix(difference, assume_valid=True).as_rotvec()
        shift = lever + self.robot_translation - at.translations[1]
        residual = np.concatenate([shift, rotation], 1)
        slope = _log_slope(rotation)
        jacobian = np.zeros((n, 6, self.unknowns))
        jacobian[:, :3, 0:3] = self.robot_rotation
        jacobian[:, :3, 3:6] = -fixed_from_camera @ cross_matrix(board)
        jacobian[:, 3:, 3:6] = slope @ fixed_from_camera
        jacobian[:, :3, 6:9] = -np.eye(3)
        jacobian[:, 3:, 9:12] = -slope.transpose(0, 2, 1) @ at.rotations[1]
        by_camera = np.zeros((n, 6, 6))
        by_camera[:, :3, :3] = fixed_from_camera
        by_camera[:, 3:, 3:] = fixed_from_camera @ turned
        jacobian[:, :, 12:] = by_camera @ self.extras.slopes
        jacobian[:, 3:, 12:] = slope @ jacobian[:, 3:, 12:]
        if self.velocity is not None and "clock" in self.extras.names:
            angular = self.velocity[:, 3:]
            jacobian[:, :3, -1] = self.velocity[:, :3] + np.cross(angular, lever)
            jacobian[:, 3:, -1] = (slope @ angular[..., None])[..., 0]
            residual = residual + at.extras[-1] * jacobian[:, :, -1]
        return System(
            residual=residual,
            jacobian=jacobian,
            known=by_camera @ self.camera_covariance @ by_camera.transpose(0, 2, 1),
            directions=self._noise_directions(at),
            shared=self._shared(at),
            prior=np.pad(self.extras.information, (12, 0)),
            change=np.r_[np.zeros(12), at.extras - self.extras.mean],
        )

    def viewing_rays(self, at: Unknowns) -> Array:
        """(n, 3) from the camera to the board, in the fixed frame."""
        camera = self.robot_translation + self.robot_rotation @ at.translations[0]
        return at.translations[1] - camera

    def _shared(self, at: Unknowns) -> dict[str, SharedErrors]:
        """Residuals due to unit effects; a fixed camera sees the gripper move the other way."""
        lever = np.broadcast_to(at.translations[1], (len(self), 3))
        axes = -np.broadcast_to(np.eye(3), (len(self), 3, 3))
        if self.base_is_fixed:
            lever = lever - self.robot_translation
            axes = self.robot_rotation
        by_gripper = np.zeros((len(self), 6, 6))
        by_gripper[:, :3, :3] = axes
        by_gripper[:, 3:, 3:] = axes
        by_gripper[:, :3, 3:] = -cross_matrix(lever) @ axes
        moved = {}
        for name, kind in self.shared.items():
            moved[name] = kind._replace(slopes=by_gripper @ kind.slopes)
        return moved

    def _noise_directions(
        self,
        at: Unknowns,
    ) -> dict[str, Array]:
        """Return (n, 6, c) residuals due to unit errors of each kind, one metre or one radian."""
        # A rotation about a distant point also moves the board. Corners tell a camera's noise.
        n = len(self)
        board = at.translations[1]
        parent = self.robot_translation
        gripper = np.zeros((n, 3))
        if self.base_is_fixed:
            gripper = parent
        directions = {
            "translation": np.broadcast_to(np.eye(6, 3), (n, 6, 3)),
            "rotation about gripper": _rotated(board - gripper),
        }
        if "intrinsics" not in self.extras.groups:
            depth = np.zeros((n, 6, 1))
            depth[:, :3, 0] = unit_vectors(self.viewing_rays(at), 1e-9)
            directions["depth"] = depth
            directions["rotation about board"] = _rotated(np.zeros((n, 3)))
        return directions


def _log_slope(rotvec: Array) -> Array:
    """Return the (n, 3, 3) derivative of a rotation vector by a small rotation on its left.

    A series of the inverse Jacobian of SO(3), accurate to 1e-4 up to one radian.
    """
    matrix = cross_matrix(rotvec)
    angle2 = (rotvec**2).sum(1)[:, None, None]
    series = 1 / 12 + angle2 / 720 + angle2**2 / 30240
    return np.eye(3) - 0.5 * matrix + series * (matrix @ matrix)


def _rotated(lever: Array) -> Array:
    """Return (n, 6, 3) residuals due to rotations about a point at `lever` (n, 3)."""
    identity = np.broadcast_to(np.eye(3), (len(lever), 3, 3))
    return np.concatenate([-cross_matrix(lever), identity], 1)
