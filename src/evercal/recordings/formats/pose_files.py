"""Text files with one 4x4 pose each, as in 7-Scenes and 12-Scenes."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.frame import Frame

# Poses printed with few digits, or chained in float32, deviate this much from a rotation.
_ROTATION_TOLERANCE = 1e-2


def tracked_frames(
    names: Sequence[str], images: Sequence[Path], files: Sequence[Path], camera: Camera
) -> tuple[Frame, ...]:
    """Build frames from pose files and drop poses with inf or nan.

    Args:
        names: (n,) frame names.
        images: (n,) image files.
        files: (n,) pose files, 4x4 base_from_camera in metres.
        camera: Intrinsics of all images.

    Raises:
        InputError: A pose file is missing or broken.
    """
    frames = []
    for name, image, file in zip(names, images, files, strict=True):
        matrix = read_numbers(file, 16, "4x4 base_from_camera").reshape(4, 4)
        if np.isfinite(matrix).all():
            frames.append(Frame(name, image, camera, _pose(file, matrix)))
    return tuple(frames)


def _pose(file: Path, matrix: NDArray[np.float64]) -> SE3:
    try:
        return SE3.from_matrix(matrix, _ROTATION_TOLERANCE)
    except ValueError as error:
        raise InputError(f"{file}: broken pose: {error}; repair or remove it") from None


def read_numbers(file: Path, count: int, what: str) -> NDArray[np.float64]:
    """Read the numbers of a small text file.

    Raises:
        InputError: The file is missing or does not hold `count` numbers.
    """
    # float() on the words: np.loadtxt takes longer per file than reading the file.
    try:
        words = file.read_bytes().split()
    except OSError:
        raise InputError(f"{file}: missing; it holds the {what} matrix") from None
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        raise InputError(
            f"{file}: expected a {what} matrix of {count} numbers, got {len(words)} words"
        )
    return np.array(numbers)
