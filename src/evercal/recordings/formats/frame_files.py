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
from evercal.recordings.text_files import read_text

# Poses printed with few digits, or chained in float32, deviate this much from a rotation.
_ROTATION_TOLERANCE = 1e-2


def colour_images(folder: Path) -> list[Path]:
    """Colour images of a folder, sorted by name."""
    # os.listdir and one sort: globbing a thousand files twice dominates the loading time.
    names = os.listdir(folder) if folder.is_dir() else []
    names = sorted(name for name in names if re.search(r"\.color\.(png|jpe?g)$", name))
    if not names:
        raise InputError(f"{folder}: no images; expected frame-XXXXXX.color.png or .jpg")
    for first, second in itertools.pairwise(map(_frame_name, names)):
        if first == second:
            raise InputError(f"{folder}: {first}.color is there as .png and as .jpg; keep one")
    return [folder / name for name in names]


def _frame_name(image: str) -> str:
    return image[: image.rindex(".color.")]


def tracked_frames(
    images: Sequence[Path], camera: Camera, folders: bool = False
) -> tuple[Frame, ...]:
    """Build frames from images and the pose files beside them, and drop poses with inf or nan.

    With `folders`, names of frames begin with the name of the folder.
    """
    frames = []
    for image in images:
        name = _frame_name(image.name)
        file = image.with_name(f"{name}.pose.txt")
        matrix = read_numbers(file, 16, "4x4 base_from_camera").reshape(4, 4)
        if np.isfinite(matrix).all():
            try:
                pose = SE3.from_matrix(matrix, _ROTATION_TOLERANCE)
            except ValueError as error:
                raise InputError(f"{file}: broken pose: {error}; repair or remove it") from None
            name = f"{image.parent.name}/{name}" if folders else name
            frames.append(Frame(name, image, camera, pose))
    return tuple(frames)


def read_numbers(file: Path, count: int, what: str) -> NDArray[np.float64]:
    """Read the `count` numbers of a matrix from a small text file."""
    # float() on the words: np.loadtxt takes longer per file than reading the file.
    words = read_text(file, f"{what} matrix").split()
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        numbers = np.empty(0)
    if len(numbers) != count:
        raise InputError(
            f"{file}: expected a {what} matrix of {count} numbers, got {len(words)} words"
        )
    return numbers
