"""What the numbers of a stated pose would be if they were written with a usual mistake."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

from evercal.geometry import SE3
from evercal.recordings.poses.conventions import (
    CONVENTIONS,
    OPENGL_FROM_OPENCV,
    PoseConvention,
    poses_from_numbers,
)


def readings(numbers: Sequence[float], stated: PoseConvention) -> dict[str, SE3]:
    """Poses by mistake in words: first as stated, by none, then without one mistake each."""
    length = replace(stated, metres_per_unit=0.001 / stated.metres_per_unit)
    conventions = {"": stated, "other unit of length": length}
    if stated.has_angles:
        angles = replace(stated, degrees=not stated.degrees)
        conventions["other unit of angles"] = angles
    for name, other in CONVENTIONS.items():
        if other.metres_per_unit == 1 and other.layout != stated.layout:
            conventions[f"written as {name}"] = other
    found = {}
    for words, convention in conventions.items():
        with suppress(ValueError):
            pose = poses_from_numbers(numbers, convention)
            found[words] = pose
            if not words:
                found["inverse"] = pose.inverse()
                found["opengl"] = pose @ OPENGL_FROM_OPENCV
    return found
