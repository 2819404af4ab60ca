"""What an image of a camera on the gripper adds to what is known: information matrices.

A view i has a stated gripper pose G and a measured camera pose C in the scene. With
X = gripper_from_camera and Z = base_from_scene, G X = Z C. The residual log((G X)^-1 Z C) is a
tangent of the camera frame, and to first order

    r = - (R_X^T dt, dr) + Ad(C^-1) dz - Ad(X^-1) g + c.

(dt, dr) is the error of X in the convention of `UncertainPose`, dz that of Z on its right, g the
noise of the gripper pose and c that of the camera pose, each on the right of its pose. With J the
derivative by the unknowns and S = Ad(X^-1) S_g Ad(X^-1)^T + S_c, a view adds J^T S^-1 J. Z is
unknown, so X is seen only in differences between views. Without rotation, Ad(C^-1) has the same
rotation in all of them and the position of X cancels; with rotation about one axis, its part along
the axis cancels (Tsai and Lenz, IEEE T-RA 1989).
"""

from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from evercal.geometry import SE3, Camera, UncertainPose, cross_matrix

Array = NDArray[np.floating]

ROUGH_M, ROUGH_RAD = 0.05, np.deg2rad(15.0)
"""Standard deviation of a `gripper_from_camera` that is stated without covariance, per axis."""
_FAR_M, _ANY_RAD = 1.0, np.pi
"""Standard deviation of the pose of the scene before any image."""
_AHEAD_M = 0.5
"""Distance of the scene where the viewing directions do not show it."""
LEAST_POINTS = 12
"""Points of the scene that a view must show to count."""


@dataclass(frozen=True)
class ViewNoise:
    """Standard deviations per axis."""

    gripper_mm: float = 0.1
    """Position of the gripper about the stated one."""
    gripper_deg: float = 0.02
    """Rotation of the gripper about the stated one."""
    camera_mm: float = 0.3
    """Position of the camera that an image gives, in the scene."""
    camera_deg: float = 0.03
    """Rotation of the camera that an image gives."""
    pixel_px: float = 0.3
    """Position of a point in an image, where points of the scene are known."""

    @property
    def gripper(self) -> Array:
        """(6, 6) covariance of a stated gripper pose, metres and radians."""
        return _diagonal(self.gripper_mm, self.gripper_deg)

    @property
    def camera(self) -> Array:
        """(6, 6) covariance of a camera pose from an image, metres and radians."""
        return _diagonal(self.camera_mm, self.camera_deg)


class ViewModel(Protocol):
    """What is known so far, as N normal equations, and what further views would add."""

    @property
    def information(self) -> Array:
        """(N, N) positive definite."""
        ...

    @property
    def target(self) -> slice:
        """The six unknowns that matter."""
        ...

    def added(self, base_from_gripper: SE3) -> Array:
        """(n, N, N) information that an image at each of (n,) gripper poses adds."""
        ...


@dataclass(frozen=True, eq=False)
class ScenePoints:
    """Points of the scene, which decide how well an image determines its pose."""

    camera: Camera
    points_m: Array
    """(k, 3) base frame."""

    def pose_information(self, base_from_camera: SE3, pixel_px: float) -> Array:
        """(n, 6, 6) information of camera poses from the points they show; zero for too few."""
        information = np.zeros((len(base_from_camera), 6, 6))
        for i, pose in enumerate(base_from_camera):
            slopes = pixel_slopes(self.camera, pose.inverse().apply(self.points_m))[0]
            if len(slopes) >= LEAST_POINTS:
                information[i] = np.einsum("kij,kil->jl", slopes, slopes) / pixel_px**2
        return information


@dataclass(frozen=True, eq=False)
class HandEyeViews:
    """A wrist recording in progress: X and Z from pairs of gripper and camera poses.

    Create one with `HandEyeViews.start`, and add the recorded poses by `with_views`.
    """

    information: Array
    """(12, 12) of X and Z."""
    gripper_from_camera: SE3
    """Rough X, at which the equations are linearised."""
    base_from_scene: SE3
    """Z; it only fixes the point about which the scene rotates."""
    noise: ViewNoise
    points: ScenePoints | None = None

    @property
    def target(self) -> slice:
        """The unknowns of X."""
        return slice(0, 6)

    @property
    def estimate(self) -> UncertainPose:
        """Rough X with the covariance that the views so far should give."""
        covariance = np.linalg.inv(self.information)[self.target, self.target]
        return UncertainPose(self.gripper_from_camera, np.asarray(covariance, np.float64))

    @classmethod
    def start(
        cls,
        gripper_from_camera: UncertainPose | SE3,
        scene_m: Array,
        noise: ViewNoise | None = None,
        points: ScenePoints | None = None,
    ) -> Self:
        """What is known before the first image.

        Args:
            gripper_from_camera: a rough one. A plain pose counts as known to 5 cm and 15 deg.
            scene_m: (3,) a point that the camera sees, base frame.
            noise: of gripper and camera poses.
            points: points of the scene. If omitted, every view is as exact as `noise` states.
        """
        rough = gripper_from_camera
        if isinstance(rough, SE3):
            rough = UncertainPose(rough, np.diag(np.repeat([ROUGH_M, ROUGH_RAD], 3) ** 2))
        information = np.zeros((12, 12))
        information[:6, :6] = np.linalg.inv(rough.covariance)
        information[6:, 6:] = np.diag(np.repeat([_FAR_M, _ANY_RAD], 3) ** -2.0)
        scene = SE3.from_translation(np.asarray(scene_m, float))
        return cls(information, rough.pose, scene, noise or ViewNoise(), points)

    @classmethod
    def recorded(
        cls,
        base_from_gripper: SE3,
        gripper_from_camera: UncertainPose | SE3 | None = None,
        noise: ViewNoise | None = None,
    ) -> Self:
        """What images at (m,) gripper poses should determine.

        Args:
            base_from_gripper: of the images.
            gripper_from_camera: a rough one. Default: the camera at the gripper's origin.
            noise: of gripper and camera poses.
        """
        rough = gripper_from_camera
        if rough is None:
            rough = UncertainPose(SE3.identity(), np.diag(np.repeat([0.2, np.pi], 3) ** 2))
        pose = rough.pose if isinstance(rough, UncertainPose) else rough
        start = cls.start(rough, looked_at(base_from_gripper @ pose), noise)
        return start.with_views(base_from_gripper)

    def with_views(self, base_from_gripper: SE3) -> Self:
        """After images at (n,) gripper poses."""
        added = self.added(base_from_gripper).sum(0)
        return replace(self, information=self.information + added)

    def added(self, base_from_gripper: SE3) -> Array:
        """(n, 12, 12) information that an image at each of (n,) gripper poses adds."""
        jacobian = self.jacobian(base_from_gripper)
        return np.swapaxes(jacobian, 1, 2) @ self.weights(base_from_gripper) @ jacobian

    def jacobian(self, base_from_gripper: SE3) -> Array:
        """(n, 6, 12) derivatives of the residuals by the errors of X and Z."""
        camera_from_scene = self._cameras(base_from_gripper).inverse() @ self.base_from_scene
        jacobian = np.zeros((len(base_from_gripper), 6, 12))
        jacobian[:, :3, :3] = -self.gripper_from_camera.rotation_matrix().T
        jacobian[:, 3:, 3:6] = -np.eye(3)
        jacobian[:, :, 6:] = camera_from_scene.adjoint()
        return jacobian

    def weights(self, base_from_gripper: SE3) -> Array:
        """(n, 6, 6) inverse covariance of the residuals; zero for a view without the scene."""
        to_camera = self.gripper_from_camera.inverse().adjoint()
        robot = to_camera @ self.noise.gripper @ to_camera.T
        image = np.broadcast_to(self.noise.camera, (len(base_from_gripper), 6, 6))
        if self.points is None:
            return np.linalg.inv(robot + image)
        cameras = self._cameras(base_from_gripper)
        known = self.points.pose_information(cameras, self.noise.pixel_px)
        sees = np.trace(known, axis1=1, axis2=2) > 0
        weights = np.zeros((len(cameras), 6, 6))
        weights[sees] = np.linalg.inv(robot + image[sees] + np.linalg.inv(known[sees]))
        return weights

    def _cameras(self, base_from_gripper: SE3) -> SE3:
        return base_from_gripper @ self.gripper_from_camera


def looked_at(base_from_camera: SE3) -> Array:
    """The point (3,) nearest to the optical axes of (n,) cameras, base frame.

    For parallel axes it lies half a metre ahead of them.
    """
    axes = base_from_camera.rotation_matrix()[..., 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    ahead = (base_from_camera.translation_m + _AHEAD_M * axes).mean(0)
    # A weak pull towards that point decides where the axes do not.
    weight = 1e-3 * len(axes) * np.eye(3)
    right = np.einsum("nij,nj->i", across, base_from_camera.translation_m) + weight @ ahead
    return np.linalg.solve(across.sum(0) + weight, right)


def pixel_slopes(camera: Camera, points_camera: Array) -> tuple[Array, Array, NDArray[np.integer]]:
    """Derivatives of pixels by the camera's pose, of the visible ones among (k, 3) points.

    Returns:
        (v, 2, 6) by a tangent on the right of the camera's pose, (v, 2, 3) by the point in the
        camera frame, and (v,) the indices of the visible points.
    """
    pixels = camera.project(points_camera)
    size = (camera.width - 1, camera.height - 1)
    with np.errstate(invalid="ignore"):
        visible = np.flatnonzero(((pixels >= 0) & (pixels <= size)).all(1))
    points = points_camera[visible]
    plane = points[:, :2] / points[:, 2:]
    to_plane = np.zeros((len(points), 2, 3))
    to_plane[:, 0, 0] = to_plane[:, 1, 1] = 1 / points[:, 2]
    to_plane[:, :, 2] = -plane / points[:, 2:]
    by_point = camera.slopes(plane)[0] @ to_plane
    by_pose = np.concatenate([-by_point, by_point @ cross_matrix(points)], 2)
    return by_pose, by_point, visible


def _diagonal(millimetres: float, degrees: float) -> Array:
    return np.diag(np.repeat([millimetres / 1000, np.deg2rad(degrees)], 3) ** 2)
