"""Pose files: a table (CSV, TUM, text), JSON, NPY or NPZ, in a named convention.

JSON is a list of objects with `translation_m` and `quaternion_wxyz`, with `matrix`, or with numbers
named like the columns of a table. It may also be a list of lists of numbers, as NPY and NPZ. Poses
and lists of names or times may stand under keys. A convention is required if the file does not
define the meaning of its numbers. docs/formats.md has examples.
"""

import json
import os
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.conventions import (
    ConventionError,
    PoseConvention,
    check_units,
    pose_convention,
    poses_from_numbers,
)
from evercal.recordings.poses.pose_table import (
    PoseTable,
    named_numbers,
    plain_numbers,
    read_pose_table,
)
from evercal.recordings.poses.row_files import arrays_as_lists, number_array, row_labels
from evercal.recordings.text_files import read_text

_KEYS = ("poses", "base_from_gripper", "camera_from_board", "T", "transforms", "matrices")
"""Keys of poses in JSON and NPZ."""
_WIDTHS = (6, 7, 8, 12, 13, 16, 17)
"""Numbers of a pose, possibly after a stamp."""
_LISTS = {"translation_m": ("x_m", "y_m", "z_m"), "quaternion_wxyz": ("qw", "qx", "qy", "qz")}
"""Columns of lists in JSON."""


@dataclass(frozen=True, eq=False)
class RobotPoses:
    """Poses in the order of their file."""

    names: tuple[str, ...] | None
    """(n,) unique names of images or rows, if the file has any."""
    stamps_s: NDArray[np.float64] | None
    """(n,) seconds, if the file has any."""
    poses: SE3
    """(n,) base_from_gripper, or the transforms that the file holds instead."""
    numbers: NDArray[np.float64] | None = None
    """(n, k) numbers of the file, to be read by `poses_from_numbers`."""
    convention: PoseConvention | None = None
    """Convention of the numbers. None, also of the numbers, if the file's keys state all of it."""

    def __len__(self) -> int:
        """Number of poses."""
        return len(self.poses)


def read_robot_poses(
    path: str | os.PathLike[str],
    convention: str | None = None,
    *,
    what: str = "file of robot poses",
    option: str | None = None,
    camera_from: bool = False,
) -> RobotPoses:
    """Read a pose file.

    Args:
        path: A `.json`, `.npy` or `.npz` file; other endings are read as a table.
        convention: Convention of the numbers, such as `kuka`, `ur` or `matrix:mm`. Required if the
            file does not define it.
        what: Kind of file, for messages.
        option: Option of the convention, such as `--convention`, for messages.
        camera_from: Whether the file states camera_from_something, for `:opengl`.

    Raises:
        InputError: The file is missing or broken, or the numbers do not fit the convention.
    """
    path = Path(path)
    ending = path.suffix.lower()
    try:
        name = "tum" if convention is None and ending == ".tum" else convention
        given = None if name is None else pose_convention(name)
        if ending in (".npy", ".npz"):
            table = _data_table(arrays_as_lists(path), given)
        elif ending == ".json":
            table = _data_table(json.loads(read_text(path, what)), given)
        else:
            table = read_pose_table(read_text(path, what), given)
        return _robot_poses(table, camera_from)
    except FileNotFoundError:
        raise InputError(f"{path}: {what} is missing; check the path") from None
    except OSError as error:
        raise InputError(f"{path}: {what} cannot be read ({error.strerror})") from None
    except ConventionError as error:
        raise InputError(f"{path}: {error.naming(option)}") from None
    except (ValueError, EOFError, TypeError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: {error}") from None  # also invalid JSON and arrays of text


def _robot_poses(table: PoseTable, camera_from: bool) -> RobotPoses:
    numbers, convention, names, stamps, fixed = table
    if not len(numbers):
        raise ValueError("no pose in it")
    poses = poses_from_numbers(numbers, convention, camera_from)
    check_units(numbers, convention)
    repeated = [name for i, name in enumerate(names or ()) if name in (names or ())[:i]]
    if repeated:
        raise ValueError(f"the name {repeated[0]!r} comes twice; names are unique")
    return RobotPoses(names, stamps, poses, *((None, None) if fixed else (numbers, convention)))


def _data_table(data: Any, given: PoseConvention | None) -> PoseTable:
    """Poses in lists and mappings, as in JSON."""
    if isinstance(data, Mapping) and not {"matrix", "translation_m"} & data.keys():
        key = _pose_key(data)
        table = _data_table(data[key], given)
        columns = {k: v for k, v in data.items() if k != key and isinstance(v, list)}
        return _labelled(table, columns, plural=True)
    entries = data if isinstance(data, list) else [data]
    if entries and all(isinstance(entry, list) for entry in entries):
        numbers = number_array(entries, "a list of poses")
        single = numbers.shape in ((4, 4), (3, 4))
        return plain_numbers(numbers[None] if single else numbers, given)
    if not entries or not all(isinstance(entry, Mapping) for entry in entries):
        raise ValueError("poses are a list of objects, or of lists of numbers, not of both")
    keys = dict.fromkeys(key for entry in entries for key in entry)
    columns = {key: [entry.get(key) for entry in entries] for key in keys}
    if all("matrix" in entry for entry in entries):
        return _labelled(_data_table(columns["matrix"], given), columns)
    rows = [_flat(entry) for entry in entries]
    words = [*rows[0]]
    cells = np.array([[str(row.get(word)) for word in words] for row in rows])
    table = named_numbers(words, cells, given)
    return _labelled(table, columns)._replace(fixed="quaternion_wxyz" in columns)


def _labelled(
    table: PoseTable, columns: Mapping[str, Sequence[object]], plural: bool = False
) -> PoseTable:
    """The table with names and times from lists by key, where it has none."""
    names, stamps, _ = row_labels([*columns], [*columns.values()], len(table.numbers), plural)
    stamps = stamps if table.stamps_s is None else table.stamps_s
    return table._replace(names=table.names or names, stamps_s=stamps)


def _flat(entry: Mapping[str, Any]) -> dict[str, object]:
    """Values of an object by the name of a column."""
    cells: dict[str, object] = {}
    for key, value in entry.items():
        if isinstance(value, list):
            value = dict(zip(_LISTS.get(key, range(len(value))), value, strict=False))
            cells |= value if key in _LISTS else {f"{key}_{i}": v for i, v in value.items()}
        elif isinstance(value, Mapping):
            cells |= _flat({f"{key}_{inner}": v for inner, v in value.items()})
        else:
            cells[key] = value
    return cells


def _pose_key(data: Mapping[str, Any]) -> str:
    """The only key of poses."""
    keys = [key for key in data if key in _KEYS] or [k for k, v in data.items() if _has_shape(v)]
    if len(keys) != 1:
        raise ValueError(
            f"{' and '.join(keys) or 'none'} of its keys ({', '.join(data)}) may hold the poses;"
            f" call the right one 'poses'"
        )
    return keys[0]


def _has_shape(values: Any) -> bool:
    """Whether lists have the shape of matrices or of rows of poses."""
    try:
        shape = np.shape(values)
    except ValueError:
        return False
    return shape[-2:] in ((4, 4), (3, 4)) or (len(shape) == 2 and shape[1] in _WIDTHS)
