"""The gripper poses whose images reduce the uncertainty of a calibration most, for both mounts.

Every further image adds to the information on the unknowns. The pose that lowers the mean variance
of a point in front of the camera most is proposed, then the next one (A-optimality).

**Camera on the gripper.** A view has a stated gripper pose G and a measured camera pose C in the
scene. With X = gripper_from_camera and Z = base_from_scene, G X = Z C. The residual
log((G X)^-1 Z C) is a tangent of the camera frame, and to first order

    r = - (R_X^T dt, dr) + Ad(C^-1) dz - (m, 0) ds - Ad(X^-1) g + c.

(dt, dr) is the error of X in the convention of `UncertainPose`, dz that of Z on its right, g and c
the noise of the gripper and the camera pose, each on the right of its pose. Z is unknown, so X is
seen only in differences between views: rotations about two axes are needed. ds is the relative
error of the scene's scale, which images do not show, and m the position of the scene in the camera
frame: where the arm orbits one place, m hardly changes, and X is open in its direction.

**Fixed camera.** It is located by landmarks of a map that wrist images made. A further wrist image
shows some of them again. The unknowns are, in this order, errors of the fixed camera's pose, of X,
of each keyframe's pose about G X, and of the inverse depths.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.calibration import Calibration
from evercal.errors import InputError
from evercal.geometry import (
    SE3,
    Camera,
    UncertainPose,
    axis_deviation,
    cross_matrix,
    pose_distance,
)
from evercal.localization.pose_refinement import linearise
from evercal.mapping.scene_map import SceneMap
from evercal.recordings.frame import MIN_GRIPPER_FRAMES

Array = NDArray[np.floating]


def _covariance(metres: float, radians: float) -> Array:
    return np.diag(np.repeat([metres, radians], 3) ** 2)


GRIPPER_NOISE = _covariance(0.1e-3, np.deg2rad(0.02))
"""(6, 6) covariance of a gripper pose about the stated one."""
CAMERA_NOISE = _covariance(0.3e-3, np.deg2rad(0.03))
"""(6, 6) covariance of a camera pose that an image gives, in the scene."""
PIXEL_PX = 0.3
"""Standard deviation of a landmark in an image."""
_ROUGH, _UNKNOWN = _covariance(0.05, np.deg2rad(15.0)), _covariance(0.2, np.pi)
"""Of a `gripper_from_camera` that is roughly known, and of one that is not."""
_ANYWHERE = _covariance(1.0, np.pi)
"""Of the pose of the scene, or of a fixed camera, before any image."""
_ANY_SCALE = 1.0
"""Relative standard deviation of the scale of the scene before any image."""
_OPEN = 1.5
"""A direction is open if a few images would divide its standard deviation by this: by 7 and 2 for a
KUKA and a Panda that orbit a board, by 1.04 for the packaged cell."""
_ADDED, _STEP, _STEPS_M, _TURN_DEG = 4, 0.25, (0.03, 0.2), 15.0
"""Images of a motion that may close it; its size, in distances of the scene, with bounds."""
_AT_M, _AHEAD_M = 0.3, 0.5
"""Distance of the point whose variance counts; distance of the scene before parallel cameras."""
_APART_M, _APART_DEG = 0.02, 4.0
"""Poses nearer than both are the same one: errors of an arm repeat where its pose does."""
MOST_LANDMARKS, LEAST_LANDMARKS = 80, 12
"""Maximum number of landmarks of a fixed camera, and minimum that a view must show."""
MOST_TURN_DEG, MOST_ZOOM = 50.0, 2.2
"""Maximum change of viewing angle and scale at which a landmark is matched."""
_LEAST_SIGMA_M, _LEAST_SIGMA_RAD = 2e-5, 2e-5
"""Least standard deviations of the pose of a keyframe."""


@dataclass(frozen=True, eq=False)
class NextViews:
    """Poses to go to, in order."""

    index: NDArray[np.int64]
    """(k,) index among the reachable poses."""
    poses: SE3
    """(k,) base_from_gripper."""
    sigma_mm: tuple[float, ...]
    """(k + 1,) expected standard deviation per axis: now, and after each pose."""
    sigma_deg: tuple[float, ...]


def next_views(
    recorded: SE3,
    reachable: SE3,
    count: int = 1,
    gripper_from_camera: SE3 | None = None,
    excluded: SE3 | None = None,
) -> NextViews:
    """Choose the next gripper poses for `gripper_from_camera`.

    Args:
        recorded: (m,) base_from_gripper of the images so far.
        reachable: (n,) base_from_gripper that the arm can go to.
        count: Largest number of poses; fewer if no other pose adds information.
        gripper_from_camera: A rough one. Default: unknown.
        excluded: Poses that are not proposed. Default: those recorded.
    """
    mount = gripper_from_camera or SE3.identity()
    scene_m = looked_at(recorded @ mount)
    known = _known(recorded, gripper_from_camera, scene_m)
    added = wrist_information(reachable, mount, scene_m)
    return _chosen(known, added, reachable, count, recorded if excluded is None else excluded)


@dataclass(frozen=True)
class OpenPosition:
    """The direction in which the motions of a recording leave `gripper_from_camera` open."""

    direction: tuple[float, float, float]
    """Unit vector in the gripper frame."""
    sigma_mm: float
    """Expected standard deviation along it."""
    across_mm: float
    """The largest one across it."""
    motion: str
    """Further images that reduce it most."""
    then_mm: float
    """Largest expected standard deviation with them."""
    scale_percent: float
    """Expected standard deviation of the scale of the scene."""

    def sentence(self, stated_mm: float | None = None) -> str:
        """What to do; by default with the expected standard deviation, or with a stated one."""
        times = 1.0 if stated_mm is None else stated_mm / self.sigma_mm
        along = ", ".join(f"{value:+.2f}" for value in self.direction)
        now, across, then = (times * s for s in (self.sigma_mm, self.across_mm, self.then_mm))
        return (
            f"the motions leave the position along ({along}) of the gripper open: standard"
            f" deviation {now:.1f} mm, {across:.1f} mm across; {_ADDED} more images {self.motion}"
            f" would give about {then:.1f} mm"
        )


def open_position(recorded: SE3, gripper_from_camera: SE3 | None = None) -> OpenPosition | None:
    """The direction that (m,) recorded base_from_gripper leave open, and how to close it.

    None if a few images would improve it little. Without a rough `gripper_from_camera`, distances
    of the scene are from the gripper.
    """
    if len(recorded) < MIN_GRIPPER_FRAMES:
        return None
    mount = gripper_from_camera or SE3.identity()
    scene_m = looked_at(recorded @ mount)
    known = _known(recorded, gripper_from_camera, scene_m)
    covariance = np.linalg.inv(known)
    variances, axes = np.linalg.eigh(covariance[:3, :3])
    along, sigmas = axes[:, 2], 1000 * np.sqrt(variances)
    # An error of the scale moves X as far as the scene is away.
    away_m = np.linalg.norm(covariance[:3, 12]) / covariance[12, 12]
    step_m = float(np.clip(_STEP * away_m, *_STEPS_M))
    shift = step_m * np.pad(np.stack([along, axes[:, 0], axes[:, 1]]), ((0, 0), (0, 3)))
    turn = np.deg2rad(_TURN_DEG) * np.pad(axes[:, :2].T, ((0, 0), (3, 0)))
    motions = {
        f"{100 * step_m:.0f} cm nearer and farther": shift[[0, 0]],
        f"{100 * step_m:.0f} cm aside without turning": shift[1:],
        f"turned by {_TURN_DEG:.0f} deg in place": turn,
    }
    some = recorded[np.linspace(0, len(recorded) - 1, _ADDED).round().astype(int)]
    then = {}
    for words, steps in motions.items():
        moved = some @ SE3.exp(np.concatenate([steps, -steps]))
        more = _of_six(known + wrist_information(moved, mount, scene_m).sum(0))
        then[words] = 1000 * float(np.sqrt(np.linalg.eigvalsh(more[:3, :3])[-1]))
    best = min(then, key=then.__getitem__)
    if sigmas[2] < _OPEN * then[best]:
        return None
    (x, y, z), percent = along.tolist(), 100 * float(np.sqrt(covariance[12, 12]))
    return OpenPosition((x, y, z), float(sigmas[2]), float(sigmas[1]), best, then[best], percent)


def _known(recorded: SE3, gripper_from_camera: SE3 | None, scene_m: Array) -> Array:
    """(13, 13) information about X, Z and the scale of the scene."""
    mount, known = gripper_from_camera or SE3.identity(), np.zeros((13, 13))
    known[:6, :6] = np.linalg.inv(_UNKNOWN if gripper_from_camera is None else _ROUGH)
    known[6:12, 6:12] = np.linalg.inv(_ANYWHERE)
    known[12, 12] = _ANY_SCALE**-2
    return known + wrist_information(recorded, mount, scene_m).sum(0)


def next_views_of_fixed_camera(
    scene: SceneMap,
    calibration: Calibration,
    gripper_from_camera: UncertainPose,
    reachable: SE3,
    count: int = 1,
    excluded: SE3 | None = None,
) -> NextViews:
    """Choose the next poses of the arm whose wrist images improve a fixed camera's calibration.

    Args:
        scene: Learned from wrist images.
        calibration: Of a fixed camera in this scene, with its intrinsics.
        gripper_from_camera: Of the camera that recorded the wrist images, as the map gave it.
        reachable: (n,) base_from_gripper that the arm can go to.
        count: Largest number of poses; fewer if no other pose adds information.
        excluded: Poses that are not proposed, such as those recorded.
    """
    if calibration.mount != "eye_to_hand" or calibration.camera is None:
        raise InputError("next views need the calibration of a fixed camera with intrinsics")
    if scene.frame.similarity is not None:
        raise InputError(
            f"scene {scene.name}: has a frame of its own; next views need a scene that was"
            " learned from wrist images"
        )
    pose = scene.frame.camera_among_points(calibration.parent_from_child)
    every = HostedLandmarks.of(scene, gripper_from_camera.pose)
    camera = calibration.camera.short_side_resized(min(every.camera.width, every.camera.height))
    seen = every.visible(camera, pose)
    if len(seen) < LEAST_LANDMARKS:
        raise InputError(f"scene {scene.name}: the fixed camera sees {len(seen)} landmarks")
    some = np.linspace(0, len(seen) - 1, min(len(seen), MOST_LANDMARKS)).round().astype(int)
    landmarks = every.take(seen[some])
    images = max(1, int(calibration.checks.get("images_used", 1)))
    known = landmarks.prior(gripper_from_camera.covariance, scene.frame.pose_sigma)
    known += landmarks.by_fixed_camera(camera, pose, PIXEL_PX / np.sqrt(images))
    return _chosen(known, landmarks.by_wrist_image(reachable), reachable, count, excluded)


def _chosen(
    known: Array, added: Array, reachable: SE3, count: int, excluded: SE3 | None
) -> NextViews:
    """Greedy choice by information `added` (n, N, N) to `known` (N, N); the first six matter."""
    if not len(reachable):
        raise InputError("no reachable poses; give at least one pose that the arm can go to")
    free = np.trace(added, axis1=1, axis2=2) > 0
    for pose in excluded if excluded is not None else ():
        free &= ~_near(pose, reachable)
    chosen: list[int] = []
    sigmas = [axis_deviation(_of_six(known))]
    while len(chosen) < count and free.any():
        rows = np.flatnonzero(free)
        covariances = _of_six(known + added[rows])
        variances = np.diagonal(covariances, axis1=1, axis2=2)
        # A rotation about either axis across the viewing direction moves a point ahead.
        cost = variances[:, :3].sum(1) + _AT_M**2 * variances[:, 3:].sum(1)
        best = int(np.argmin(cost))
        chosen.append(int(rows[best]))
        sigmas.append(axis_deviation(covariances[best]))
        known = known + added[chosen[-1]]
        free &= ~_near(reachable[chosen[-1]], reachable)
    index = np.array(chosen, np.int64)
    millimetres, degrees = zip(*sigmas, strict=True)
    return NextViews(index, reachable[index], millimetres, degrees)


def _of_six(information: Array) -> Array:
    return np.linalg.solve(information, np.eye(information.shape[-1])[:, :6])[..., :6, :]


def _near(pose: SE3, others: SE3) -> NDArray[np.bool_]:
    metres, radians = pose_distance(pose, others)
    return np.less(metres, _APART_M) & np.less(radians, np.deg2rad(_APART_DEG))


def looked_at(base_from_camera: SE3) -> Array:
    """The point (3,) nearest to the optical axes of (n,) cameras, or ahead of parallel ones."""
    axes = base_from_camera.rotation_matrix()[..., 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    ahead = (base_from_camera.translation_m + _AHEAD_M * axes).mean(0)
    # A weak pull towards that point decides where the axes do not.
    weight = 1e-3 * len(axes) * np.eye(3)
    right = np.einsum("nij,nj->i", across, base_from_camera.translation_m) + weight @ ahead
    return np.linalg.solve(across.sum(0) + weight, right)


def wrist_information(base_from_gripper: SE3, mount: SE3, scene_m: Array) -> Array:
    """(n, 13, 13) information about X, Z and scale that an image at (n,) gripper poses adds."""
    jacobian = wrist_jacobian(base_from_gripper, mount, scene_m)
    to_camera = mount.inverse().adjoint()
    weight = np.linalg.inv(to_camera @ GRIPPER_NOISE @ to_camera.T + CAMERA_NOISE)
    return np.swapaxes(jacobian, 1, 2) @ weight @ jacobian


def wrist_jacobian(base_from_gripper: SE3, mount: SE3, scene_m: Array) -> Array:
    """(n, 6, 13) derivatives of residuals by errors of X, of Z and scale about `scene_m` (3,)."""
    camera_from_scene = (base_from_gripper @ mount).inverse() @ SE3.from_translation(scene_m)
    jacobian = np.zeros((len(base_from_gripper), 6, 13))
    jacobian[:, :, :6] = -_of_mount(mount)
    jacobian[:, :, 6:12] = camera_from_scene.adjoint()
    jacobian[:, :3, 12] = -camera_from_scene.translation_m
    return jacobian


def _of_mount(pose: SE3) -> Array:
    turned = np.eye(6)
    turned[:3, :3] = pose.rotation_matrix().T
    return turned


@dataclass(frozen=True, eq=False)
class HostedLandmarks:
    """Landmarks on the rays of their keyframes, which a camera on the gripper recorded."""

    mount: SE3
    camera: Camera
    """Intrinsics of the camera on the gripper, whose `mount` is X."""
    hosts: SE3
    """(m,) base_from_camera of the keyframes."""
    host: NDArray[np.integer]
    """(k,) keyframe of each landmark."""
    rays: Array
    """(k, 3) in the keyframe, z = 1."""
    inverse_depth: Array
    """(k,) per metre, with the standard deviation `sigma` (k,)."""
    sigma: Array

    @classmethod
    def of(cls, scene: SceneMap, mount: SE3) -> Self:
        """All landmarks of a scene."""
        frames = scene.keyframes
        each = list(zip(frames.landmarks, frames.cameras, strict=True))
        return cls(
            mount,
            frames.cameras[0],
            frames.base_from_camera,
            np.repeat(np.arange(len(each)), [len(marks) for marks, _ in each]),
            np.concatenate([camera.unproject(marks.pixels) for marks, camera in each]),
            np.concatenate([marks.inverse_depth for marks, _ in each]).astype(float),
            np.concatenate([marks.sigma for marks, _ in each]).astype(float),
        )

    def take(self, index: NDArray[np.integer]) -> Self:
        """The landmarks of an index, of the same keyframes."""
        rays, depth, sigma = (p[index] for p in (self.rays, self.inverse_depth, self.sigma))
        return type(self)(self.mount, self.camera, self.hosts, self.host[index], rays, depth, sigma)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return 12 + 6 * len(self.hosts) + len(self.rays)

    @property
    def points_m(self) -> Array:
        """(k, 3) base frame."""
        return self.hosts[self.host].apply(self.rays / self.inverse_depth[:, None])

    def visible(self, camera: Camera, base_from_camera: SE3) -> NDArray[np.int64]:
        """Indices of the landmarks that a camera sees much as their keyframes do."""
        pixels = camera.project(base_from_camera.inverse().apply(self.points_m))
        with np.errstate(invalid="ignore"):
            inside = ((pixels >= 0) & (pixels <= (camera.width - 1, camera.height - 1))).all(1)
        before = self.points_m - self.hosts[self.host].translation_m
        now = self.points_m - base_from_camera.translation_m
        lengths = np.linalg.norm([before, now], axis=2)
        cosine = (before * now).sum(1) / np.maximum(lengths.prod(0), 1e-12)
        zoom = np.abs(np.subtract(*np.log(np.maximum(lengths, 1e-9))))
        alike = (cosine > np.cos(np.deg2rad(MOST_TURN_DEG))) & (zoom < np.log(MOST_ZOOM))
        return np.flatnonzero(inside & alike)

    def prior(self, mount_covariance: Array, pose_sigma: tuple[float, float]) -> Array:
        """(N, N) information of the map; the fixed camera's pose is open."""
        sigma = np.maximum(pose_sigma, (_LEAST_SIGMA_M, _LEAST_SIGMA_RAD))
        own = np.tile(np.repeat(sigma, 3), len(self.hosts))
        information = np.zeros((self.size, self.size))
        information[:6, :6] = np.linalg.inv(_ANYWHERE)
        information[6:12, 6:12] = np.linalg.inv(mount_covariance)
        diagonal = np.concatenate([own, np.maximum(self.sigma, 1e-6)]) ** -2.0
        information[12:, 12:] = np.diag(diagonal)
        return information

    def by_fixed_camera(self, camera: Camera, base_from_camera: SE3, pixel_px: float) -> Array:
        """(N, N) information of the fixed camera's own images."""
        by_pose, jacobian = self._derivatives(camera, base_from_camera)
        jacobian[:, :, :6] = by_pose @ _of_mount(base_from_camera)
        rows = jacobian.reshape(-1, self.size) / pixel_px
        return rows.T @ rows

    def by_wrist_image(self, base_from_gripper: SE3) -> Array:
        """(n, N, N) information that a wrist image at each of (n,) gripper poses adds."""
        to_camera = self.mount.inverse().adjoint()
        own = np.linalg.inv(to_camera @ GRIPPER_NOISE @ to_camera.T)
        added = np.zeros((len(base_from_gripper), self.size, self.size))
        for i, gripper in enumerate(base_from_gripper):
            by_pose, jacobian = self.of_wrist_image(gripper)
            if len(by_pose) < LEAST_LANDMARKS:
                continue
            rows, moved = jacobian.reshape(-1, self.size), by_pose.reshape(-1, 6)
            # The image's own pose is eliminated: its prior is the stated gripper pose.
            mixed = moved.T @ rows
            left = np.linalg.solve(PIXEL_PX**2 * own + moved.T @ moved, mixed)
            added[i] = (rows.T @ rows - mixed.T @ left) / PIXEL_PX**2
        return added

    def of_wrist_image(self, base_from_gripper: SE3) -> tuple[Array, Array]:
        """Derivatives of v visible pixels by the image's own pose (v, 2, 6) and the unknowns."""
        by_pose, jacobian = self._derivatives(self.camera, base_from_gripper @ self.mount)
        jacobian[:, :, 6:12] += by_pose @ _of_mount(self.mount)
        return by_pose, jacobian

    def _derivatives(self, camera: Camera, pose: SE3) -> tuple[Array, Array]:
        """By the camera's pose (v, 2, 6), and by keyframes and depths (v, 2, N)."""
        visible = self.visible(camera, pose)
        at = self.points_m[visible], pose.rotation_matrix(), pose.translation_m
        by_pose = linearise(np.zeros((len(visible), 2)), *at, camera)[1].transpose(2, 1, 0)
        host, depth = self.host[visible], self.inverse_depth[visible, None]
        local = self.rays[visible] / depth
        # A motion of the camera moves its points the other way.
        by_point = -by_pose[:, :, :3] @ pose.rotation_matrix().T
        by_local = by_point @ self.hosts[host].rotation_matrix()
        by_host = np.concatenate([by_local, -by_local @ cross_matrix(local)], 2)
        hosts, row = len(self.hosts), np.arange(len(visible))
        jacobian = np.zeros((len(visible), 2, self.size))
        # Keyframes are wrist images, too: an error of X moves all of them.
        jacobian[:, :, 6:12] = by_host @ _of_mount(self.mount)
        for i in range(6):
            jacobian[row, :, 12 + 6 * host + i] = by_host[:, :, i]
        by_depth = -np.einsum("vij,vj->vi", by_local, local) / depth
        jacobian[row, :, 12 + 6 * hosts + visible] = by_depth
        return by_pose, jacobian
