"""Pose files: a table (CSV, TUM), JSON or NPY, in a named convention.

The header of a table names its columns (`pose_table`, `row_files`). JSON is a list of objects with
`translation_m` and `quaternion_wxyz`, or `matrix`, or a list of lists of numbers; it may stand
under `poses`. NPY is (n, 4, 4), or (n, k) numbers. A convention is required if the file does not
define the meaning of its numbers. docs/formats.md has examples.
"""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.conventions import (
    KNOWN_CONVENTIONS,
    ConventionError,
    PoseConvention,
    check_units,
    pose_convention,
    poses_from_numbers,
)
from evercal.recordings.poses.pose_table import PoseTable, read_pose_table
from evercal.recordings.poses.row_files import number_array, row_labels
from evercal.recordings.text_files import read_text


@dataclass(frozen=True, eq=False)
class RobotPoses:
    """Poses in the order of their file."""

    names: tuple[str, ...] | None
    """(n,) unique names of images or rows, if the file has any."""
    stamps_s: NDArray[np.float64] | None
    """(n,) seconds, if the file has any."""
    poses: SE3
    """(n,) base_from_gripper, or the transforms that the file holds instead."""

    def __len__(self) -> int:
        """Number of poses."""
        return len(self.poses)


def read_robot_poses(
    path: str | os.PathLike[str],
    convention: str | None = None,
    *,
    what: str = "file of robot poses",
    option: str | None = None,
) -> RobotPoses:
    """Read a pose file; `what` and the command line `option` of the convention are for messages.

    Args:
        path: A `.json` or `.npy` file; other endings are read as a table.
        convention: Convention of the numbers, such as `kuka`, `ur` or `matrix:mm`, or `tum` for
            xyzw after a stamp. Required if the file does not define it.
        what: Kind of file.
        option: Option such as `--convention`.

    Raises:
        InputError: The file is missing or broken, or the numbers do not fit the convention.
    """
    path = Path(path)
    try:
        given = _convention(convention, path)
        if path.suffix.lower() == ".npy":
            numbers = np.asarray(np.load(path, allow_pickle=False), dtype=np.float64)
            one_pose = numbers.shape == (4, 4)
            return _robot_poses(_array_table(numbers[None] if one_pose else numbers, given))
        text = read_text(path, what)
        if path.suffix.lower() == ".json":
            return _robot_poses(_json_table(json.loads(text), given))
        return _robot_poses(read_pose_table(text, given))
    except FileNotFoundError:
        raise InputError(f"{path}: {what} is missing; check the path") from None
    except OSError as error:
        raise InputError(f"{path}: {what} cannot be read ({error.strerror})") from None
    except ConventionError as error:
        raise InputError(f"{path}: {error.naming(option)}") from None
    except (ValueError, EOFError, TypeError) as error:  # also invalid JSON and arrays of text
        raise InputError(f"{path}: {error}") from None


def _convention(given: str | None, path: Path) -> PoseConvention | None:
    if given is None:
        return pose_convention("xyzw") if path.suffix.lower() == ".tum" else None
    base, colon, modifiers = given.strip().lower().partition(":")
    return pose_convention("xyzw" + colon + modifiers if base == "tum" else given)


def _robot_poses(table: PoseTable) -> RobotPoses:
    if not len(table.numbers):
        raise ValueError("no pose in it")
    poses = poses_from_numbers(table.numbers, table.convention)
    check_units(table.numbers, table.convention)
    if table.names is not None:
        repeated = [name for i, name in enumerate(table.names) if name in table.names[:i]]
        if repeated:
            raise ValueError(f"the name {repeated[0]!r} comes twice; names are unique")
    if table.stamps_s is not None and not np.isfinite(table.stamps_s).all():
        raise ValueError("a stamp is inf or nan; leave such rows out")
    return RobotPoses(table.names, table.stamps_s, poses)


def _array_table(numbers: NDArray[np.float64], given: PoseConvention | None) -> PoseTable:
    if numbers.ndim == 3:
        convention = given or pose_convention("matrix")
        return PoseTable(_matrices(numbers, convention), convention)
    if numbers.ndim != 2:
        raise ValueError(f"poses are (n, 4, 4) or (n, k) numbers, got shape {numbers.shape}")
    if given is None:
        raise ConventionError(
            f"{numbers.shape[1]} numbers do not define a pose",
            f"NAME, one of {KNOWN_CONVENTIONS}",
        )
    return PoseTable(numbers, given)


def _json_table(data: object, given: PoseConvention | None) -> PoseTable:
    if isinstance(data, Mapping) and "poses" in data:
        table = _json_table(data["poses"], given)
        lists = {k: v for k, v in data.items() if k != "poses" and isinstance(v, list)}
        names, stamps = row_labels(lists, len(table.numbers), plural=True)
        return replace(
            table,
            names=names if table.names is None else table.names,
            stamps_s=stamps if table.stamps_s is None else table.stamps_s,
        )
    entries = [data] if isinstance(data, Mapping) else data
    if isinstance(entries, list) and entries:
        if all(isinstance(entry, list) for entry in entries):
            return _array_table(number_array(entries, "a list of poses"), given)
        if all(isinstance(entry, Mapping) for entry in entries):
            return _object_table(entries, given)
    raise ValueError("JSON of poses is a list of objects, or of lists of numbers, not of both")


def _object_table(
    entries: Sequence[Mapping[str, object]], given: PoseConvention | None
) -> PoseTable:
    if all("matrix" in entry for entry in entries):
        convention = given or pose_convention("matrix")
        matrices = number_array([entry["matrix"] for entry in entries], "'matrix'")
        numbers = matrices if matrices.ndim == 2 else _matrices(matrices, convention)
    elif all({"translation_m", "quaternion_wxyz"} <= entry.keys() for entry in entries):
        convention = given or pose_convention("wxyz")
        if convention.layout != "wxyz":
            raise ValueError(
                f"'translation_m' and 'quaternion_wxyz' contradict the convention"
                f" {convention.name}; leave it out, or give wxyz:inverse"
            )
        parts = [
            number_array([entry[key] for entry in entries], f"'{key}'")
            for key in ("translation_m", "quaternion_wxyz")
        ]
        if [part.shape[1:] for part in parts] != [(3,), (4,)]:
            raise ValueError("'translation_m' has three numbers and 'quaternion_wxyz' four")
        numbers = np.concatenate(parts, axis=-1)
    else:
        raise ValueError(
            "every pose has 'translation_m' and 'quaternion_wxyz', or every pose 'matrix'"
        )
    columns = {key: [entry.get(key) for entry in entries] for entry in entries for key in entry}
    return PoseTable(numbers, convention, *row_labels(columns, len(entries)))


def _matrices(matrices: NDArray[np.float64], convention: PoseConvention) -> NDArray[np.float64]:
    """(n, 4, 4) as (n, 16), refused in other conventions."""
    if matrices.shape[1:] != (4, 4):
        raise ValueError(f"a matrix is 4x4, got {' x '.join(map(str, matrices.shape[1:]))}")
    if convention.layout not in ("rows", "columns"):
        raise ValueError(
            f"it holds 4x4 matrices, and the convention {convention.name} means"
            f" {convention.meaning}; give matrix or franka, or leave it out"
        )
    return matrices.reshape(-1, 16)
