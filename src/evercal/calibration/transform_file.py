"""A rigid transform in a file: a calibration, or a 4x4 matrix as text."""

from pathlib import Path

import numpy as np

from evercal.calibration.calibration import read_calibration
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.storage.text_files import read_text
from evercal.typing import PathLike


def read_transform(path: PathLike) -> SE3:
    """Read a rigid transform from a calibration file or from a 4x4 matrix as text."""
    text = read_text(Path(path), "file")
    if text.lstrip().startswith("{"):
        return read_calibration(path).parent_from_child
    try:
        words = text.replace(",", " ").split()
        numbers = [float(word) for word in words]
        if len(numbers) != 16:
            raise ValueError(f"{len(numbers)} numbers, a 4x4 matrix has 16")
        return SE3.from_matrix(np.reshape(numbers, (4, 4)))
    except ValueError as error:
        raise InputError(
            f"{path}: {error}; give a 4x4 matrix as text, metres, or evercal's calibration JSON"
        ) from None
