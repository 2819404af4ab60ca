"""Poses in text files of 4x4 numbers, as 7-Scenes and 12-Scenes have them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.frame import Frame

# Poses printed with few digits, or chained in float32, drift this far from a rotation.
_ROTATION_TOLERANCE = 1e-2


def tracked_frames(
    names: Sequence[str], images: Sequence[Path], files: Sequence[Path], camera: Camera
) -> tuple[Frame, ...]:
    """Frames with the poses of their files; those whose pose holds inf or nan are left out.

    Args:
        names: of the frames.
        images: their image files.
        files: their pose files, 4x4 base_from_camera in metres.
        camera: of all.

    Raises:
        InputError: a file that is missing or holds no pose.
    """
    matrices = np.empty((len(images), 4, 4))
    for matrix, file in zip(matrices, files, strict=True):
        matrix[...] = read_numbers(file, 16, "4x4 base_from_camera").reshape(4, 4)
    tracked = np.flatnonzero(np.isfinite(matrices).all(axis=(1, 2))).tolist()
    poses = _poses(matrices[tracked], [files[i] for i in tracked])
    return tuple(
        Frame(names[i], images[i], camera, base_from_camera)
        for i, base_from_camera in zip(tracked, poses, strict=True)
    )


def _poses(matrices: NDArray[np.float64], files: list[Path]) -> SE3:
    try:
        return SE3.from_matrix(matrices, _ROTATION_TOLERANCE)
    except ValueError:
        for matrix, file in zip(matrices, files, strict=True):
            try:
                SE3.from_matrix(matrix, _ROTATION_TOLERANCE)
            except ValueError as error:
                raise InputError(f"{file}: broken pose: {error}; mend or remove it") from None
        raise


def read_numbers(file: Path, count: int, what: str) -> NDArray[np.float64]:
    """The numbers of a small text file.

    Raises:
        InputError: no such file, or not `count` numbers.
    """
    # Plain float() on the words: np.loadtxt takes longer per file than reading the file.
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
