"""Poses of numbers whose units are plausible."""

import numpy as np

from evercal.geometry import norms
from evercal.geometry.se3 import SE3
from evercal.recordings.poses.conventions import (
    ConventionError,
    PoseConvention,
    matrices_from_numbers,
    poses_from_numbers,
)
from evercal.typing import Array

_MAX_REACH_M = 10.0
"""Largest distance of a gripper from its base, metres."""
_MIN_REACH_M = 0.01
"""Smallest distance of a gripper from its base, metres; at least one pose exceeds it."""
_MAX_DEG = 361.0
"""Largest angle, degrees: a rotation, and some rounding."""
_UNIT_NAMES = {"m": "metres", "mm": "millimetres", "rad": "radians", "deg": "degrees"}
"""Words for units in messages."""


def checked_poses(
    numbers: Array, convention: PoseConvention, camera_from: bool = False
) -> SE3:
    """`poses_from_numbers` of (n, k) numbers of plausible size.

    ValueError: they look like another unit than the convention only implies.
    """
    poses = poses_from_numbers(numbers, convention, camera_from)
    if not convention.has("m", "mm"):
        positions = numbers[..., :3]
        if convention.is_matrix:
            positions = matrices_from_numbers(numbers, convention.layout)[..., :3, 3]
        _check_lengths(norms(positions), convention)
    if not convention.has_angles:
        return poses
    angles = np.abs(numbers[..., 3:])
    if convention.layout == "vector":
        angles = norms(angles)
    largest = float(angles.max(initial=0.0))
    if convention.degrees and largest > _MAX_DEG:
        raise ValueError(
            f"angles up to {largest:.4g} deg; do columns hold {convention.meaning}?"
        )
    if not largest > 0 or convention.has("rad", "deg"):
        return poses
    units = ("deg", "rad")
    if convention.degrees:
        units = ("rad", "deg")
    if convention.degrees != (largest > 2 * np.pi + 1e-6):
        problem = f"angles up to {largest:.4g} look like"
        raise _other_unit(*units, problem, convention)
    return poses


def _check_lengths(lengths: Array, convention: PoseConvention) -> None:
    """Refuse distances (n,) from the base that arms do not have."""
    metres = lengths * convention.metres_per_unit
    far = metres > _MAX_REACH_M
    near = (metres > 0) & (metres < _MIN_REACH_M)
    near &= convention.metres_per_unit < 1.0
    odd = far if far.any() else near
    usual = metres[~odd]
    median = float(np.median(usual)) if len(usual) else 0.0
    if odd.any() and 0.03 < median < 3.0:
        numbers = np.flatnonzero(odd) + 1
        poses = ", ".join(numbers[:5].astype(str))
        raise ValueError(
            f"positions are {median:.3g} m from the base, but those of poses {poses} are"
            f" {metres[odd][0]:.3g} m; millimetres and metres may be mixed: write all in one unit"
        )
    problem = f"positions up to {metres.max(initial=0.0):.4g} m from the base look like"
    if far.any():
        raise _other_unit("mm", "m", problem, convention)
    if near.any() and near.all():
        raise _other_unit("m", "mm", problem, convention)


def _other_unit(
    unit: str, other: str, problem: str, convention: PoseConvention
) -> ConventionError:
    """An error that offers the convention in a likely unit, and in the other one."""
    words = convention.name.split(":")
    base = ":".join(word for word in words if word not in (unit, other))
    remedy = f"{base}:{unit} (or {base}:{other} if the unit is right as it is)"
    return ConventionError(f"{problem} {_UNIT_NAMES[unit]}", remedy)
