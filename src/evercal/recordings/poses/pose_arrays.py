"""Arrays that hold poses: their shapes, matrices, and rotations with translations."""

import re
from collections.abc import Mapping
from itertools import product

import numpy as np

from evercal.geometry import rotation_error
from evercal.recordings.poses.conventions import Given
from evercal.recordings.poses.pose_columns import HEADERS, PoseTable, named_numbers
from evercal.recordings.poses.row_files import name_and_unit, number_array
from evercal.typing import Array, Record

Columns = Record
"""Values by key: of one pose, or lists of the values of all poses."""
Shape = tuple[int, ...]
"""Lengths of nested lists."""
_WIDTHS = (6, 7, 8, 12, 13, 16, 17)
"""Numbers of a pose, possibly after a stamp."""
MATRICES = ((4, 4), (3, 4))
"""Shapes of a rigid transform, with and without the row 0 0 0 1."""
_ROTATION = re.compile(
    r"(?:rotation_matri(?:x|ces)|rotations?|rot|rmats?|rvecs?|rotvecs?|r)(_.*)?"
)
_TRANSLATION = re.compile(
    r"(?:translation_vectors?|translations?|tvecs?|positions?|pos|t)(_.*)?"
)


def nested_shape(value: object) -> Shape:
    """Lengths of nested lists, by the first of each: all are compared when numbers are read."""
    if not isinstance(value, list):
        return ()
    if not value:
        return (0,)
    return (len(value), *nested_shape(value[0]))


def are_poses(key: str, shape: Shape, plural: bool) -> bool:
    """Whether an array of a shape holds matrices, or rows of numbers other than joint values."""
    are_matrices = shape[-2:] in MATRICES or shape[:2] in MATRICES
    if are_matrices:
        return True
    is_table = len(shape) == 2 and shape[1] in _WIDTHS
    return plural and is_table and "joint" not in key.lower()


def rotations_with_translations(
    shapes: Mapping[str, Shape], plural: bool
) -> list[tuple[str, str]]:
    """Keys of rotations and of translations that end alike."""
    rotations = {}
    translations = {}
    for key, shape in shapes.items():
        name = name_and_unit(key)[0]
        match = _ROTATION.fullmatch(name)
        if match and len(shape) > 1:
            rotations[key] = match[1]
        match = _TRANSLATION.fullmatch(name)
        if match and (len(shape) > 1 or (plural and shape)):
            translations[key] = match[1]
    pairs = product(rotations, translations)
    return [(r, t) for r, t in pairs if rotations[r] == translations[t]]


def composed_poses(
    columns: Columns, rotation: str, translation: str, given: Given
) -> PoseTable:
    """Poses of rotations (matrices, quaternions, vectors or angles) and translations."""
    unit = name_and_unit(translation)[1] or "m"
    words = [f"x_{unit}", f"y_{unit}", f"z_{unit}"]
    array = number_array(columns[translation], repr(translation))
    translations = _rows(array, 3)
    array = number_array(columns[rotation], repr(rotation))
    rotations = poses_first(array, ((3, 3),))
    width = rotations.size // max(len(translations), 1)
    if width == 9:
        words += [f"r{end}" for end in HEADERS["rotation matrix"].ends]
    elif width == 4:
        words += ["q1", "q2", "q3", "q4"]
    elif "vec" in rotation:
        words += ["rotvec_x", "rotvec_y", "rotvec_z"]
    else:
        words += ["rx", "ry", "rz"]
    rotations = _rows(rotations, width)
    numbers = np.concatenate([translations, rotations], -1)
    return named_numbers(words, numbers.astype(object), given)


def _rows(array: Array, width: int) -> Array:
    """(n, width) numbers of arrays with an axis too many, or with the poses last as in MATLAB."""
    array = np.squeeze(array)
    if array.ndim == 2:
        height, columns = array.shape
        if height == width != columns:
            array = array.T
    return array.reshape(-1, width)


def poses_first(array: Array, shapes: tuple[tuple[int, int], ...]) -> Array:
    """(n, rows, columns) matrices of an array that has the poses last, as in MATLAB."""
    if array.ndim != 3 or array.shape[:2] not in shapes:
        return array
    # Four matrices may lie along either axis: rotations are orthogonal along the right one.
    is_cube = array.shape[1:] in shapes
    if is_cube and rotation_error(array[..., :3, :3]).max() < 0.01:
        return array
    return np.moveaxis(array, -1, 0)
