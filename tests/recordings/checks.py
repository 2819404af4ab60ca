"""What tests of many readers assert."""

from collections.abc import Callable

import pytest

from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance


def assert_pose(pose: SE3 | None, expected: SE3, tolerance: float = 1e-9) -> None:
    """A pose is there, and within a tolerance in metres and radians."""
    assert pose is not None
    assert max(pose_distance(pose, expected)) < tolerance


def refused(message: str, read: Callable[..., object], *words: object, **options: object) -> None:
    """Reading is refused with a message that matches."""
    with pytest.raises(InputError, match=message):
        read(*words, **options)
