"""Rows of numbers without names: those of a convention, or of columns that the caller states.

A stamp may come first.
"""

from functools import partial

import numpy as np

from evercal.recordings.poses.conventions import (
    Given,
    PoseConvention,
    matrix_convention,
    pose_convention,
)
from evercal.recordings.poses.likely_readings import WITHOUT_HEADER, undefined
from evercal.recordings.poses.pose_columns import POSITIONS, PoseTable, named_numbers
from evercal.recordings.poses.row_files import Names, in_unit
from evercal.typing import Array


def plain_numbers(numbers: Array, given: Given, names: Names = None) -> PoseTable:
    """Matrices (n, 4, 4) or (n, 3, 4), or numbers (n, k) or with stamps (n, 1 + k)."""
    if given and given.columns:
        return _under_header(numbers, given, names)
    if numbers.ndim != 2:
        given = given or pose_convention("matrix")
        if numbers.shape[1:] not in ((4, 4), (3, 4)) or not given.is_matrix:
            raise ValueError(
                f"poses are (n, 4, 4), (n, 3, 4) or (n, k) numbers, got {numbers.shape} for"
                f" {given.name} ({given.meaning})"
            )
        numbers = numbers.reshape(len(numbers), -1)
    width = numbers.shape[1]
    if not given and width in (12, 13, 16, 17):
        given = matrix_convention(numbers[:, width % 4 :])
    if not given:
        row = " ".join(f"{number:.4g}" for number in numbers[0])
        if names is not None:
            row = f"{names[0]!r} {row}"
        problem = f"no header says what the {width} columns are (first row: {row})"
        if width in (3, 4):
            raise ValueError(f"the numbers ({row}, ...) {POSITIONS}")
        raise undefined(
            problem, WITHOUT_HEADER, partial(plain_numbers, numbers, names=names)
        )
    numbers = _with_seconds(numbers, given)
    width = numbers.shape[1]
    stamps = None
    if width - 1 in given.counts:
        stamps = in_unit(numbers[:, 0])
        numbers = numbers[:, 1:]
    # A misplaced number shows in quaternions and matrices, but not in angles.
    misplaced = stamps is not None and given.has_angles and (np.diff(stamps) < 0).any()
    if numbers.shape[1] not in given.counts or misplaced:
        raise ValueError(
            f"rows have {width} numbers; {given.name} takes {' or '.join(map(str, given.counts))}"
            f" ({given.meaning}), optionally after a name and a stamp that increases"
        )
    return PoseTable(numbers, given, names, stamps)


def _under_header(numbers: Array, given: PoseConvention, names: Names) -> PoseTable:
    """Numbers (n, k) whose columns the caller states."""
    words = [*given.columns]
    if names is not None:
        words = [word for word in words if word not in ("image", "name", "file")]
    width = numbers.shape[-1]
    if words[-1:] == ["..."]:
        words[-1:] = [""] * (width + 1 - len(words))
    if len(words) != width:
        raise ValueError(
            f"rows have {width} numbers, and {len(words)} columns are stated; write ... for others"
        )
    table = named_numbers(words, numbers.astype(object), given)
    return table if names is None else table._replace(names=names)


def _with_seconds(numbers: Array, convention: PoseConvention) -> Array:
    """Numbers with one stamp in place of the seconds and nanoseconds of ROS."""
    stamps = numbers[:, :2]
    if numbers.shape[1] - 2 not in convention.counts or (stamps // [4e9, 1e9]).any():
        return numbers
    if (stamps % 1).any() or not stamps[:, 0].min() > 1e9:
        return numbers
    return np.c_[stamps @ [1, 1e-9], numbers[:, 2:]]
