"""A rigid transform in a file: a calibration, or a 4x4 matrix as text."""

from pathlib import Path

import numpy as np

from evercal.calibration.calibration import read_calibration
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.storage.text_files import read_text
from evercal.typing import Array, PathLike

_MOST_M = 50.0
"""Distance of a place from the base above which the unit is wrong."""


def read_transform(
    path: PathLike,
) -> SE3:
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


def read_place(
    text: str,
    accuracy: str,
) -> tuple[SE3, Array]:
    """A pose as seven numbers or in a file, and its covariance (6, 6) from `mm,deg` per axis."""
    try:
        sigma = np.array([*map(float, accuracy.split(","))]) * [1e-3, np.pi / 180]
        if not (sigma > 0).all() or accuracy.count(",") != 1:
            raise ValueError
    except ValueError:
        raise InputError(
            f"`board_accuracy` {accuracy}: give millimetres and degrees above 0, such as 1,0.2"
        ) from None
    numbers = text.split(",")
    if len(numbers) != 7:
        pose = read_transform(text)
    else:
        try:
            values = np.array([*map(float, numbers)])
            if abs(np.linalg.norm(values[3:]) - 1) > 0.01:
                raise ValueError
            pose = SE3(values[3:], values[:3])
        except ValueError:
            raise InputError(
                f"`board_at` {text}: give x,y,z in metres and a unit quaternion qw,qx,qy,qz, or the"
                " file of a 4x4 matrix"
            ) from None
    if np.linalg.norm(pose.translation_m) > _MOST_M:
        raise InputError(
            f"`board_at` {text}: is more than {_MOST_M:g} m from the base; give metres"
        )
    return pose, np.diag(np.repeat(np.square(sigma), 3))
