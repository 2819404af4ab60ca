"""What the numbers of a stated pose would be if they were written with a usual mistake."""

from collections.abc import Sequence
from contextlib import suppress
from itertools import product

from evercal.geometry import SE3
from evercal.recordings.poses.conventions import (
    CONVENTIONS,
    PoseConvention,
    pose_convention,
    poses_from_numbers,
)
from evercal.typing import Strings

Reading = tuple[Strings, SE3]
"""Mistakes in words, none as stated, and the pose without them."""
_INVERTED = ("inverse", "opengl")
"""Modifiers that one convention has and another lacks."""


def readings(numbers: Sequence[float], stated: PoseConvention) -> list[Reading]:
    """Poses of numbers by the stated convention and by others, the fewest mistakes first."""
    layouts = {stated.layout: stated.base}
    for name, base in CONVENTIONS.items():
        if len(numbers) in base.counts and base.metres_per_unit == 1:
            layouts.setdefault(base.layout, name)
    units = (":m", ":mm"), (":rad", ":deg") if stated.has_angles else ("",)
    found = []
    for parts in product(layouts.values(), ("", ":inverse"), ("", ":opengl"), *units):
        other = pose_convention("".join(parts))
        with suppress(ValueError):
            pose = poses_from_numbers(numbers, other)
            found.append((_differences(stated, other), pose))
    return sorted(found, key=lambda reading: len(reading[0]))


def _differences(stated: PoseConvention, other: PoseConvention) -> Strings:
    words = [word for word in _INVERTED if stated.has(word) != other.has(word)]
    if stated.layout != other.layout:
        words.append(f"written as {other.base}")
    if stated.metres_per_unit != other.metres_per_unit:
        words.append("other unit of length")
    if stated.degrees != other.degrees:
        words.append("other unit of angles")
    return tuple(words)
