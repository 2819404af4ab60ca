"""The gripper poses whose images reduce the uncertainty of `gripper_from_camera` most.

Every further image adds to the information on the unknowns. The pose that lowers the mean variance
of a point in front of the camera most is proposed, then the next one (A-optimality).

A view has a stated gripper pose G and a measured camera pose C in the
scene. With X = gripper_from_camera and Z = base_from_scene, G X = Z C. The residual
log((G X)^-1 Z C) is a tangent of the camera frame, and to first order

    r = - (R_X^T dt, dr) + Ad(C^-1) dz - (m, 0) ds - Ad(X^-1) g + c.

(dt, dr) is the error of X in the convention of `UncertainPose`, dz that of Z on its right, g and c
the noise of the gripper and the camera pose, each on the right of its pose. Z is unknown, so X is
seen only in differences between views: rotations about two axes are needed. ds is the relative
error of the scene's scale, which images do not show, and m the position of the scene in the camera
frame: where the arm orbits one place, m hardly changes, and X is open in its direction.
"""

import numpy as np

from evercal.classes import frozen, frozen_arrays
from evercal.errors import InputError
from evercal.geometry import (
    SE3,
    axis_deviation,
    pose_distance,
    spread,
)
from evercal.recordings.frame import MIN_TRAIN_FRAMES
from evercal.typing import Array, BoolArray, Floats, IntArray, Triple


def _covariance(metres: float, radians: float) -> Array:
    return np.diag(np.repeat([metres, radians], 3) ** 2)


GRIPPER_NOISE = _covariance(0.1e-3, np.deg2rad(0.02))
"""(6, 6) covariance of a gripper pose about the stated one."""
CAMERA_NOISE = _covariance(0.3e-3, np.deg2rad(0.03))
"""(6, 6) covariance of a camera pose that an image gives, in the scene."""
_ROUGH = _covariance(0.05, np.deg2rad(15.0))
"""(6, 6) prior covariance of a `gripper_from_camera` that is roughly known."""
_UNKNOWN = _covariance(0.2, np.pi)
"""(6, 6) prior covariance of an unknown `gripper_from_camera`."""
_ANYWHERE = _covariance(1.0, np.pi)
"""(6, 6) prior covariance of the pose of the scene."""
_ANY_SCALE = 1.0
"""Relative standard deviation of the scale of the scene before any image."""
_OPEN = 1.5
"""A direction is poorly observed if four more images reduce its standard deviation by this factor:
7 and 2 for a KUKA and a Panda that orbit a board, 1.04 for the packaged cell."""
_ADDED = 4
"""Number of further images of a motion."""
_STEP = 0.25
"""Size of a motion, in distances of the scene."""
_STEPS_M = (0.03, 0.2)
"""Least and largest size of a motion, metres."""
_TURN_DEG = 15.0
"""Rotation of a motion in place, degrees."""
_AT_M = 0.3
"""Distance from the camera of the point whose variance counts, metres."""
_AHEAD_M = 0.5
"""Distance of the scene before parallel cameras, metres."""
_APART_M = 0.02
"""Poses nearer than this, and than `_APART_DEG`, are one: errors of an arm repeat where it does."""
_APART_DEG = 4.0
"""Angle between poses that are one, degrees."""


@frozen_arrays
class NextViews:
    """Poses to go to, in order."""

    index: IntArray
    """(k,) index among the reachable poses."""
    poses: SE3
    """(k,) base_from_gripper."""
    sigma_mm: Floats
    """(k + 1,) expected standard deviation per axis: now, and after each pose."""
    sigma_deg: Floats


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
    mount, scene_m, known = _known(recorded, gripper_from_camera)
    added = wrist_information(reachable, mount, scene_m)
    return _chosen(known, added, reachable, count, excluded or recorded)


@frozen
class OpenPosition:
    """The direction in which the motions of a recording leave `gripper_from_camera` open."""

    direction: Triple
    """Unit vector in the gripper frame."""
    sigma_mm: float
    """Expected standard deviation along it."""
    across_mm: float
    """The largest one across it."""
    motion: str
    """Further images that reduce it most."""
    then_mm: float
    """Largest expected standard deviation with them."""

    def sentence(self, stated_mm: float | None = None) -> str:
        """What to do; by default with the expected standard deviation, or with a stated one."""
        times = 1.0 if stated_mm is None else stated_mm / self.sigma_mm
        along = ", ".join(f"{value:+.2f}" for value in self.direction)
        now = times * self.sigma_mm
        across = times * self.across_mm
        then = times * self.then_mm
        return (
            f"the motions leave the position along ({along}) of the gripper open: standard"
            f" deviation {now:.1f} mm, {across:.1f} mm across; {_ADDED} more images {self.motion}"
            f" would give about {then:.1f} mm"
        )


def open_position(
    recorded: SE3, gripper_from_camera: SE3 | None = None
) -> OpenPosition | None:
    """The direction that (m,) recorded base_from_gripper leave open, and how to close it.

    None if a few images would improve it little. Without a rough `gripper_from_camera`, distances
    of the scene are from the gripper.
    """
    if len(recorded) < MIN_TRAIN_FRAMES:
        return None
    mount, scene_m, known = _known(recorded, gripper_from_camera)
    covariance = np.linalg.inv(known)
    variances, axes = np.linalg.eigh(covariance[:3, :3])
    along = axes[:, 2]
    sigmas = 1000 * np.sqrt(variances)
    # An error of the scale moves X as far as the scene is away.
    away_m = np.linalg.norm(covariance[:3, 12]) / covariance[12, 12]
    step_m = float(np.clip(_STEP * away_m, *_STEPS_M))
    directions = np.stack([along, axes[:, 0], axes[:, 1]])
    shift = step_m * np.pad(directions, ((0, 0), (0, 3)))
    rotations = np.pad(axes[:, :2].T, ((0, 0), (3, 0)))
    turn = np.deg2rad(_TURN_DEG) * rotations
    motions = {
        f"{100 * step_m:.0f} cm nearer and farther": shift[[0, 0]],
        f"{100 * step_m:.0f} cm aside without turning": shift[1:],
        f"turned by {_TURN_DEG:.0f} deg in place": turn,
    }
    begun = recorded[spread(len(recorded), _ADDED)]
    then = {}
    for words, steps in motions.items():
        moved = begun @ SE3.exp(np.concatenate([steps, -steps]))
        added = wrist_information(moved, mount, scene_m).sum(0)
        covariance = _of_six(known + added)
        largest = np.linalg.eigvalsh(covariance[:3, :3])[-1]
        then[words] = 1000 * float(np.sqrt(largest))
    best = min(then, key=then.__getitem__)
    if sigmas[2] < _OPEN * then[best]:
        return None
    x, y, z = along.tolist()
    return OpenPosition((x, y, z), float(sigmas[2]), float(sigmas[1]), best, then[best])


def _known(recorded: SE3, gripper_from_camera: SE3 | None) -> tuple[SE3, Array, Array]:
    """X or none, the scene (3,), and information (13, 13) about X, Z and the scene's scale."""
    mount = gripper_from_camera or SE3.identity()
    scene_m = looked_at(recorded @ mount)
    known = np.zeros((13, 13))
    known[:6, :6] = np.linalg.inv(_ROUGH if gripper_from_camera else _UNKNOWN)
    known[6:12, 6:12] = np.linalg.inv(_ANYWHERE)
    known[12, 12] = _ANY_SCALE**-2
    known += wrist_information(recorded, mount, scene_m).sum(0)
    return mount, scene_m, known


def _chosen(
    known: Array, added: Array, reachable: SE3, count: int, excluded: SE3
) -> NextViews:
    """Greedy choice by information `added` (n, N, N) to `known` (N, N); the first six matter."""
    if not len(reachable):
        raise InputError(
            "no reachable poses; give at least one pose that the arm can go to"
        )
    free = np.trace(added, axis1=1, axis2=2) > 0
    for pose in excluded:
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
    return np.linalg.solve(information, np.eye(information.shape[-1])[:, :6])[
        ..., :6, :
    ]


def _near(pose: SE3, others: SE3) -> BoolArray:
    metres, radians = pose_distance(pose, others)
    return np.less(metres, _APART_M) & np.less(radians, np.deg2rad(_APART_DEG))


def looked_at(base_from_camera: SE3) -> Array:
    """The point (3,) nearest to the optical axes of (n,) cameras, or ahead of parallel ones."""
    axes = base_from_camera.rotation_matrix()[..., 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    ahead = (base_from_camera.translation_m + _AHEAD_M * axes).mean(0)
    # A weak pull towards that point decides where the axes do not.
    weight = 1e-3 * len(axes) * np.eye(3)
    right = np.einsum("nij,nj->i", across, base_from_camera.translation_m)
    right = right + weight @ ahead
    return np.linalg.solve(across.sum(0) + weight, right)


def wrist_information(base_from_gripper: SE3, mount: SE3, scene_m: Array) -> Array:
    """(n, 13, 13) information about X, Z and scale that an image at (n,) gripper poses adds."""
    jacobian = wrist_jacobian(base_from_gripper, mount, scene_m)
    to_camera = mount.inverse().adjoint()
    weight = np.linalg.inv(to_camera @ GRIPPER_NOISE @ to_camera.T + CAMERA_NOISE)
    return np.swapaxes(jacobian, 1, 2) @ weight @ jacobian


def wrist_jacobian(base_from_gripper: SE3, mount: SE3, scene_m: Array) -> Array:
    """(n, 6, 13) derivatives of residuals by errors of X, of Z and scale about `scene_m` (3,)."""
    camera_from_scene = (base_from_gripper @ mount).inverse() @ SE3.from_translation(
        scene_m
    )
    jacobian = np.zeros((len(base_from_gripper), 6, 13))
    turned = np.eye(6)
    turned[:3, :3] = mount.rotation_matrix().T
    jacobian[:, :, :6] = -turned
    jacobian[:, :, 6:12] = camera_from_scene.adjoint()
    jacobian[:, :3, 12] = -camera_from_scene.translation_m
    return jacobian
