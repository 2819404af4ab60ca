"""Named conventions for poses as numbers, as robots and programs write them.

A convention defines order, units and rotation of the numbers; the table is in docs/formats.md. Its
name may be followed by modifiers: `kuka:m` (KUKA's angles, but metres), `matrix:inverse` (the file
holds gripper_from_base), `matrix:opengl` (camera axes x right, y up, z back). Units in the name are
final. Units that a convention only implies are checked against the numbers by `check_units`.

The conventions were checked against Roboception's documentation of pose formats (ABB, FANUC, KUKA,
Yaskawa), Universal Robots' script manual, RoboDK's converters (Staubli) and libfranka's reference.
"""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from evercal.geometry.se3 import SE3

Array = NDArray[np.float64]
Layout = Literal["wxyz", "xyzw", "rotation_vector", "euler", "rows", "columns"]

_FAR_M = 10.0  # largest distance of a gripper from its base, metres
_NEAR_M = 0.01  # smallest distance of a gripper from its base, metres, for at least one pose
_UNIT_TOLERANCE = 1e-2
"""Largest error of the length of a quaternion printed with three digits."""
_RIGID_TOLERANCE = 1e-2
"""Largest error of R^T R of a rotation matrix printed with three digits."""


@dataclass(frozen=True)
class PoseConvention:
    """How numbers represent a pose."""

    name: str
    layout: Layout
    """Translation then this kind of rotation, or a matrix."""
    meaning: str
    euler: str = ""
    """scipy's Euler axes: lower case about fixed axes, upper case about moving axes."""
    degrees: bool = False
    """Whether angles are in degrees, else radians."""
    metres_per_unit: float = 1.0
    """0.001 for millimetres."""
    inverse: bool = False
    opengl: bool = False
    """Whether the camera's axes are x right, y up, z back, else OpenCV's."""
    length_stated: bool = False
    """Whether the name has the unit of length."""
    angle_stated: bool = False
    """Whether the name has the unit of angles."""

    @property
    def count(self) -> int:
        """Number of numbers of a pose."""
        return {"wxyz": 7, "xyzw": 7, "rows": 16, "columns": 16}.get(self.layout, 6)

    @property
    def has_angles(self) -> bool:
        """Whether some numbers are in radians or degrees."""
        return self.layout in ("rotation_vector", "euler")


class ConventionError(ValueError):
    """A convention is missing, or does not fit the numbers.

    `remedy` names the conventions to give instead.
    """

    def __init__(self, problem: str, remedy: str) -> None:
        super().__init__(f"{problem}; give the convention {remedy}")
        self.problem, self.remedy = problem, remedy

    def naming(self, option: str | None) -> str:
        """Message that names the command line option of the convention, if there is one."""
        return f"{self.problem}; give {option or 'the convention'} {self.remedy}"


_MM: dict[str, Any] = {"metres_per_unit": 0.001}
_MM_DEG: dict[str, Any] = {"metres_per_unit": 0.001, "degrees": True}
CONVENTIONS = {
    convention.name: convention
    for convention in (
        PoseConvention("wxyz", "wxyz", "x y z qw qx qy qz, metres"),
        PoseConvention("xyzw", "xyzw", "x y z qx qy qz qw, metres, as ROS and TUM"),
        PoseConvention("abb", "wxyz", "X Y Z q1 q2 q3 q4, millimetres, q1 is w", **_MM),
        PoseConvention("ur", "rotation_vector", "x y z rx ry rz, metres, rotation vector"),
        PoseConvention("rpy", "euler", "x y z roll pitch yaw, metres, radians, as URDF", "xyz"),
        PoseConvention("kuka", "euler", "X Y Z A B C, mm, degrees, A about z", "ZYX", **_MM_DEG),
        PoseConvention("fanuc", "euler", "X Y Z W P R, mm, degrees, W about x", "xyz", **_MM_DEG),
        PoseConvention(
            "yaskawa", "euler", "X Y Z Rx Ry Rz, mm, degrees, fixed axes", "xyz", **_MM_DEG
        ),
        PoseConvention(
            "staubli", "euler", "X Y Z RX RY RZ, mm, degrees, moving axes", "XYZ", **_MM_DEG
        ),
        PoseConvention("matrix", "rows", "4x4 matrix row after row, metres"),
        PoseConvention("franka", "columns", "4x4 matrix column after column, metres (O_T_EE)"),
    )
}
"""All conventions by name, without modifiers."""
MODIFIERS: dict[str, dict[str, Any]] = {
    "m": {"metres_per_unit": 1.0, "length_stated": True},
    "mm": {"metres_per_unit": 0.001, "length_stated": True},
    "rad": {"degrees": False, "angle_stated": True},
    "deg": {"degrees": True, "angle_stated": True},
    "inverse": {"inverse": True},
    "opengl": {"opengl": True},
}
KNOWN_CONVENTIONS = (
    f"{', '.join(CONVENTIONS)}, followed by :m, :mm, :rad, :deg, :inverse or :opengl where needed"
)
"""All names and modifiers, for messages."""


def pose_convention(name: str) -> PoseConvention:
    """Parse the name of a convention with modifiers, such as `kuka:m:inverse`.

    Raises:
        ValueError: The name is not known, or a modifier does not belong to it.
    """
    base, *modifiers = name.strip().lower().split(":")
    if base not in CONVENTIONS:
        raise ValueError(f"pose convention {name!r} is not known; use one of {KNOWN_CONVENTIONS}")
    convention = replace(CONVENTIONS[base], name=":".join([base, *modifiers]))
    for modifier in modifiers:
        if modifier not in MODIFIERS:
            raise ValueError(
                f"pose convention {name!r}: modifier {modifier!r} is not known;"
                f" use one of {', '.join(MODIFIERS)}"
            )
        if modifier in ("rad", "deg") and not convention.has_angles:
            raise ValueError(f"pose convention {name!r}: it has no angles; leave :{modifier} out")
        convention = replace(convention, **MODIFIERS[modifier])
    kinds = [modifier.replace("mm", "m").replace("deg", "rad") for modifier in modifiers]
    if len(set(kinds)) < len(kinds):
        raise ValueError(f"pose convention {name!r} repeats a modifier; give each kind once")
    return convention


def poses_from_numbers(numbers: ArrayLike, convention: PoseConvention) -> SE3:
    """Convert numbers (..., `convention.count`) to poses (...).

    Poses are in metres with OpenCV's camera axes, not inverted.

    Raises:
        ValueError: The count is wrong, a number is not finite, a quaternion is not of length one,
            or a matrix is no rigid transform; the message names the first such pose.
        ConventionError: The matrices are transposed.
    """
    numbers = np.asarray(numbers, dtype=np.float64)
    if numbers.shape[-1:] != (convention.count,):
        raise ValueError(
            f"a pose as {convention.name!r} has {convention.count} numbers"
            f" ({convention.meaning}), got {numbers.shape[-1] if numbers.ndim else 1}"
        )
    _refuse(~np.isfinite(numbers).all(-1), "a number is inf or nan; leave untracked poses out")
    if convention.layout in ("rows", "columns"):
        poses = _from_matrices(numbers.reshape(*numbers.shape[:-1], 4, 4), convention)
    else:
        rotation = _rotations(numbers[..., 3:], convention)
        quaternion = rotation.as_quat(canonical=True, scalar_first=True)
        poses = SE3(quaternion, numbers[..., :3] * convention.metres_per_unit)
    poses = poses.inverse() if convention.inverse else poses
    return poses @ _OPENGL_FROM_OPENCV if convention.opengl else poses


def numbers_from_poses(poses: SE3, convention: PoseConvention) -> Array:
    """Convert poses (...) to numbers (..., `convention.count`).

    Quaternions get w >= 0. If the middle angle of an Euler convention is within 1e-7 rad of gimbal
    lock, the third angle is 0 and the rotation is exact to 2e-7 rad (scipy).
    """
    poses = poses @ _OPENGL_FROM_OPENCV if convention.opengl else poses
    poses = poses.inverse() if convention.inverse else poses
    translation = poses.translation_m / convention.metres_per_unit
    if convention.layout in ("rows", "columns"):
        matrix = poses.matrix()
        matrix[..., :3, 3] = translation
        if convention.layout == "columns":
            matrix = np.swapaxes(matrix, -1, -2)
        return matrix.reshape(*poses.shape, 16)
    rotation = Rotation.from_quat(poses.rotation_wxyz, scalar_first=True)
    if convention.layout == "euler":
        numbers = rotation.as_euler(
            convention.euler, degrees=convention.degrees, suppress_warnings=True
        )
    elif convention.layout == "rotation_vector":
        numbers = rotation.as_rotvec(degrees=convention.degrees)
    else:
        numbers = rotation.as_quat(canonical=True, scalar_first=convention.layout == "wxyz")
    return np.concatenate([translation, numbers], axis=-1)


def check_units(numbers: ArrayLike, convention: PoseConvention) -> None:
    """Compare numbers (n, `convention.count`) of one recording with the units of their convention.

    Units in its name are final.

    Raises:
        ConventionError: The numbers look like another unit.
        ValueError: The numbers mix two units of length.
    """
    numbers = np.asarray(numbers, dtype=np.float64)
    if not convention.length_stated:
        columns = {"rows": [3, 7, 11], "columns": [12, 13, 14]}.get(convention.layout, [0, 1, 2])
        distance = np.linalg.norm(numbers[..., columns], axis=-1)
        _check_lengths(distance * convention.metres_per_unit, convention)
    if convention.has_angles and not convention.angle_stated:
        _check_angles(numbers[..., 3:], convention)


def _check_lengths(metres: Array, convention: PoseConvention) -> None:
    far = metres > _FAR_M
    near = (metres > 0) & (metres < _NEAR_M) & (convention.metres_per_unit < 1.0)
    odd = far if far.any() else near
    usual = metres[~odd]
    if odd.any() and len(usual) and 0.03 < np.median(usual) < 3.0:
        poses = ", ".join(str(i + 1) for i in np.flatnonzero(odd)[:5])
        raise ValueError(
            f"positions are {np.median(usual):.3g} m from the base, but those of poses {poses} are"
            f" {metres[odd][0]:.3g} m; millimetres and metres may be mixed: write all of them in"
            f" one unit"
        )
    if far.any():
        problem = f"positions up to {metres.max():.4g} m from the base look like millimetres"
        raise _other_unit(convention, problem, "mm", "m")
    if near.any() and near.all():
        problem = f"all positions are within {1000 * metres.max():.2g} mm of the base"
        raise _other_unit(convention, f"{problem}, which looks like metres", "m", "mm")


def _check_angles(angles: Array, convention: PoseConvention) -> None:
    if convention.layout == "rotation_vector":
        angles = np.linalg.norm(angles, axis=-1)
    largest, full = float(np.abs(angles).max(initial=0.0)), 2.0 * np.pi
    if not convention.degrees and largest > full + 1e-6:
        problem = f"an angle of {largest:.4g} is more than a full rotation in radians"
        raise _other_unit(convention, f"{problem}, so it looks like degrees", "deg", "rad")
    if convention.degrees and 0 < largest <= full:
        problem = f"no angle is larger than {largest:.3g}"
        raise _other_unit(convention, f"{problem}, which looks like radians", "rad", "deg")


def _other_unit(
    convention: PoseConvention, problem: str, likely: str, other: str
) -> ConventionError:
    units = ("m", "mm") if likely in ("m", "mm") else ("rad", "deg")
    words = [word for word in convention.name.split(":") if word not in units]
    likely, other = (":".join([*words, unit]) for unit in (likely, other))
    return ConventionError(problem, f"{likely} (or {other} if the unit is right as it is)")


def _rotations(numbers: Array, convention: PoseConvention) -> Rotation:
    if convention.layout == "euler":
        return Rotation.from_euler(convention.euler, numbers, degrees=convention.degrees)
    if convention.layout == "rotation_vector":
        return Rotation.from_rotvec(numbers, degrees=convention.degrees)
    length = np.linalg.norm(numbers, axis=-1)
    _refuse(
        np.abs(length - 1.0) > _UNIT_TOLERANCE,
        f"the quaternion is not of length 1 (shortest {length.min(initial=1.0):.4g}, longest"
        f" {length.max(initial=1.0):.4g}); check which columns hold it",
    )
    return Rotation.from_quat(numbers, scalar_first=convention.layout == "wxyz")


def _from_matrices(matrices: Array, convention: PoseConvention) -> SE3:
    if convention.layout == "columns":
        matrices = np.swapaxes(matrices, -1, -2)
    last = np.array([0.0, 0.0, 0.0, 1.0])
    rows_fit = np.abs(matrices[..., 3, :] - last).max(-1) < 1e-6
    columns_fit = np.abs(matrices[..., :, 3] - last).max(-1) < 1e-6
    if (~rows_fit & columns_fit).any():
        orders = ("row after row", "matrix"), ("column after column", "franka")
        stated, other = orders if convention.layout == "rows" else orders[::-1]
        pose = _first(~rows_fit & columns_fit)
        raise ConventionError(
            f"{pose}: read {stated[0]}, the last column is 0 0 0 1 and the last row holds the"
            f" translation, so it was written {other[0]}",
            ":".join([other[1], *convention.name.split(":")[1:]]),
        )
    _refuse(~rows_fit, "the last row of the matrix is not 0 0 0 1, so it is no rigid transform")
    block = matrices[..., :3, :3]
    drift = np.abs(np.swapaxes(block, -1, -2) @ block - np.eye(3)).max((-1, -2), initial=0.0)
    _refuse(
        (drift > _RIGID_TOLERANCE) | (np.linalg.det(block) < 0),
        f"the left 3x3 block of the matrix is no rotation (R^T R is off by up to"
        f" {drift.max(initial=0.0):.3g}, a reflection has determinant -1); it may hold a scale",
    )
    scaled = matrices.copy()
    scaled[..., :3, 3] *= convention.metres_per_unit
    return SE3.from_matrix(scaled, _RIGID_TOLERANCE)


def _refuse(broken: ArrayLike, reason: str) -> None:
    """Raise for the first broken pose."""
    if np.any(broken):
        raise ValueError(f"{_first(broken)}: {reason}")


def _first(broken: ArrayLike) -> str:
    """Number of the first broken pose from 1, and how many more there are."""
    indices = np.flatnonzero(np.atleast_1d(broken))
    more = f" (and {len(indices) - 1} more)" if len(indices) > 1 else ""
    return f"pose {indices[0] + 1}{more}"


_OPENGL_FROM_OPENCV = SE3(np.array([0.0, 1.0, 0.0, 0.0]), np.zeros(3))
"""Half a rotation about x; its own inverse."""
