"""Named conventions for poses as numbers, as robots and programs write them.

A name may be followed by modifiers: `kuka:m` (KUKA's angles, but metres), `matrix:inverse`
(gripper_from_base), `matrix:opengl` (camera axes x right, y up, z back). Units in the name are
final; units that a convention only implies are checked against the numbers.

Sources: Roboception's documentation of pose formats (ABB, FANUC, KUKA, Yaskawa), Universal Robots'
script manual, RoboDK's converters (Staubli, Kawasaki) and libfranka's reference.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from difflib import get_close_matches
from itertools import chain, product

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from evercal.classes import frozen
from evercal.geometry import SE3, norms, rotation_error
from evercal.recordings.poses.row_files import by_alias
from evercal.typing import Array, BoolArray, JsonObject, Strings

_TOLERANCE = 1e-2
"""Error of a quaternion's length, or of R^T R, if printed with three digits."""
OPENGL_FROM_OPENCV = SE3(np.array([0.0, 1.0, 0.0, 0.0]), np.zeros(3))
"""Rotation between the camera axes of OpenGL and OpenCV; its own inverse."""
CAMERA_AXES = {
    "opengl": OPENGL_FROM_OPENCV,
    "x_forward": SE3(np.array([0.5, -0.5, 0.5, -0.5]), np.zeros(3)),
    "x_left": SE3(np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3)),
}
"""Rotation from OpenCV's camera axes to others, by modifier: OpenGL's; x forward, y left, z up
(SAPIEN, Isaac's world axes, ROS bodies); x left, y up, z forward (PyTorch3D, CoppeliaSim)."""


@frozen
class PoseConvention:
    """How numbers represent a pose."""

    name: str
    """Name with modifiers."""
    layout: str
    """`wxyz`, `xyzw`, `vector` or Euler axes of scipy after a position, else `rows`, `columns`."""
    meaning: str
    """Names of the numbers, units and axes, for messages."""
    metres_per_unit: float = 1.0
    """Length of a unit of the position."""
    degrees: bool = False
    """Whether angles are in degrees, else radians."""
    columns: Strings = ()
    """Columns of a table without a header, if the caller states them."""

    @property
    def base(self) -> str:
        """Name without modifiers."""
        return self.name.split(":")[0]

    @property
    def is_matrix(self) -> bool:
        """Whether the numbers are a matrix."""
        return self.layout in ("rows", "columns")

    @property
    def has_angles(self) -> bool:
        """Whether some numbers are in radians or degrees."""
        return not self.is_matrix and self.layout not in ("wxyz", "xyzw")

    @property
    def counts(self) -> tuple[int, ...]:
        """Possible lengths of a pose; matrices may lack the row 0 0 0 1."""
        if self.is_matrix:
            return (12, 16)
        if self.has_angles:
            return (6,)
        return (7,)

    def has(self, *modifiers: str) -> bool:
        """Whether the name has one of these modifiers."""
        return not set(modifiers).isdisjoint(self.name.split(":")[1:])

    @property
    def camera_axes(self) -> SE3 | None:
        """Rotation from OpenCV's camera axes to those of the poses, if they are others."""
        return next((CAMERA_AXES[name] for name in CAMERA_AXES if self.has(name)), None)

    @property
    def tag(self) -> str:
        """Number of the tag whose poses are meant; empty if the name has none."""
        return "".join(re.findall(r":tag(\d+)", self.name))


Given = PoseConvention | None
"""The convention that the caller states, if any."""


class ConventionError(ValueError):
    """A convention is missing or does not fit the numbers; `remedy` names others."""

    def __init__(self, problem: str, remedy: str) -> None:
        self.problem = problem
        self.remedy = remedy
        super().__init__(f"{problem}; give the convention {remedy}")


@contextmanager
def asking_for(option: str | None) -> Iterator[None]:
    """Name the argument, if there is one, in the message of a `ConventionError`."""
    try:
        yield
    except ConventionError as error:
        option = option or "the convention"
        raise ValueError(f"{error.problem}; give {option} {error.remedy}") from None


OF_COLUMNS = "columns"
"""Name of a convention that the stated columns of a table define."""
_CONVENTIONS = (
    PoseConvention("wxyz", "wxyz", "x y z qw qx qy qz, metres"),
    PoseConvention("xyzw", "xyzw", "x y z qx qy qz qw, metres, as ROS"),
    PoseConvention("tum", "xyzw", "stamp, then x y z qx qy qz qw, metres"),
    PoseConvention("abb", "wxyz", "X Y Z q1 q2 q3 q4, millimetres, q1 is w", 0.001),
    PoseConvention("ur", "vector", "x y z rx ry rz, metres, rotation vector"),
    PoseConvention("rpy", "xyz", "x y z roll pitch yaw, metres, radians, as URDF"),
    PoseConvention("kuka", "ZYX", "X Y Z A B C, mm, degrees, A about z", 0.001, True),
    PoseConvention("fanuc", "xyz", "X Y Z W P R, mm, degrees, W about x", 0.001, True),
    PoseConvention(
        "yaskawa", "xyz", "X Y Z Rx Ry Rz, mm, degrees, fixed axes", 0.001, True
    ),
    PoseConvention(
        "staubli", "XYZ", "X Y Z RX RY RZ, mm, degrees, moving axes", 0.001, True
    ),
    PoseConvention(
        "kawasaki", "ZYZ", "X Y Z O A T, mm, degrees, about z y z", 0.001, True
    ),
    PoseConvention("matrix", "rows", "4x4 or 3x4 matrix row after row, metres"),
    PoseConvention("franka", "columns", "matrix column after column, metres (O_T_EE)"),
)
CONVENTIONS = {convention.name: convention for convention in _CONVENTIONS}
"""All conventions by name, without modifiers."""
VENDORS = by_alias("""
yaskawa: mitsubishi denso techman jaka dobot aubo xarm
kuka: epson nachi
kawasaki: doosan comau
ur: universal_robots
yaskawa: motoman
""")
"""Further vendors and the convention, with its units, that each uses."""
_KNOWN = (
    "such as xyzw, ur, rpy, kuka or matrix, or the columns themselves, such as"
    " x,y,z,qw,qx,qy,qz (docs/formats.md#pose-files lists all)"
)
for _letters in product("xyz", repeat=3):
    _axes = "".join(_letters)
    if not re.search(r"(.)\1", _axes):
        _meaning = f"x y z and angles about {' '.join(_axes)}"
        _fixed = PoseConvention(f"fixed_{_axes}", _axes, f"{_meaning}, fixed axes")
        _moving = PoseConvention(
            f"moving_{_axes}", _axes.upper(), f"{_meaning}, moving axes"
        )
        CONVENTIONS |= {_fixed.name: _fixed, _moving.name: _moving}
UNITS: dict[str, JsonObject] = {
    "m": {"metres_per_unit": 1.0},
    "mm": {"metres_per_unit": 0.001},
    "rad": {"degrees": False},
    "deg": {"degrees": True},
}
"""What a unit changes of a convention."""


def pose_convention(name: str) -> PoseConvention:
    """Parse the name of a convention with modifiers, such as `kuka:m:inverse`.

    The columns of a table without a header may come first: `a,b,c,x,y,z:kuka`. If they define the
    convention, they are enough: `qw,qx,qy,qz,x,y,z,...:inverse`. Dots are further columns.
    """
    base, *modifiers = name.strip().lower().split(":")
    columns = ()
    if "," in base:
        columns = tuple(map(str.strip, base.split(",")))
        base = OF_COLUMNS
        if {*CONVENTIONS, *VENDORS}.intersection(modifiers[:1]):
            base = modifiers.pop(0)
    base = VENDORS.get(base, base)
    if base not in CONVENTIONS and not columns:
        problem = f"pose convention {name!r} is not known"
        for nearest in get_close_matches(base, [*CONVENTIONS, *VENDORS], 1):
            problem += f", {nearest} is"
        raise ConventionError(problem, f"NAME, {_KNOWN}")
    name = ":".join([base, *modifiers])
    stated = CONVENTIONS.get(base, PoseConvention(base, "", "what the columns define"))
    convention = replace(stated, name=name, columns=columns)
    kinds = [("m", "mm"), ("inverse",), tuple(CAMERA_AXES)]
    if convention.has_angles:
        kinds.insert(1, ("rad", "deg"))
    known = [*chain(*kinds)]
    for modifier in modifiers:
        if modifier not in known and not re.fullmatch(r"tag\d+", modifier):
            raise ValueError(
                f"pose convention {name!r}: {modifier!r} is not one of {', '.join(known)}"
            )
        convention = replace(convention, **UNITS.get(modifier, {}))
    for kind in kinds:
        if sum(map(modifiers.count, kind)) > 1:
            raise ValueError(
                f"pose convention {name!r} repeats a modifier; give each kind once"
            )
    return convention


def poses_from_numbers(
    numbers: ArrayLike, convention: PoseConvention, camera_from: bool = False
) -> SE3:
    """Convert numbers (..., k), k of `convention.counts`, to poses (...).

    Poses are in metres with OpenCV's camera axes, not inverted. The camera's frame is the second of
    the pose, or the first with `camera_from` (camera_from_board); only camera axes depend on it.
    ValueError: numbers are no pose; the message names the first of them.
    """
    numbers = np.asarray(numbers, float)
    width = numbers.shape[-1] if numbers.ndim else 1
    if width not in convention.counts:
        raise ValueError(
            f"a pose as {convention.name!r} has {' or '.join(map(str, convention.counts))} numbers"
            f" ({convention.meaning}), got {width}"
        )
    finite = np.isfinite(numbers).all(-1)
    _refuse(~finite, "a number is inf or nan; leave untracked poses out")
    if convention.is_matrix:
        poses = _from_matrices(numbers, convention)
    else:
        quaternion = _rotations(numbers[..., 3:], convention).as_quat(scalar_first=True)
        poses = SE3(quaternion, numbers[..., :3] * convention.metres_per_unit)
    if convention.has("inverse"):
        poses = poses.inverse()
    axes = convention.camera_axes
    if not axes:
        return poses
    if camera_from:
        return axes.inverse() @ poses
    return poses @ axes


def numbers_from_poses(poses: SE3, convention: PoseConvention) -> Array:
    """Convert poses (...) to numbers (..., k), k the largest of `convention.counts`.

    Quaternions get w >= 0. In gimbal lock the third angle is 0.
    """
    axes = convention.camera_axes
    if axes:
        poses = poses @ axes.inverse()
    if convention.has("inverse"):
        poses = poses.inverse()
    translation = poses.translation_m / convention.metres_per_unit
    layout = convention.layout
    degrees = convention.degrees
    if convention.is_matrix:
        matrix = poses.matrix()
        matrix[..., :3, 3] = translation
        if layout == "columns":
            matrix = np.swapaxes(matrix, -1, -2)
        return matrix.reshape(*poses.shape, 16)
    rotation = Rotation.from_quat(poses.rotation_wxyz, scalar_first=True)
    if layout == "vector":
        numbers = rotation.as_rotvec(degrees=degrees)
    elif convention.has_angles:
        numbers = rotation.as_euler(layout, degrees=degrees, suppress_warnings=True)
    else:
        numbers = rotation.as_quat(canonical=True, scalar_first=layout == "wxyz")
    return np.concatenate([translation, numbers], axis=-1)


def matrix_convention(numbers: Array) -> Given:
    """`matrix` or `franka`, whichever makes rigid transforms of (n, 12 or 16) numbers, if any."""
    in_rows = _rigid(matrices_from_numbers(numbers, "rows")).all()
    in_columns = _rigid(matrices_from_numbers(numbers, "columns")).all()
    width = numbers.shape[-1]
    problem = f"rows of {width} numbers are rigid transforms in"
    if in_rows and not in_columns:
        return CONVENTIONS["matrix"]
    if in_columns and not in_rows:
        if width == 16:
            return CONVENTIONS["franka"]
        raise ConventionError(
            f"{problem} columns, or rotations in rows before x y z",
            "franka (column after column), or a header r11,r12,r13,r21,r22,r23,r31,r32,r33,x,y,z",
        )
    if not in_rows:
        return None
    raise ConventionError(
        f"{problem} both orders",
        "matrix (row after row) or franka (column after column)",
    )


def _rotations(numbers: Array, convention: PoseConvention) -> Rotation:
    if convention.layout == "vector":
        return Rotation.from_rotvec(numbers, degrees=convention.degrees)
    if convention.has_angles:
        return Rotation.from_euler(
            convention.layout, numbers, degrees=convention.degrees
        )
    length = norms(numbers)
    _refuse(
        np.abs(length - 1.0) > _TOLERANCE,
        f"the quaternion is not of length 1 (shortest {length.min(initial=1.0):.4g}, longest"
        f" {length.max(initial=1.0):.4g}); check which columns hold it",
    )
    return Rotation.from_quat(numbers, scalar_first=convention.layout == "wxyz")


def matrices_from_numbers(numbers: Array, layout: str) -> Array:
    """(..., 3 or 4, 4) matrices of numbers (..., 12 or 16)."""
    *shape, count = numbers.shape
    height = count // 4
    if layout == "rows":
        return numbers.reshape(*shape, height, 4)
    columns = numbers.reshape(*shape, 4, height)
    return np.swapaxes(columns, -1, -2)


def _rigid(matrices: Array) -> BoolArray:
    """(...) whether matrices (..., 3 or 4, 4) are rigid transforms."""
    block = matrices[..., :3, :3]
    drift = rotation_error(block)
    orthogonal = drift.max((-1, -2), initial=0.0) < _TOLERANCE
    proper = np.linalg.det(block) > 0
    drift = np.abs(matrices[..., 3:, :] - (0.0, 0.0, 0.0, 1.0))
    homogeneous = drift.max((-1, -2), initial=0.0) < 1e-6
    return orthogonal & proper & homogeneous


def _from_matrices(numbers: Array, convention: PoseConvention) -> SE3:
    other = "franka"
    order = "column after column"
    if convention.base == other:
        other = "matrix"
        order = "row after row"
    matrices = matrices_from_numbers(numbers, convention.layout)
    broken = ~_rigid(matrices)
    transposed = matrices_from_numbers(numbers, CONVENTIONS[other].layout)
    if broken.any() and _rigid(transposed).all():
        remedy = convention.name.replace(convention.base, other)
        raise ConventionError(f"the matrices are written {order}", remedy)
    _refuse(
        broken,
        f"no rigid transform as {convention.base}: the last row is not 0 0 0 1, or the left 3x3"
        f" block is no rotation but holds a scale or a reflection",
    )
    poses = SE3.from_matrix(matrices, _TOLERANCE)
    return SE3(poses.rotation_wxyz, poses.translation_m * convention.metres_per_unit)


def _refuse(broken: ArrayLike, reason: str) -> None:
    """Raise ValueError for the first of broken poses (...)."""
    indices = np.flatnonzero(broken)
    if not len(indices):
        return
    first, *others = indices + 1
    pose = f"pose {first}"
    if others:
        pose += f" (and {len(others)} more)"
    raise ValueError(f"{pose}: {reason}")
