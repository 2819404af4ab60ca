"""What tests of many readers assert."""

from collections.abc import Callable

import pytest

from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance


def assert_pose(pose: SE3 | None, expected: SE3, tolerance: float = 1e-9) -> None:
    """A pose is there, and within a tolerance in metres and radians."""
    assert pose is not None
    assert max(pose_distance(pose, expected)) < tolerance


def with_orientation(jpeg: bytes, value: int) -> bytes:
    """The same JPEG with EXIF data that hold only an orientation."""
    tiff = (
        b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0" + bytes([value]) + bytes(6)
    )
    body = b"Exif\0\0" + tiff
    return jpeg[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + jpeg[2:]


def refused(
    message: str, read: Callable[..., object], *words: object, **options: object
) -> None:
    """Reading is refused with a message that matches."""
    with pytest.raises(InputError, match=message):
        read(*words, **options)
