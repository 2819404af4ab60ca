"""Frames of 7-Scenes and 12-Scenes: frame-000000.color.png or .jpg and frame-000000.pose.txt."""

import itertools
import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.frame import Frame

# Poses printed with few digits, or chained in float32, deviate this much from a rotation.
_ROTATION_TOLERANCE = 1e-2


def colour_images(folder: Path) -> list[Path]:
    """Colour images of a folder, sorted by name.

    Raises:
        InputError: There are none, or a frame has two.
    """
    # os.listdir and one sort: globbing a thousand files twice dominates the loading time.
    names = os.listdir(folder) if folder.is_dir() else []
    names = sorted(name for name in names if re.search(r"\.color\.(png|jpe?g)$", name))
    if not names:
        raise InputError(f"{folder}: no images; expected frame-XXXXXX.color.png or .jpg")
    for first, second in itertools.pairwise(map(frame_name, names)):
        if first == second:
            raise InputError(f"{folder}: {first}.color is there as .png and as .jpg; keep one")
    return [folder / name for name in names]


def frame_name(image: str) -> str:
    """Name of a frame, such as frame-000000, from the name of its image."""
    return image[: image.rindex(".color.")]


def tracked_frames(
    names: Sequence[str], images: Sequence[Path], camera: Camera
) -> tuple[Frame, ...]:
    """Build frames from images and their pose files, and drop poses with inf or nan.

    Args:
        names: (n,) frame names.
        images: (n,) image files, each beside a 4x4 base_from_camera in metres.
        camera: Intrinsics of all images.

    Raises:
        InputError: A pose file is missing or broken.
    """
    frames = []
    for name, image in zip(names, images, strict=True):
        file = image.with_name(f"{frame_name(image.name)}.pose.txt")
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
