"""Named pose conventions: how robots and programs write a pose as numbers.

A convention says which numbers stand in which order, in which unit, and how the rotation is meant.
Its name may be followed by modifiers: `kuka:m` (KUKA's angles, but metres), `matrix:inverse` (the
file holds gripper_from_base), `matrix:opengl` (camera axes x right, y up, z back). A unit that is
given in this way is taken as it is; one that a convention merely implies is doubted where the
numbers look like another (`doubt`).

    name      numbers                             unit       rotation
    wxyz      x y z qw qx qy qz                   m          unit quaternion
    xyzw      x y z qx qy qz qw                   m          unit quaternion, as ROS and TUM
    abb       X Y Z q1 q2 q3 q4                   mm         unit quaternion, q1 = w
    ur        x y z rx ry rz                      m, rad     rotation vector
    rpy       x y z roll pitch yaw                m, rad     Rz(yaw) Ry(pitch) Rx(roll), as URDF
    kuka      X Y Z A B C                         mm, deg    Rz(A) Ry(B) Rx(C)
    fanuc     X Y Z W P R                         mm, deg    Rz(R) Ry(P) Rx(W)
    yaskawa   X Y Z Rx Ry Rz                      mm, deg    Rz(Rz) Ry(Ry) Rx(Rx)
    staubli   X Y Z RX RY RZ                      mm, deg    Rx(RX) Ry(RY) Rz(RZ)
    matrix    16 numbers, row after row           m          homogeneous matrix
    franka    16 numbers, column after column     m          homogeneous matrix, libfranka's O_T_EE

The robots' rows were checked against Roboception's documentation of pose formats (ABB, FANUC, KUKA,
Yaskawa), Universal Robots' script manual, RoboDK's converters (Staubli) and libfranka's reference.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from evercal.geometry.se3 import SE3

Array = NDArray[np.float64]
Layout = Literal["wxyz", "xyzw", "rotation_vector", "euler", "rows", "columns"]

_NUMBERS: dict[Layout, int] = {
    "wxyz": 7,
    "xyzw": 7,
    "rotation_vector": 6,
    "euler": 6,
    "rows": 16,
    "columns": 16,
}
_FAR_M = 10.0
"""No gripper is farther than this from its base."""
_NEAR_M = 0.01
"""No recording has every gripper closer than this to its base."""
_UNIT_TOLERANCE = 1e-2
"""A quaternion printed with three digits is no farther than this from length one."""
_RIGID_TOLERANCE = 1e-2
"""A matrix printed with three digits is no farther than this from a rotation."""


@dataclass(frozen=True)
class PoseConvention:
    """How a pose is written as numbers."""

    name: str
    """With its modifiers, as the user gives it."""
    layout: Layout
    """What the numbers are: translation then rotation, or a matrix."""
    meaning: str
    """One line for people."""
    euler: str = ""
    """scipy's axes of the angles: lower case about fixed axes, upper case about moved ones."""
    degrees: bool = False
    """Whether angles are in degrees, else radians."""
    metres_per_unit: float = 1.0
    """0.001 for millimetres."""
    inverse: bool = False
    """Whether the numbers are the inverse of the pose that is wanted."""
    opengl: bool = False
    """Whether the camera's axes are x right, y up, z back, else OpenCV's."""
    length_stated: bool = False
    """Whether the user named the unit of length."""
    angle_stated: bool = False
    """Whether the user named the unit of angles."""

    @property
    def count(self) -> int:
        """How many numbers a pose has."""
        return _NUMBERS[self.layout]

    @property
    def has_angles(self) -> bool:
        """Whether it holds numbers in radians or degrees."""
        return self.layout in ("rotation_vector", "euler")


def _table() -> dict[str, PoseConvention]:
    rows = [
        PoseConvention("wxyz", "wxyz", "x y z qw qx qy qz, metres"),
        PoseConvention("xyzw", "xyzw", "x y z qx qy qz qw, metres, as ROS and TUM"),
        PoseConvention("abb", "wxyz", "X Y Z q1 q2 q3 q4, millimetres, q1 is w"),
        PoseConvention("ur", "rotation_vector", "x y z rx ry rz, metres, rotation vector"),
        PoseConvention("rpy", "euler", "x y z roll pitch yaw, metres, radians, as URDF", "xyz"),
        PoseConvention("kuka", "euler", "X Y Z A B C, mm, degrees, A about z", "ZYX"),
        PoseConvention("fanuc", "euler", "X Y Z W P R, mm, degrees, W about x", "xyz"),
        PoseConvention("yaskawa", "euler", "X Y Z Rx Ry Rz, mm, degrees, fixed axes", "xyz"),
        PoseConvention("staubli", "euler", "X Y Z RX RY RZ, mm, degrees, moved axes", "XYZ"),
        PoseConvention("matrix", "rows", "4x4 matrix row after row, metres"),
        PoseConvention("franka", "columns", "4x4 matrix column after column, metres (O_T_EE)"),
    ]
    millimetres = ("abb", "kuka", "fanuc", "yaskawa", "staubli")
    return {
        row.name: replace(row, metres_per_unit=0.001, degrees=row.has_angles)
        if row.name in millimetres
        else row
        for row in rows
    }


CONVENTIONS = _table()
"""All conventions by name, without modifiers."""
MODIFIERS = ("m", "mm", "rad", "deg", "inverse", "opengl")


def pose_convention(name: str) -> PoseConvention:
    """Finds a convention by its name with modifiers, such as `kuka:m:inverse`.

    Raises:
        ValueError: No such name, or a modifier that does not belong to it.
    """
    base, *modifiers = name.strip().lower().split(":")
    if base not in CONVENTIONS:
        raise ValueError(f"pose convention {name!r} is not known; use one of {known_conventions()}")
    found = replace(CONVENTIONS[base], name=":".join([base, *modifiers]))
    for modifier in modifiers:
        found = _modified(found, modifier)
    if len(set(modifiers)) < len(modifiers) or {"m", "mm"} <= {*modifiers}:
        raise ValueError(f"pose convention {name!r} says a thing twice; give each modifier once")
    if {"rad", "deg"} <= {*modifiers}:
        raise ValueError(f"pose convention {name!r} says a thing twice; give each modifier once")
    return found


def known_conventions() -> str:
    """The names for a message, with the modifiers."""
    names = ", ".join(CONVENTIONS)
    return f"{names}, with :m or :mm, :rad or :deg, :inverse, :opengl behind it where it is so"


def _modified(convention: PoseConvention, modifier: str) -> PoseConvention:
    if modifier in ("m", "mm"):
        scale = 0.001 if modifier == "mm" else 1.0
        return replace(convention, metres_per_unit=scale, length_stated=True)
    if modifier in ("rad", "deg"):
        if not convention.has_angles:
            raise ValueError(
                f"pose convention {convention.name!r}: it has no angles; leave :{modifier} out"
            )
        return replace(convention, degrees=modifier == "deg", angle_stated=True)
    if modifier in ("inverse", "opengl"):
        return replace(convention, **{modifier: True})
    raise ValueError(
        f"pose convention {convention.name!r}: modifier {modifier!r} is not known;"
        f" use one of {', '.join(MODIFIERS)}"
    )


def poses_from_numbers(numbers: ArrayLike, convention: PoseConvention) -> SE3:
    """Reads poses.

    Args:
        numbers: (..., `convention.count`).
        convention: how they are meant.

    Returns:
        (...) transforms in metres, camera axes as OpenCV's, not inverted.

    Raises:
        ValueError: A wrong count, numbers that are not finite, a quaternion that is not of length
            one, a matrix that is no rigid transform; the message names the first such pose.
    """
    numbers = np.asarray(numbers, dtype=np.float64)
    if numbers.shape[-1:] != (convention.count,):
        raise ValueError(
            f"a pose as {convention.name!r} has {convention.count} numbers"
            f" ({convention.meaning}), got {numbers.shape[-1] if numbers.ndim else 1}"
        )
    _refuse(~np.isfinite(numbers).all(-1), "a number is inf or nan; leave untracked poses out")
    if convention.layout in ("rows", "columns"):
        read = _from_matrices(numbers.reshape(*numbers.shape[:-1], 4, 4), convention)
    else:
        rotation = _rotations(numbers[..., 3:], convention)
        quaternion = rotation.as_quat(canonical=True, scalar_first=True)
        read = SE3(quaternion, numbers[..., :3] * convention.metres_per_unit)
    read = read.inverse() if convention.inverse else read
    return read @ _OPENGL_FROM_OPENCV if convention.opengl else read


def numbers_from_poses(poses: SE3, convention: PoseConvention) -> Array:
    """The reverse of `poses_from_numbers`.

    Quaternions get w >= 0. Where the middle angle of an Euler convention is within 1e-7 rad of
    gimbal lock, the third angle is 0 and the rotation is right to 2e-7 rad (scipy).

    Args:
        poses: (...).
        convention: how to write them.

    Returns:
        (..., `convention.count`).
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


def doubt(numbers: ArrayLike, convention: PoseConvention) -> str | None:
    """Why numbers do not look like the units of a convention, None if they do.

    Args:
        numbers: (n, `convention.count`) of one recording.
        convention: how they are meant; units that it states are believed.

    Returns:
        A sentence that says what they look like and what to give instead.
    """
    numbers = np.asarray(numbers, dtype=np.float64)
    if not convention.length_stated:
        distance = np.linalg.norm(_translations(numbers, convention), axis=-1)
        found = _doubt_lengths(distance * convention.metres_per_unit, convention)
        if found is not None:
            return found
    if convention.has_angles and not convention.angle_stated:
        return _doubt_angles(numbers[..., 3:], convention)
    return None


def _doubt_lengths(metres: Array, convention: PoseConvention) -> str | None:
    far = metres > _FAR_M
    near = (metres > 0) & (metres < _NEAR_M) & (convention.metres_per_unit < 1.0)
    odd = far if far.any() else near
    usual = metres[~odd]
    if odd.any() and len(usual) and 0.03 < np.median(usual) < 3.0:
        poses = ", ".join(str(i + 1) for i in np.flatnonzero(odd)[:5])
        return (
            f"positions are {np.median(usual):.3g} m from the base, but those of poses {poses} are"
            f" {metres[odd][0]:.3g} m; the file seems to mix millimetres and metres: write all of"
            f" them in one unit"
        )
    if far.any():
        seen = f"positions up to {metres.max():.4g} m from the base look like millimetres"
        return f"{seen}; {_instead(convention, 'mm', 'm')}"
    if near.any() and near.all():
        seen = f"all positions are within {1000 * metres.max():.2g} mm of the base"
        return f"{seen}, which looks like metres; {_instead(convention, 'm', 'mm')}"
    return None


def _doubt_angles(angles: Array, convention: PoseConvention) -> str | None:
    if convention.layout == "rotation_vector":
        angles = np.linalg.norm(angles, axis=-1)
    largest, turn = float(np.abs(angles).max(initial=0.0)), 2.0 * np.pi
    if not convention.degrees and largest > turn + 1e-6:
        seen = f"an angle of {largest:.4g} is more than a full turn in radians"
        return f"{seen}, so it looks like degrees; {_instead(convention, 'deg', 'rad')}"
    if convention.degrees and 0 < largest <= turn:
        seen = f"no angle is larger than {largest:.3g}"
        return f"{seen}, which looks like radians; {_instead(convention, 'rad', 'deg')}"
    return None


def _instead(convention: PoseConvention, likely: str, other: str) -> str:
    return (
        f"give --convention {_said(convention, likely)}"
        f" (or {_said(convention, other)} if the unit is right as it is)"
    )


def _said(convention: PoseConvention, unit: str) -> str:
    """The name of a convention with another unit."""
    kind = ("m", "mm") if unit in ("m", "mm") else ("rad", "deg")
    return ":".join([*(w for w in convention.name.split(":") if w not in kind), unit])


def _translations(numbers: Array, convention: PoseConvention) -> Array:
    if convention.layout == "rows":
        return numbers[..., [3, 7, 11]]
    return numbers[..., 12:15] if convention.layout == "columns" else numbers[..., :3]


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
    order = ("row after row", "matrix"), ("column after column", "franka")
    modifiers = convention.name.split(":")[1:]
    said, other = order if convention.layout == "rows" else order[::-1]
    _refuse(
        ~rows_fit & columns_fit,
        f"read {said[0]}, the last column is 0 0 0 1 and the last row holds the translation, so"
        f" it was written {other[0]}; give --convention {':'.join([other[1], *modifiers])}",
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


def _refuse(broken: ArrayLike, why: str) -> None:
    """Raises for the first pose that is broken, by its number from 1."""
    found = np.flatnonzero(np.atleast_1d(broken))
    if len(found):
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        raise ValueError(f"pose {found[0] + 1}{more}: {why}")


_OPENGL_FROM_OPENCV = SE3(np.array([0.0, 1.0, 0.0, 0.0]), np.zeros(3))
"""Half a turn about x; its own inverse."""
