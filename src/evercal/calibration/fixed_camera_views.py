"""Which wrist images would make a fixed camera's calibration better.

A fixed camera is located by landmarks of a map that wrist images made. Its error has three parts:
pixels of its own images, depths and host poses of the landmarks, and the base frame of the map,
which is the error of `gripper_from_camera`. A further wrist image shows some of these landmarks
again and reduces the latter two. The unknowns are, in this order, errors of the fixed camera's
pose, of X = gripper_from_camera, of each keyframe's pose about G X, and of the inverse depths.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.calibration import Calibration
from evercal.calibration.view_information import LEAST_POINTS, ViewNoise, pixel_slopes
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, UncertainPose, cross_matrix
from evercal.mapping.scene_map import SceneMap

Array = NDArray[np.floating]

MOST_LANDMARKS = 80
"""Landmarks that are used; the expected deviations are those of so many."""
MOST_TURN_DEG, MOST_ZOOM = 50.0, 2.2
"""A landmark is found again from a view that is turned and scaled at most so much."""
_LEAST_SIGMA_M, _LEAST_SIGMA_RAD = 2e-5, 2e-5


@dataclass(frozen=True, eq=False)
class HostedPoints:
    """Landmarks on the rays of their keyframes."""

    hosts: SE3
    """(m,) base_from_camera of the keyframes."""
    host: NDArray[np.integer]
    """(k,) keyframe of each landmark."""
    rays: Array
    """(k, 3) in the keyframe, z = 1."""
    inverse_depth: Array
    """(k,) per metre."""
    sigma: Array
    """(k,) standard deviation of the inverse depth, per metre."""

    def points_m(self) -> Array:
        """(k, 3) base frame."""
        return self.hosts[self.host].apply(self.rays / self.inverse_depth[:, None])

    def take(self, index: NDArray[np.integer]) -> "HostedPoints":
        """The landmarks of an index, of the same keyframes."""
        rays, depth, sigma = (p[index] for p in (self.rays, self.inverse_depth, self.sigma))
        return HostedPoints(self.hosts, self.host[index], rays, depth, sigma)

    def found_from(self, base_from_camera: SE3) -> NDArray[np.bool_]:
        """(k,) whether a camera at a pose sees a landmark much as its keyframe does."""
        points = self.points_m()
        before = points - self.hosts[self.host].translation_m
        now = points - base_from_camera.translation_m
        lengths = np.linalg.norm(before, axis=1), np.linalg.norm(now, axis=1)
        cosine = (before * now).sum(1) / np.maximum(lengths[0] * lengths[1], 1e-12)
        zoom = np.abs(np.log(np.maximum(lengths[0], 1e-9) / np.maximum(lengths[1], 1e-9)))
        return (cosine > np.cos(np.deg2rad(MOST_TURN_DEG))) & (zoom < np.log(MOST_ZOOM))

    @classmethod
    def of(cls, scene: SceneMap) -> Self:
        """All landmarks of a scene."""
        frames = scene.keyframes
        each = list(zip(frames.landmarks, frames.cameras, strict=True))
        return cls(
            frames.base_from_camera,
            np.repeat(np.arange(len(each)), [len(marks) for marks, _ in each]),
            np.concatenate([camera.unproject(marks.pixels) for marks, camera in each]),
            np.concatenate([marks.inverse_depth for marks, _ in each]).astype(float),
            np.concatenate([marks.sigma for marks, _ in each]).astype(float),
        )


@dataclass(frozen=True, eq=False)
class FixedCameraViews:
    """A fixed camera's calibration, and the map that it rests on. Create it with `of`."""

    information: Array
    """(N, N), see the file's description."""
    points: HostedPoints
    """Landmarks in the fixed camera's image."""
    gripper_from_camera: SE3
    """X, of the camera on the gripper."""
    camera: Camera
    """Intrinsics of the camera on the gripper."""
    noise: ViewNoise

    @property
    def target(self) -> slice:
        """The unknowns of the fixed camera's pose."""
        return slice(0, 6)

    @classmethod
    def of(
        cls,
        scene: SceneMap,
        calibration: Calibration,
        gripper_from_camera: UncertainPose,
        noise: ViewNoise | None = None,
    ) -> Self:
        """What a map and the images of a fixed camera determine.

        Args:
            scene: learned from wrist images.
            calibration: of a fixed camera in this scene, with its intrinsics.
            gripper_from_camera: of the camera that recorded the wrist images, as the map gave it.
            noise: of the gripper poses and of pixels at the working size of the map.

        Raises:
            InputError: Not a fixed camera, a map with a frame of its own, or too few landmarks.
        """
        noise = noise or ViewNoise()
        if calibration.mount != "eye_to_hand" or calibration.camera is None:
            raise InputError("next views need the calibration of a fixed camera with intrinsics")
        if scene.frame.similarity is not None:
            raise InputError(
                f"scene {scene.name}: has a frame of its own; next views need a scene that was"
                " learned from wrist images"
            )
        camera = scene.keyframes.cameras[0]
        own = calibration.camera.short_side_resized(min(camera.width, camera.height))
        pose = scene.frame.camera_among_points(calibration.parent_from_child)
        points = HostedPoints.of(scene)
        inside = np.zeros(len(points.rays), bool)
        inside[pixel_slopes(own, pose.inverse().apply(points.points_m()))[2]] = True
        index = np.flatnonzero(inside & points.found_from(pose))
        if len(index) < LEAST_POINTS:
            raise InputError(f"scene {scene.name}: the fixed camera sees {len(index)} landmarks")
        some = np.linspace(0, len(index) - 1, min(len(index), MOST_LANDMARKS)).round().astype(int)
        points = points.take(index[np.unique(some)])
        rough = gripper_from_camera.pose
        empty = cls(np.zeros((0, 0)), points, rough, camera, noise)
        prior = _prior(points, gripper_from_camera.covariance, scene.frame.pose_sigma)
        used = max(1, int(calibration.checks.get("images_used", 1)))
        seen = empty.seen_by_fixed(own, pose, noise.pixel_px / np.sqrt(used))
        return cls(prior + seen, points, rough, camera, noise)

    def added(self, base_from_gripper: SE3) -> Array:
        """(n, N, N) information that a wrist image at each of (n,) gripper poses adds."""
        to_camera = self.gripper_from_camera.inverse().adjoint()
        own = np.linalg.inv(to_camera @ self.noise.gripper @ to_camera.T)
        variance = self.noise.pixel_px**2
        size = 12 + 6 * len(self.points.hosts) + len(self.points.rays)
        added = np.zeros((len(base_from_gripper), size, size))
        for i, gripper in enumerate(base_from_gripper):
            jacobian, by_pose = self.wrist_jacobian(gripper)
            if len(by_pose) < LEAST_POINTS:
                continue
            rows, moved = jacobian.reshape(-1, size), by_pose.reshape(-1, 6)
            # The image's own pose is eliminated: its prior is the stated gripper pose.
            mixed = moved.T @ rows
            left = np.linalg.solve(variance * own + moved.T @ moved, mixed)
            added[i] = (rows.T @ rows - mixed.T @ left) / variance
        return added

    def wrist_jacobian(self, base_from_gripper: SE3) -> tuple[Array, Array]:
        """Derivatives of the pixels of the v visible landmarks in a wrist image.

        Returns:
            (v, 2, N) by the unknowns, and (v, 2, 6) by a tangent on the right of the image's own
            pose.
        """
        pose = base_from_gripper @ self.gripper_from_camera
        by_pose, jacobian = self._rows(self.camera, pose)
        mounted = np.eye(6)
        mounted[:3, :3] = self.gripper_from_camera.rotation_matrix().T
        jacobian[:, :, 6:12] += by_pose @ mounted
        return jacobian, by_pose

    def seen_by_fixed(self, camera: Camera, base_from_camera: SE3, pixel_px: float) -> Array:
        """(N, N) information of the fixed camera's own images."""
        by_pose, jacobian = self._rows(camera, base_from_camera)
        turned = np.eye(6)
        turned[:3, :3] = base_from_camera.rotation_matrix().T
        jacobian[:, :, :6] = by_pose @ turned
        rows = jacobian.reshape(-1, jacobian.shape[2]) / pixel_px
        return rows.T @ rows

    def _rows(self, camera: Camera, pose: SE3) -> tuple[Array, Array]:
        """Derivatives by the camera's pose (v, 2, 6), and by hosts and depths (v, 2, N)."""
        points = self.points
        inside = pose.inverse().apply(points.points_m())
        by_pose, by_point, visible = pixel_slopes(camera, inside)
        found = points.found_from(pose)[visible]
        by_pose, by_point, visible = by_pose[found], by_point[found], visible[found]
        host, ray = points.host[visible], points.rays[visible]
        local = ray / points.inverse_depth[visible, None]
        by_local = by_point @ pose.rotation_matrix().T @ points.hosts[host].rotation_matrix()
        by_host = np.concatenate([by_local, -by_local @ cross_matrix(local)], 2)
        by_depth = -np.einsum("vij,vj->vi", by_local, local) / points.inverse_depth[visible, None]
        hosts, count = len(points.hosts), len(visible)
        jacobian = np.zeros((count, 2, 12 + 6 * hosts + len(points.rays)))
        mounted = np.eye(6)
        mounted[:3, :3] = self.gripper_from_camera.rotation_matrix().T
        # Keyframes are wrist images, too: an error of X moves all of them.
        jacobian[:, :, 6:12] = by_host @ mounted
        for i in range(6):
            jacobian[np.arange(count), :, 12 + 6 * host + i] = by_host[:, :, i]
        jacobian[np.arange(count), :, 12 + 6 * hosts + visible] = by_depth
        return by_pose, jacobian


def _prior(points: HostedPoints, mount: Array, pose_sigma: tuple[float, float]) -> Array:
    """(N, N) information of the map: X, poses of keyframes, depths; the fixed camera is open."""
    hosts = len(points.hosts)
    metres, radians = max(pose_sigma[0], _LEAST_SIGMA_M), max(pose_sigma[1], _LEAST_SIGMA_RAD)
    information = np.zeros((12 + 6 * hosts + len(points.rays),) * 2)
    information[:6, :6] = np.diag(np.repeat([1.0, np.pi], 3) ** -2.0)
    information[6:12, 6:12] = np.linalg.inv(mount)
    own = np.tile(np.repeat([metres, radians], 3), hosts)
    diagonal = np.concatenate([own**-2.0, np.maximum(points.sigma, 1e-6) ** -2.0])
    information[12:, 12:] = np.diag(diagonal)
    return information
