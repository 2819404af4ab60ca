"""Rigid transforms: batched, immutable, float64.

Conventions: a transform is named after its frames, `base_from_camera` takes points in the camera
frame to points in the base frame, so that `base_from_camera @ camera_from_point` cancels on sight.
Metres, radians, quaternions in the order w, x, y, z, tangents in the order (translation, rotation).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import ArrayLike

from evercal.typing import Array

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_SMALL_RAD = 1e-3
"""Angle below which series replace quotients that cancel."""


@dataclass(frozen=True, eq=False)
class SE3:
    """One rigid transform, or an array of them with any batch shape.

    Quaternions are normalised on entry. Two transforms are compared with `pose_distance`, not `==`.
    """

    rotation_wxyz: Array
    """(..., 4) unit quaternion w, x, y, z."""
    translation_m: Array
    """(..., 3) metres."""

    def __post_init__(self) -> None:
        quaternion = np.array(self.rotation_wxyz, dtype=np.float64)
        translation = np.array(self.translation_m, dtype=np.float64)
        if quaternion.shape[-1:] != (4,) or translation.shape != (
            *quaternion.shape[:-1],
            3,
        ):
            raise ValueError(
                f"SE3 takes rotation_wxyz (..., 4) and translation_m (..., 3) with one batch shape,"
                f" got {quaternion.shape} and {translation.shape}"
            )
        length = np.sqrt((quaternion * quaternion).sum(-1, keepdims=True))
        if not (np.isfinite(length).all() and np.isfinite(translation).all()):
            raise ValueError(
                "SE3 takes finite numbers, got inf or nan; leave untracked poses out"
            )
        if not (length > 1e-12).all():
            raise ValueError(
                "SE3 got a quaternion of length zero, which is no rotation"
            )
        # Poses that are written and read again stay the same to the last bit.
        length = np.where(np.abs(length - 1) < 1e-15, 1.0, length)
        object.__setattr__(self, "rotation_wxyz", quaternion / length)
        object.__setattr__(self, "translation_m", translation)

    @classmethod
    def identity(cls, shape: tuple[int, ...] = ()) -> Self:
        """The identity transform, repeated to the batch `shape`."""
        quaternion = np.broadcast_to(np.array([1.0, 0.0, 0.0, 0.0]), (*shape, 4))
        return cls(quaternion, np.zeros((*shape, 3)))

    @classmethod
    def from_translation(cls, translation_m: ArrayLike) -> Self:
        """Create poses without rotation from (..., 3) translations, metres."""
        pose = cls.identity(np.shape(translation_m)[:-1])
        return cls(pose.rotation_wxyz, np.asarray(translation_m, dtype=np.float64))

    @classmethod
    def of(
        cls, rotation: "Rotation", translation_m: ArrayLike, canonical: bool = True
    ) -> Self:
        """Create poses (...) from SciPy's rotations and (..., 3) translations, metres.

        Quaternions get w >= 0 if they are `canonical`; otherwise they keep their sign.
        """
        quaternion = rotation.as_quat(canonical=canonical, scalar_first=True)
        return cls(quaternion, np.asarray(translation_m, dtype=np.float64))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike, tolerance: float = 1e-3) -> Self:
        """Convert homogeneous matrices.

        Shapes are (..., 4, 4) or (..., 3, 4). The nearest rotation is used; `tolerance` is the
        largest entry of `R^T R - I` that counts as rounding.
        """
        matrix = np.asarray(matrix, dtype=np.float64)
        if matrix.ndim < 2 or matrix.shape[-2:] not in ((4, 4), (3, 4)):
            raise ValueError(
                f"a pose matrix is (..., 4, 4) or (..., 3, 4), got {matrix.shape}"
            )
        if not np.isfinite(matrix).all():
            raise ValueError("a pose matrix takes finite numbers, got inf or nan")
        if matrix.shape[-2] == 4 and not np.allclose(
            matrix[..., 3, :], (0, 0, 0, 1), atol=1e-6
        ):
            raise ValueError(
                "the last row of a pose matrix is 0 0 0 1, got something else"
            )
        block = matrix[..., :3, :3]
        drift = np.abs(np.swapaxes(block, -1, -2) @ block - np.eye(3)).max(initial=0.0)
        if drift > tolerance:
            raise ValueError(
                f"the left 3x3 block of a pose matrix is a rotation within {tolerance:g},"
                f" got one that is off by {drift:.3g}"
            )
        if not (np.linalg.det(block) > 0).all():
            raise ValueError(
                "a pose matrix got a reflection (determinant -1), which is no pose"
            )
        return cls(_quaternion(block), matrix[..., :3, 3])

    @classmethod
    def exp(cls, tangent: ArrayLike) -> Self:
        """Exponential map of tangents (..., 6) = (v, w): v in metres, w in radians."""
        tangent = np.asarray(tangent, dtype=np.float64)
        if tangent.shape[-1:] != (6,):
            raise ValueError(f"a tangent is (..., 6) = (v, w), got {tangent.shape}")
        vector = tangent[..., 3:]
        angle = np.linalg.norm(vector, axis=-1, keepdims=True)
        quaternion = np.concatenate(
            [np.cos(angle / 2), np.sinc(angle / 2 / np.pi) / 2 * vector], -1
        )
        square = angle * angle
        # 1 - cos cancels for small angles, and so does angle - sin: then their series are used.
        small = angle < _SMALL_RAD
        safe = np.where(angle < _SMALL_RAD, 1.0, angle)
        first = 2 * (np.sin(safe / 2) / safe) ** 2
        first = np.where(small, 0.5 - square / 24, first)
        second = np.where(small, 1 / 6 - square / 120, (safe - np.sin(safe)) / safe**3)
        once = np.cross(vector, tangent[..., :3])
        shift = tangent[..., :3] + first * once + second * np.cross(vector, once)
        return cls(quaternion, shift)

    @classmethod
    def stack(cls, poses: Sequence["SE3"]) -> Self:
        """Stack transforms of one batch shape along a new first axis; an empty list gives (0,)."""
        if not poses:
            return cls(np.zeros((0, 4)), np.zeros((0, 3)))
        return cls(
            np.stack([pose.rotation_wxyz for pose in poses]),
            np.stack([pose.translation_m for pose in poses]),
        )

    @property
    def shape(self) -> tuple[int, ...]:
        """The batch shape, () for a single transform."""
        return self.translation_m.shape[:-1]

    def __len__(self) -> int:
        """The first batch axis; TypeError for a single transform."""
        if not self.shape:
            raise TypeError("a single SE3 has no length")
        return self.shape[0]

    def __bool__(self) -> bool:
        """Always true: `pose or default` must not depend on the batch."""
        return True

    def __getitem__(self, index: object) -> Self:
        """Indexes the batch axes like a numpy array."""
        if not self.shape:
            raise TypeError("a single SE3 cannot be indexed")
        rows = np.arange(int(np.prod(self.shape))).reshape(self.shape)[index]  # pyright: ignore[reportCallIssue, reportArgumentType]
        return type(self)(
            self.rotation_wxyz.reshape(-1, 4)[rows],
            self.translation_m.reshape(-1, 3)[rows],
        )

    def __iter__(self) -> Iterator[Self]:
        """Over the first batch axis."""
        return (self[i] for i in range(len(self)))

    @property
    def rotation(self) -> "Rotation":
        """The rotations (...) as SciPy's."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_quat(self.rotation_wxyz, scalar_first=True)

    def rotation_matrix(self) -> Array:
        """(..., 3, 3)."""
        # Written out because it is an inner loop.
        w, x, y, z = np.moveaxis(self.rotation_wxyz, -1, 0)
        matrix = np.empty((*self.shape, 3, 3))
        matrix[..., 0, 0] = 1 - 2 * (y * y + z * z)
        matrix[..., 0, 1] = 2 * (x * y - w * z)
        matrix[..., 0, 2] = 2 * (x * z + w * y)
        matrix[..., 1, 0] = 2 * (x * y + w * z)
        matrix[..., 1, 2] = 2 * (y * z - w * x)
        matrix[..., 1, 1] = 1 - 2 * (x * x + z * z)
        matrix[..., 2, 0] = 2 * (x * z - w * y)
        matrix[..., 2, 1] = 2 * (y * z + w * x)
        matrix[..., 2, 2] = 1 - 2 * (x * x + y * y)
        return matrix

    def matrix(self) -> Array:
        """(..., 4, 4) homogeneous matrices."""
        matrix = np.zeros((*self.shape, 4, 4))
        matrix[..., :3, :3] = self.rotation_matrix()
        matrix[..., :3, 3] = self.translation_m
        matrix[..., 3, 3] = 1.0
        return matrix

    def inverse(self) -> Self:
        """`base_from_camera.inverse()` is `camera_from_base`."""
        conjugate = self.rotation_wxyz * np.array([1.0, -1.0, -1.0, -1.0])
        transposed = np.swapaxes(self.rotation_matrix(), -1, -2)
        return type(self)(
            conjugate, -(transposed @ self.translation_m[..., None])[..., 0]
        )

    def __matmul__(self, other: "SE3") -> Self:
        """`a_from_b @ b_from_c` is `a_from_c`; batch shapes broadcast."""
        if not isinstance(other, SE3):
            return NotImplemented
        quaternion = _quaternion_product(self.rotation_wxyz, other.rotation_wxyz)
        return type(self)(quaternion, self.apply(other.translation_m))

    def apply(self, points: ArrayLike) -> Array:
        """Transform points (..., 3) to the parent frame; leading axes broadcast."""
        points = np.asarray(points, dtype=np.float64)
        if points.shape[-1:] != (3,):
            raise ValueError(f"points are (..., 3), got {points.shape}")
        if not self.shape:
            return points @ self.rotation_matrix().T + self.translation_m
        return (self.rotation_matrix() @ points[..., None])[..., 0] + self.translation_m

    def adjoint(self) -> Array:
        """(..., 6, 6) matrices A with `self @ exp(x) == exp(A x) @ self` for tangents x."""
        rotation = self.rotation_matrix()
        adjoint = np.zeros((*self.shape, 6, 6))
        adjoint[..., :3, :3] = adjoint[..., 3:, 3:] = rotation
        for axis in range(3):
            column = np.cross(self.translation_m, rotation[..., :, axis])
            adjoint[..., :3, 3 + axis] = column
        return adjoint

    def log(self) -> Array:
        """(..., 6) = (v, w) with |w| <= pi, the inverse of `exp`."""
        w, v = np.split(self.rotation_wxyz, [1], -1)
        v = np.where(w < 0, -v, v)
        sine = np.linalg.norm(v, axis=-1, keepdims=True)
        angle = 2 * np.arctan2(sine, np.abs(w))
        vector = np.where(sine > 0, angle / np.where(sine > 0, sine, 1), 2) * v
        small = angle < _SMALL_RAD
        safe = np.where(angle < _SMALL_RAD, 1.0, angle)
        second = (1 - safe / 2 / np.tan(safe / 2)) / safe**2
        second = np.where(small, 1 / 12 + angle**2 / 720, second)
        once = np.cross(vector, self.translation_m)
        shift = self.translation_m - once / 2 + second * np.cross(vector, once)
        return np.concatenate([shift, vector], -1)


def pose_to_dict(pose: SE3 | None) -> dict[str, object] | None:
    """Single transform as plain numbers for JSON, metres and wxyz; None stays None."""
    if pose is None:
        return None
    return {
        "translation_m": pose.translation_m.tolist(),
        "quaternion_wxyz": pose.rotation_wxyz.tolist(),
    }


def pose_distance(a: SE3, b: SE3) -> tuple[Array, Array]:
    """Metres (...) and radians (...) in [0, pi] between transforms into the same frame."""
    metres = np.linalg.norm(a.translation_m - b.translation_m, axis=-1)
    conjugate = a.rotation_wxyz * np.array([1.0, -1.0, -1.0, -1.0])
    difference = _quaternion_product(conjugate, b.rotation_wxyz)
    # atan2 keeps full precision near 0 and pi, where arccos of the trace loses half the digits.
    sine = np.linalg.norm(difference[..., 1:], axis=-1)
    return np.asarray(metres), 2.0 * np.arctan2(sine, np.abs(difference[..., 0]))


def pose_distance_mm_deg(a: SE3, b: SE3) -> tuple[float, float]:
    """`pose_distance` of two single transforms, in millimetres and degrees."""
    metres, radians = pose_distance(a, b)
    return 1000 * float(metres), float(np.rad2deg(radians))


def deviations(poses: SE3, mean: SE3) -> Array:
    """(n, 6) deviations of poses: translations in the parent frame, rotations about child axes."""
    shift = poses.translation_m - mean.translation_m
    rotation = (mean.inverse() @ poses).log()[:, 3:]
    return np.concatenate([shift, rotation], axis=1)


def length_mm_deg(deviation: Array) -> tuple[float, float]:
    """Length of one deviation (6,) in millimetres and degrees."""
    metres = np.linalg.norm(deviation[:3])
    radians = np.linalg.norm(deviation[3:])
    return 1000 * float(metres), float(np.rad2deg(radians))


def cross_matrix(v: ArrayLike) -> Array:
    """(..., 3, 3) matrices of the cross product with vectors (..., 3)."""
    v = np.asarray(v, dtype=np.float64)
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 0, 1] = -v[..., 2]
    matrix[..., 0, 2] = v[..., 1]
    matrix[..., 1, 2] = -v[..., 0]
    return matrix - np.swapaxes(matrix, -1, -2)


def average_poses(poses: SE3) -> SE3:
    """Robust mean of poses (n,); up to nearly half of them may be outliers.

    Iteratively reweighted mean, started at the medoid. Weights are Tukey's biweight of the distance
    to the current mean, cut at four median distances, in metres and in radians.
    """
    if len(poses.shape) != 1 or len(poses) == 0:
        raise ValueError(
            f"average_poses takes a batch (n,) with n >= 1, got {poses.shape}"
        )
    mean = _medoid(poses)
    for _ in range(50):
        metres, radians = pose_distance(mean, poses)
        weight = _biweight(metres) * _biweight(radians)
        # Poses near in metres and poses near in radians are disjoint.
        if weight.sum() <= 0:
            return mean
        translation = weight @ poses.translation_m / weight.sum()
        rotation = _dominant(np.einsum("n,ni,nj", weight, *[poses.rotation_wxyz] * 2))
        before = mean
        mean = SE3(rotation, translation)
        if max(pose_distance(before, mean)) < 1e-12:
            break
    return mean


def _quaternion(matrix: Array) -> Array:
    """(..., 4) of the rotations nearest to matrices (..., 3, 3) (Bar-Itzhack, JGCD 2000)."""
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(matrix, (-2, -1), (0, 1))
    rows = [
        [a + e + i, h - f, c - g, d - b],
        [h - f, a - e - i, b + d, c + g],
        [c - g, b + d, e - a - i, f + h],
        [d - b, c + g, f + h, i - a - e],
    ]
    return _dominant(np.moveaxis(np.array(rows), (0, 1), (-2, -1)))


def _dominant(matrix: Array) -> Array:
    """(..., 4) eigenvectors of the largest eigenvalues of (..., 4, 4), with w >= 0."""
    vector = np.linalg.eigh(matrix)[1][..., -1]
    return np.where(vector[..., :1] < 0, -vector, vector)


def _quaternion_product(a: Array, b: Array) -> Array:
    """Hamilton product of (..., 4) wxyz; written out because it is an inner loop."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    w = aw * bw - ax * bx - ay * by - az * bz
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by - ax * bz + ay * bw + az * bx
    z = aw * bz + ax * by - ay * bx + az * bw
    return np.stack([w, x, y, z], axis=-1)


def _medoid(poses: SE3) -> SE3:
    """The pose with the smallest summed distance to the others, among at most 200 candidates."""
    candidates = np.unique(np.linspace(0, len(poses) - 1, 200).round().astype(int))
    cost = np.zeros(len(candidates))
    for distance in pose_distance(poses[candidates[:, None]], poses[None]):
        # Scaled by their median, distances in metres and in radians can be added.
        cost += distance.sum(1) / max(float(np.median(distance)), 1e-9)
    return poses[candidates[np.argmin(cost)]]


def _biweight(distance: Array) -> Array:
    """Tukey's biweight of (n,) distances, cut at four medians."""
    # The farther of the two middle poses, so that the mean of two poses lies halfway.
    cut = 4.0 * max(float(np.sort(distance)[len(distance) // 2]), 1e-9)
    return np.clip(1.0 - (distance / cut) ** 2, 0.0, None) ** 2
