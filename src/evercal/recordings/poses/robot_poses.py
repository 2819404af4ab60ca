"""Pose files: a table (CSV, TUM, text), JSON, NPY or NPZ, in a named convention.

A convention is required if the file does not define the meaning of its numbers. docs/formats.md
has examples of all kinds.
"""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.bounds import require_at_most
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
from evercal.recordings.poses.row_files import (
    Names,
    arrays_as_lists,
    number_array,
    row_labels,
    text_cells,
)
from evercal.recordings.text_files import named_errors, read_text, refuse_repeated

_KEYS = ("poses", "base_from_gripper", "camera_from_board", "T", "transforms", "matrices")
"""Keys of poses in JSON and NPZ."""
_WIDTHS = (6, 7, 8, 12, 13, 16, 17)
"""Numbers of a pose, possibly after a stamp."""
_END_BYTES = 1 << 16
"""Bytes read at each end of a file that grows."""
_LISTS = {"translation_m": ("x_m", "y_m", "z_m"), "quaternion_wxyz": ("qw", "qx", "qy", "qz")}
"""Columns of lists in JSON."""


@dataclass(frozen=True, eq=False)
class RobotPoses:
    """Poses in the order of their file."""

    names: Names
    """(n,) unique names of images or rows, if the file has any."""
    stamps_s: NDArray[np.float64] | None
    """(n,) seconds, if the file has any."""
    poses: SE3
    """(n,) base_from_gripper, or the transforms that the file holds instead."""
    numbers: NDArray[np.float64] | None = None
    """(n, k) numbers of the file, to be read by `poses_from_numbers`."""
    convention: PoseConvention | None = None
    """Convention of the numbers; numbers and convention are None for JSON's quaternion_wxyz."""

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
    with named_errors(path, what):
        try:
            given, ending = _given(path, convention), path.suffix.lower()
            if ending in (".npy", ".npz"):
                table = _data_table(arrays_as_lists(path), given)
            else:
                table = _table(read_text(path, what), ending, given)
            poses = _poses(table, camera_from)
        except ConventionError as error:
            raise InputError(f"{path}: {error.naming(option)}") from None
        refuse_repeated(table.names or (), "names are unique")
        stated = (None, None) if table.fixed else (table.numbers, table.convention)
        return RobotPoses(table.names, table.stamps_s, poses, *stated)


def read_last_robot_pose(path: str | os.PathLike[str], convention: str | None = None) -> SE3:
    """Read the last complete row of a table or of JSON lines that another program appends to.

    A row is complete once its line break is written. Long files are read at both ends only.
    """
    path = Path(path)
    with named_errors(path, "file of robot poses"):
        with path.open("rb") as file:
            lines = _complete_lines(file.read(_END_BYTES))
            file.seek(max(0, file.seek(0, os.SEEK_END) - _END_BYTES))
            last = _complete_lines(file.read())[-1:]
        ending = path.suffix.lower().removesuffix("l")
        first = next((i for i, line in enumerate(lines) if line[:1] != "#"), len(lines))
        if first == len(lines):
            raise ValueError("no complete line of a pose in it yet")
        if ending != ".json":
            # The first line is the header, or a row and perhaps the only one.
            last = [*lines[: first + 1], *(last if last != lines[first : first + 1] else [])]
        return _poses(_table("\n".join(last), ending, _given(path, convention)))[-1]


def _complete_lines(part: bytes) -> list[str]:
    text = part[: part.rfind(b"\n") + 1].decode("utf-8", "replace")
    return [line for line in text.splitlines() if line.strip()]


def _given(path: Path, convention: str | None) -> PoseConvention | None:
    if convention is None and path.suffix.lower() == ".tum":
        convention = "tum"
    return None if convention is None else pose_convention(convention)


def _table(text: str, ending: str, given: PoseConvention | None) -> PoseTable:
    if ending == ".json":
        return _data_table(json.loads(text), given)
    return read_pose_table(text, given)


def _poses(table: PoseTable, camera_from: bool = False) -> SE3:
    poses = poses_from_numbers(table.numbers, table.convention, camera_from)
    check_units(table.numbers, table.convention)
    return poses


def _data_table(data: Any, given: PoseConvention | None) -> PoseTable:
    if isinstance(data, Mapping) and not {"matrix", "translation_m"} & data.keys():
        key = _pose_key(data)
        lists = {k: v for k, v in data.items() if k != key and isinstance(v, list)}
        return _labelled(_data_table(data[key], given), lists, plural=True)
    entries = data if isinstance(data, list) else [data]
    if entries and all(isinstance(entry, list) for entry in entries):
        numbers = number_array(entries, "a list of poses")
        single = numbers.shape in ((4, 4), (3, 4))
        return plain_numbers(numbers[None] if single else numbers, given)
    if not entries or not all(isinstance(entry, Mapping) for entry in entries):
        raise ValueError("poses are a list of objects, or of lists of numbers, not of both")
    keys = dict.fromkeys(key for entry in entries for key in entry)
    require_at_most(len(keys), "columns", "keys")
    require_at_most(len(keys) * len(entries), "numbers", "values")
    columns = {key: [entry.get(key) for entry in entries] for key in keys}
    if all("matrix" in entry for entry in entries):
        return _labelled(_data_table(columns["matrix"], given), columns)
    rows = [_flat(entry) for entry in entries]
    words = [*rows[0]]
    cells = text_cells([str(row.get(word)) for word in words] for row in rows)
    table = _labelled(named_numbers(words, cells, given), columns)
    return table._replace(fixed="quaternion_wxyz" in columns)


def _labelled(
    table: PoseTable, columns: Mapping[str, Sequence[object]], plural: bool = False
) -> PoseTable:
    names, stamps, _ = row_labels([*columns], [*columns.values()], len(table.numbers), plural)
    stamps = stamps if table.stamps_s is None else table.stamps_s
    return table._replace(names=table.names or names, stamps_s=stamps)


def _flat(entry: Mapping[str, Any]) -> dict[str, object]:
    cells: dict[str, object] = {}
    for key, value in entry.items():
        require_at_most(len(key), "name_characters", "characters of a key")
        if isinstance(value, Mapping):
            cells |= _flat({f"{key}_{inner}": each for inner, each in value.items()})
        elif isinstance(value, list):
            require_at_most(len(value), "columns", "numbers of one key")
            names = _LISTS.get(key, [f"{key}_{i}" for i in range(len(value))])
            cells |= dict(zip(names, value, strict=False))
        else:
            cells[key] = value
    return cells


def _shape(value: object) -> tuple[int, ...]:
    """Lengths of nested lists, by the first of each: all are compared when numbers are read."""
    return (len(value), *_shape(value[0] if value else None)) if isinstance(value, list) else ()


def _pose_key(data: Mapping[str, Any]) -> str:
    keys = [key for key in data if key in _KEYS]
    for key in () if keys else data:
        shape = _shape(data[key])
        table = len(shape) == 2 and shape[1] in _WIDTHS
        keys += [key] if table or shape[-2:] in ((4, 4), (3, 4)) else []
    if len(keys) != 1:
        raise ValueError(
            f"{' and '.join(keys) or 'none'} of its keys ({', '.join(data)}) may hold the poses;"
            f" call the right one 'poses'"
        )
    return keys[0]
