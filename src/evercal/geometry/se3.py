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

from evercal.typing import Array, ArrayPair, JsonObject, Pair

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])
"""Signs of the conjugate of a quaternion w, x, y, z."""
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
        quaternion = np.array(self.rotation_wxyz, float)
        translation = np.array(self.translation_m, float)
        batch = quaternion.shape[:-1]
        if quaternion.shape[-1:] != (4,) or translation.shape != (*batch, 3):
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
        return cls(pose.rotation_wxyz, np.asarray(translation_m, float))

    @classmethod
    def of(
        cls, rotation: "Rotation", translation_m: ArrayLike, canonical: bool = True
    ) -> Self:
        """Create poses (...) from SciPy's rotations and (..., 3) translations, metres.

        Quaternions get w >= 0 if they are `canonical`; otherwise they keep their sign.
        """
        quaternion = rotation.as_quat(canonical=canonical, scalar_first=True)
        return cls(quaternion, np.asarray(translation_m, float))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike, tolerance: float = 1e-3) -> Self:
        """Convert homogeneous matrices.

        Shapes are (..., 4, 4) or (..., 3, 4). The nearest rotation is used; `tolerance` is the
        largest entry of `R^T R - I` that counts as rounding.
        """
        matrix = np.asarray(matrix, float)
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
        drift = rotation_error(block).max(initial=0.0)
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
        tangent = np.asarray(tangent, float)
        if tangent.shape[-1:] != (6,):
            raise ValueError(f"a tangent is (..., 6) = (v, w), got {tangent.shape}")
        velocity = tangent[..., :3]
        vector = tangent[..., 3:]
        angle = np.linalg.norm(vector, axis=-1, keepdims=True)
        half = angle / 2
        imaginary = np.sinc(half / np.pi) / 2 * vector
        quaternion = np.concatenate([np.cos(half), imaginary], -1)
        square = angle * angle
        # 1 - cos cancels for small angles, and so does angle - sin: then their series are used.
        small = angle < _SMALL_RAD
        safe = np.where(small, 1.0, angle)
        first = 2 * (np.sin(safe / 2) / safe) ** 2
        first = np.where(small, 0.5 - square / 24, first)
        second = (safe - np.sin(safe)) / safe**3
        second = np.where(small, 1 / 6 - square / 120, second)
        once = np.cross(vector, velocity)
        twice = np.cross(vector, once)
        return cls(quaternion, velocity + first * once + second * twice)

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
        quaternion = self.rotation_wxyz.reshape(-1, 4)[rows]
        return type(self)(quaternion, self.translation_m.reshape(-1, 3)[rows])

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
        xx = x * x
        yy = y * y
        zz = z * z
        xy = x * y
        xz = x * z
        yz = y * z
        wx = w * x
        wy = w * y
        wz = w * z
        matrix = np.empty((3, 3, *self.shape))
        matrix[0, 0] = 1 - 2 * (yy + zz)
        matrix[0, 1] = 2 * (xy - wz)
        matrix[0, 2] = 2 * (xz + wy)
        matrix[1, 0] = 2 * (xy + wz)
        matrix[1, 1] = 1 - 2 * (xx + zz)
        matrix[1, 2] = 2 * (yz - wx)
        matrix[2, 0] = 2 * (xz - wy)
        matrix[2, 1] = 2 * (yz + wx)
        matrix[2, 2] = 1 - 2 * (xx + yy)
        return np.ascontiguousarray(np.moveaxis(matrix, (0, 1), (-2, -1)))

    def matrix(self) -> Array:
        """(..., 4, 4) homogeneous matrices."""
        matrix = np.zeros((*self.shape, 4, 4))
        matrix[..., :3, :3] = self.rotation_matrix()
        matrix[..., :3, 3] = self.translation_m
        matrix[..., 3, 3] = 1.0
        return matrix

    def inverse(self) -> Self:
        """`base_from_camera.inverse()` is `camera_from_base`."""
        conjugate = self.rotation_wxyz * _CONJUGATE
        transposed = np.swapaxes(self.rotation_matrix(), -1, -2)
        rotated = (transposed @ self.translation_m[..., None])[..., 0]
        return type(self)(conjugate, -rotated)

    def __matmul__(self, other: "SE3") -> Self:
        """`a_from_b @ b_from_c` is `a_from_c`; batch shapes broadcast."""
        if not isinstance(other, SE3):
            return NotImplemented
        quaternion = _quaternion_product(self.rotation_wxyz, other.rotation_wxyz)
        return type(self)(quaternion, self.apply(other.translation_m))

    def apply(self, points: ArrayLike) -> Array:
        """Transform points (..., 3) to the parent frame; leading axes broadcast."""
        points = np.asarray(points, float)
        if points.shape[-1:] != (3,):
            raise ValueError(f"points are (..., 3), got {points.shape}")
        if not self.shape:
            return points @ self.rotation_matrix().T + self.translation_m
        rotated = (self.rotation_matrix() @ points[..., None])[..., 0]
        return rotated + self.translation_m

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
        rotates = sine > 0
        scale = angle / np.where(rotates, sine, 1)
        vector = np.where(rotates, scale, 2) * v
        small = angle < _SMALL_RAD
        safe = np.where(small, 1.0, angle)
        half = safe / 2
        second = (1 - half / np.tan(half)) / safe**2
        second = np.where(small, 1 / 12 + angle**2 / 720, second)
        once = np.cross(vector, self.translation_m)
        twice = np.cross(vector, once)
        velocity = self.translation_m - once / 2 + second * twice
        return np.concatenate([velocity, vector], -1)


def pose_to_dict(pose: SE3 | None) -> JsonObject | None:
    """Single transform as plain numbers for JSON, metres and wxyz; None stays None."""
    if not pose:
        return None
    return {
        "translation_m": pose.translation_m.tolist(),
        "quaternion_wxyz": pose.rotation_wxyz.tolist(),
    }


def pose_distance(a: SE3, b: SE3) -> ArrayPair:
    """Metres (...) and radians (...) in [0, pi] between transforms into the same frame."""
    metres = norms(a.translation_m - b.translation_m)
    conjugate = a.rotation_wxyz * _CONJUGATE
    difference = _quaternion_product(conjugate, b.rotation_wxyz)
    # atan2 keeps full precision near 0 and pi, where arccos of the trace loses half the digits.
    sine = norms(difference[..., 1:])
    cosine = np.abs(difference[..., 0])
    return np.asarray(metres), 2.0 * np.arctan2(sine, cosine)


def pose_distance_mm_deg(a: SE3, b: SE3) -> Pair:
    """`pose_distance` of two single transforms, in millimetres and degrees."""
    metres, radians = pose_distance(a, b)
    return 1000 * float(metres), float(np.rad2deg(radians))


def deviations(poses: SE3, mean: SE3) -> Array:
    """(n, 6) deviations of poses: translations in the parent frame, rotations about child axes."""
    shift = poses.translation_m - mean.translation_m
    rotation = (mean.inverse() @ poses).log()[:, 3:]
    return np.concatenate([shift, rotation], axis=1)


def length_mm_deg(deviation: Array) -> Pair:
    """Length of one deviation (6,) in millimetres and degrees."""
    metres = np.linalg.norm(deviation[:3])
    radians = np.linalg.norm(deviation[3:])
    return 1000 * float(metres), float(np.rad2deg(radians))


def norms(vectors: ArrayLike) -> Array:
    """Lengths (...) of vectors (..., k)."""
    return np.linalg.norm(vectors, axis=-1)


def unit_vectors(vectors: Array, least: float = 1e-12) -> Array:
    """Vectors (..., k) of length 1; those shorter than `least` are divided by it."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.maximum(lengths, least)


def cross_matrix(v: ArrayLike) -> Array:
    """(..., 3, 3) matrices of the cross product with vectors (..., 3)."""
    v = np.asarray(v, float)
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 0, 1] = -v[..., 2]
    matrix[..., 0, 2] = v[..., 1]
    matrix[..., 1, 2] = -v[..., 0]
    return matrix - np.swapaxes(matrix, -1, -2)


def rotation_error(blocks: Array) -> Array:
    """(..., 3, 3) absolute entries of R^T R - I of matrices (..., 3, 3)."""
    gram = np.swapaxes(blocks, -1, -2) @ blocks
    return np.abs(gram - np.eye(3))


def nearest_rotation(blocks: Array) -> Array:
    """(..., 3, 3) rotations nearest to any matrices (..., 3, 3)."""
    left, _, right = np.linalg.svd(blocks)
    left[..., -1] *= np.linalg.det(left @ right)[..., None]
    return left @ right


def _quaternion(matrix: Array) -> Array:
    """(..., 4) of the rotations nearest to matrices (..., 3, 3) (Bar-Itzhack, JGCD 2000)."""
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(matrix, (-2, -1), (0, 1))
    rows = [
        [a + e + i, h - f, c - g, d - b],
        [h - f, a - e - i, b + d, c + g],
        [c - g, b + d, e - a - i, f + h],
        [d - b, c + g, f + h, i - a - e],
    ]
    return dominant_quaternion(np.moveaxis(np.array(rows), (0, 1), (-2, -1)))


def dominant_quaternion(matrix: Array) -> Array:
    """(..., 4) eigenvectors of the largest eigenvalues of (..., 4, 4), with w >= 0."""
    vector = np.linalg.eigh(matrix)[1][..., -1]
    return np.where(vector[..., :1] < 0, -vector, vector)


def _quaternion_product(a: Array, b: Array) -> Array:
    """Hamilton product of (..., 4) wxyz; written out because it is an inner loop."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    w = aw * bw - ax * bx
    x = aw * bx + ax * bw
    y = aw * by - ax * bz
    z = aw * bz + ax * by
    w = w - ay * by - az * bz
    x = x + ay * bz - az * by
    y = y + ay * bw + az * bx
    z = z - ay * bx + az * bw
    return np.stack([w, x, y, z], axis=-1)
