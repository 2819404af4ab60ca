"""The transform of a camera whose epipolar lines fit matches best, from gripper poses.

Let A be the motion of the gripper between two images, and X the transform from the camera to what
it is mounted on. X and the gripper poses predict an epipolar line for every match. The distances
from these lines (Sampson's approximation) are minimised over all six parameters of X.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from evercal.calibration.from_map.image_pairs import ImagePair
from evercal.geometry import SE3, cross_matrix, norms, spread, unit_vectors
from evercal.mapping.bundle_options import BundleOptions
from evercal.robot.mount import EYE_IN_HAND, EYE_TO_HAND, Mount
from evercal.typing import Array

ANGLE_DEG = 3.0
"""Scale of the robust loss at first: angle between the rays of a match and its epipolar plane."""
SPREAD_M = {EYE_IN_HAND: 0.2, EYE_TO_HAND: 2.0}
"""Standard deviation of the position of the camera before any image."""
JOINT_SPREAD = np.deg2rad(BundleOptions().joint_sigma_deg)
"""Standard deviation of the offset of a joint, radians or metres."""
DEPTHS_M = (0.3, 0.6, 1.2, 2.4)
"""First distances between a fixed camera and the gripper."""
BESIDE_M = 0.1
"""First positions of a camera on the gripper: its origin, and this far along each axis."""
MATCHES = 30
"""Maximum number of matches of a pair that count."""
ROTATIONS = 48
"""Number of first rotations that are tried."""
FIRST_PAIRS = 40
"""Maximum number of pairs that first rotations are tried on."""
FIRST_MATCHES = 10
"""Maximum number of matches of each of these pairs."""
CLEAR_PARALLAX = np.sin(np.deg2rad(1.0))
"""Smallest sine of the angle between the rays of a match whose depth has a sign."""
STEP = 1e-7
"""Step of numerical derivatives, radians and metres."""
X_SCALE = np.repeat([0.01, 0.1], 3)
"""Characteristic scale of the parameters: radians and metres (`x_scale` of SciPy)."""


class EpipolarFit:
    """Sampson distances of matches from the epipolar lines of a transform, as angles.

    Args:
        poses: (n,) parent frame in the frame of the scene.
        pairs: Matches between the n images.
        mount: Of the camera.
        most: Maximum number of matches of a pair.
    """

    def __init__(
        self,
        poses: SE3,
        pairs: Sequence[ImagePair],
        mount: Mount,
        most: int = MATCHES,
    ):
        self.rotation = Rotation.identity()
        self.mount = mount
        self.matrices = poses.matrix()
        self.pairs = pairs
        self.moving: Callable[[Array], Array] = lambda _: self.matrices
        self.ends = np.array([pair[:2] for pair in pairs])
        rays = []
        counts = []
        for pair in pairs:
            rows = spread(pair.rays.shape[1], most)
            rays.append(pair.rays[:, rows])
            counts.append(len(rows))
        self.first, self.second = np.concatenate(rays, axis=1)
        self.number = np.repeat(np.arange(len(pairs)), counts)

    def starts(self) -> list[Array]:
        """First parameters (6,): rotation vector after `rotation`, position."""
        if self.mount.moves:
            axes = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
            positions = list(axes * BESIDE_M)
        else:
            rays = np.concatenate([self.first, self.second])
            towards = self.rotation.apply(rays.mean(0))
            towards = towards / np.linalg.norm(towards)
            gripper = np.linalg.inv(self.matrices)[:, :3, 3].mean(0)
            positions = [gripper - depth * towards for depth in DEPTHS_M]
        return [np.r_[np.zeros(3), position] for position in positions]

    def solve(
        self,
        start: Array,
        centre: Array,
    ) -> Array:
        """Minimise from a start, with a prior about `centre`; all are parameters (6,)."""
        scale = float(np.deg2rad(ANGLE_DEG))
        x = start
        matches = len(self.number) / len(self.pairs)
        is_joint = np.arange(len(start)) >= 6
        spread = np.where(is_joint, JOINT_SPREAD, SPREAD_M[self.mount])[3:]

        def residuals(
            x: Array,
            scale: float,
        ) -> Array:
            # The matches of a pair share the errors of its poses, so each pair counts as one match.
            away = np.sqrt(matches) * (x - centre)[3:] / spread
            # The loss of these residuals is quadratic: the prior is no outlier.
            size = np.sqrt(np.expm1(np.minimum(away**2, 300.0)))
            prior = scale * np.sign(away) * size
            return np.r_[self.distances(x), prior]

        for _ in range(3):
            x = least_squares(
                residuals,
                x,
                args=(scale,),
                loss="cauchy",
                f_scale=scale,
                x_scale=np.r_[X_SCALE, np.full(len(x) - 6, X_SCALE[0])],
                max_nfev=50,
            ).x
            median = float(np.median(np.abs(self.distances(x))))
            scale = min(scale, max(3 * median, 1e-4))
        return x

    def distances(
        self,
        x: Array,
    ) -> Array:
        """(..., m) angles of matches from their epipolar planes, radians.

        `x` is (..., 6), or the parameters of one camera and of its arm.
        """
        moving = self.moving(x[..., 6:])
        camera = moving @ self.transform(x).matrix()[..., None, :, :]
        first = camera[..., self.ends[:, 0], :, :]
        second = camera[..., self.ends[:, 1], :, :]
        second_from_first = np.linalg.inv(second) @ first
        direction = unit_vectors(second_from_first[..., :3, 3], 1e-9)
        essential = cross_matrix(direction) @ second_from_first[..., :3, :3]
        essential = essential[..., self.number, :, :]
        in_second = (essential @ self.first[..., None])[..., 0]
        in_first = (self.second[:, None] @ essential)[..., 0, :]
        squares = (in_second[..., :2] ** 2).sum(-1)
        squares = squares + (in_first[..., :2] ** 2).sum(-1)
        slope = np.sqrt(np.maximum(squares, 1e-12))
        return (self.second * in_second).sum(-1) / slope

    def slopes(
        self,
        x: Array,
    ) -> Array:
        """(m, 6) derivatives of `distances` at parameters (6,)."""
        steps = np.concatenate([np.zeros((1, 6)), STEP * np.eye(6)])
        at, *moved = self.distances(x + steps)
        return (np.array(moved) - at).T / STEP

    def medians(
        self,
        x: Array,
    ) -> Array:
        """Median distance of the matches of each pair, radians."""
        distance = np.abs(self.distances(x))
        pairs = range(len(self.pairs))
        return np.array([np.median(distance[self.number == i]) for i in pairs])

    def share_in_front(self, x: Array) -> float:
        """Share of the matches with parallax whose points lie before the cameras."""
        camera = self.moving(x[6:]) @ self.transform(x).matrix()
        between = np.linalg.inv(camera[self.ends[:, 1]]) @ camera[self.ends[:, 0]]
        between = between[self.number]
        turned = (between[:, :3, :3] @ self.first[..., None])[..., 0]
        shift = between[:, :3, 3]
        # depth * turned + shift is parallel to the ray of the second image.
        normal = np.cross(turned, self.second)
        depth_sign = -(np.cross(shift, self.second) * normal).sum(1)
        sines = norms(normal) / norms(turned) / norms(self.second)
        clear = sines > CLEAR_PARALLAX
        return float((depth_sign[clear] > 0).mean()) if clear.any() else 1.0

    def transform(
        self,
        x: Array,
    ) -> SE3:
        """parent_from_camera of parameters (6,)."""
        rotation = Rotation.from_rotvec(x[..., :3]) * self.rotation
        quaternion = rotation.as_quat(canonical=True, scalar_first=True)
        return SE3(quaternion, x[..., 3:6])


def first_rotation(
    poses: SE3,
    pairs: Sequence[ImagePair],
    mount: Mount,
) -> Rotation:
    """The rotation from which the distances of some matches become smallest.

    Essential matrices would give it faster, but those of a small or flat thing may be wrong by any
    angle, and these distances are not.
    """
    tried = [pairs[i] for i in spread(len(pairs), FIRST_PAIRS)]
    epipolar = EpipolarFit(poses, tried, mount, FIRST_MATCHES)
    scale = np.deg2rad(ANGLE_DEG)
    best = Rotation.identity()
    least = np.inf
    for rotation in spread_rotations(ROTATIONS):
        epipolar.rotation = rotation
        fit = least_squares(
            epipolar.distances,
            np.mean(epipolar.starts(), axis=0),
            jac=epipolar.slopes,  # pyright: ignore[reportArgumentType]
            loss="cauchy",
            f_scale=scale,
            x_scale=X_SCALE,
            max_nfev=15,
            ftol=1e-3,
        )
        cost = np.minimum(np.abs(epipolar.distances(fit.x)), scale).mean()
        if cost < least:
            best = Rotation.from_rotvec(fit.x[:3]) * rotation
            least = cost
    return best


def spread_rotations(count: int) -> Rotation:
    """(count,) rotations in about equal distances.

    A spiral through all unit quaternions: Alexa, Super-Fibonacci spirals (CVPR 2022).
    """
    share = (np.arange(count) + 0.5) / count
    inner = np.sqrt(share)
    outer = np.sqrt(1 - share)
    periods = np.array([[np.sqrt(2)], [1.533751168755204288118041]])
    a, b = 2 * np.pi * count * share / periods
    quaternions = [
        inner * np.sin(a),
        inner * np.cos(a),
        outer * np.sin(b),
        outer * np.cos(b),
    ]
    return Rotation.from_quat(np.stack(quaternions, -1))
