"""Poses of a robot from a file: a table (CSV, TUM), JSON or NPY, in a named convention.

    x,y,z,qw,qx,qy,qz,image           [{"translation_m": [3], "quaternion_wxyz": [4],
    0.31,-0.02,0.4,1,0,0,0,a.png        "image": "a.png", "stamp_s": 12.5}, ...]

A table's header tells what its columns are (`pose_header`), and what names images and times are
called is the same everywhere (`labels`). JSON is a list of such objects, with
`matrix` [4][4] in place of translation and quaternion if liked, or a list of lists of numbers; it
may stand under `poses`. NPY is (n, 4, 4), or (n, k) numbers with a convention. A `.tum` file has
lines of stamp, translation and quaternion x y z w. What a file leaves open, the convention
(`evercal.recordings.poses.conventions`) must say; nothing is guessed.
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
    PoseConvention,
    doubt,
    known_conventions,
    pose_convention,
    poses_from_numbers,
)
from evercal.recordings.poses.labels import (
    find_labels,
    image_column,
    labels_of_lists,
    number_array,
    seconds,
)
from evercal.recordings.poses.pose_table import PoseTable, read_pose_table


@dataclass(frozen=True, eq=False)
class RobotPoses:
    """Poses in the order of their file."""

    names: tuple[str, ...] | None
    """Of the images or rows, unique; None if the file has none."""
    stamps_s: NDArray[np.float64] | None
    """(n,) seconds; None if the file has none."""
    poses: SE3
    """(n,) base_from_gripper, or what the file holds instead."""

    def __len__(self) -> int:
        """How many poses."""
        return len(self.poses)


def read_robot_poses(
    path: str | os.PathLike[str], convention: str | PoseConvention | None = None
) -> RobotPoses:
    """Reads poses of a robot.

    Args:
        path: a `.json` or `.npy` file; every other one is read as a table.
        convention: how the numbers are meant, for files that do not say it: a name such as `kuka`,
            `ur` or `matrix:mm`, or `tum` for xyzw behind a stamp.

    Raises:
        InputError: The file is missing or broken; it does not say how its poses are meant and no
            convention is given; or its numbers do not fit what it or the convention says.
    """
    path = Path(path)
    try:
        given = _convention(convention, path)
        if path.suffix.lower() == ".json":
            table = _json_table(json.loads(_text(path)), given)
        elif path.suffix.lower() == ".npy":
            table = _npy_table(path, given)
        else:
            table = read_pose_table(_text(path), given)
        return _robot_poses(table)
    except ValueError as error:  # also no JSON
        raise InputError(f"{path}: {error}") from None


def _convention(given: str | PoseConvention | None, path: Path) -> PoseConvention | None:
    if given is None:
        return pose_convention("xyzw") if path.suffix.lower() == ".tum" else None
    if isinstance(given, PoseConvention):
        return given
    base, _, modifiers = given.strip().lower().partition(":")
    if base == "tum":
        return pose_convention(f"xyzw:{modifiers}" if modifiers else "xyzw")
    return pose_convention(given)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{path}: file of robot poses is missing; check the path") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise InputError(
            f"{path}: not a text file; give poses as a table, JSON, TUM lines or .npy"
        ) from None


def _robot_poses(table: PoseTable) -> RobotPoses:
    if not len(table.numbers):
        raise ValueError("no pose in it")
    poses = poses_from_numbers(table.numbers, table.convention)
    why = doubt(table.numbers, table.convention)
    if why is not None:
        raise ValueError(why)
    if table.names is not None:
        twice = [name for i, name in enumerate(table.names) if name in table.names[:i]]
        if twice:
            raise ValueError(f"the name {twice[0]!r} comes twice; names are unique")
    if table.stamps_s is not None and not np.isfinite(table.stamps_s).all():
        raise ValueError("a stamp is inf or nan; leave such rows out")
    return RobotPoses(table.names, table.stamps_s, poses)


def _npy_table(path: Path, given: PoseConvention | None) -> PoseTable:
    try:
        numbers = np.asarray(np.load(path, allow_pickle=False), dtype=np.float64)
    except FileNotFoundError:
        raise InputError(f"{path}: file of robot poses is missing; check the path") from None
    except (OSError, EOFError, TypeError) as error:
        raise ValueError(f"no array of numbers ({error})") from None
    if numbers.shape == (4, 4):
        numbers = numbers[None]
    if numbers.ndim == 3 and numbers.shape[1:] == (4, 4):
        convention = given or pose_convention("matrix")
        return PoseTable(_matrices(numbers, convention), convention, None, None)
    if numbers.ndim != 2:
        raise ValueError(f"poses are (n, 4, 4) or (n, k) numbers, got shape {numbers.shape}")
    return PoseTable(numbers, _needed(given, numbers.shape[1]), None, None)


def _needed(given: PoseConvention | None, count: int) -> PoseConvention:
    if given is None:
        raise ValueError(
            f"{count} numbers a pose do not say how they are meant; give --convention,"
            f" one of {known_conventions()}"
        )
    return given


def _json_table(data: object, given: PoseConvention | None) -> PoseTable:
    if isinstance(data, Mapping) and "poses" in data:
        table = _json_table(data["poses"], given)
        beside = {key: value for key, value in data.items() if key != "poses"}
        names, stamps = labels_of_lists(beside, len(table.numbers))
        return replace(
            table,
            names=names if table.names is None else table.names,
            stamps_s=stamps if table.stamps_s is None else table.stamps_s,
        )
    if isinstance(data, Mapping):
        data = [data]
    if not isinstance(data, list) or not data:
        raise ValueError("JSON of poses is a list of objects, or of lists of numbers")
    if all(isinstance(entry, list) for entry in data):
        numbers = number_array(data, "a list of poses")
        if numbers.ndim == 3:
            convention = given or pose_convention("matrix")
            return PoseTable(_matrices(numbers, convention), convention, None, None)
        if numbers.ndim != 2:
            raise ValueError("a pose in JSON is an object or a list of numbers")
        return PoseTable(numbers, _needed(given, numbers.shape[1]), None, None)
    if not all(isinstance(entry, Mapping) for entry in data):
        raise ValueError("JSON of poses is a list of objects, or of lists of numbers, not of both")
    return _object_table(data, given)


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
                f"'translation_m' and 'quaternion_wxyz' say how they are meant, --convention"
                f" {convention.name} something else; leave it out, or give wxyz:inverse"
            )
        parts = [number_array([e[key] for e in entries], f"'{key}'") for key in _PARTS]
        if [part.shape[1:] for part in parts] != [(3,), (4,)]:
            raise ValueError("'translation_m' has three numbers and 'quaternion_wxyz' four")
        numbers = np.concatenate(parts, axis=-1)
    else:
        raise ValueError(
            "every pose has 'translation_m' and 'quaternion_wxyz', or every pose 'matrix'"
        )
    return PoseTable(numbers, convention, *_labels(entries))


_PARTS = ("translation_m", "quaternion_wxyz")


def _labels(
    entries: Sequence[Mapping[str, object]],
) -> tuple[tuple[str, ...] | None, NDArray[np.float64] | None]:
    """Names and stamps of JSON objects, None where they have none."""
    keys = [*dict.fromkeys(key for entry in entries for key in entry)]
    found = find_labels(keys)
    name, stamp = (None if i is None else keys[i] for i in (found.name, found.stamp))
    if name is None:
        name = image_column({key: [entry.get(key) for entry in entries] for key in keys})
    for key in filter(None, (name, stamp)):
        if not all(key in entry for entry in entries):
            raise ValueError(f"some poses have {key!r}, others lack it; give it to all or none")
    return (
        None if name is None else tuple(str(entry[name]) for entry in entries),
        None
        if stamp is None
        else seconds(number_array([entry[stamp] for entry in entries], f"{stamp!r}"), found.unit),
    )


def _matrices(matrices: NDArray[np.float64], convention: PoseConvention) -> NDArray[np.float64]:
    """(n, 4, 4) as (n, 16), refused if it should be something else."""
    if matrices.shape[1:] != (4, 4):
        raise ValueError(f"a matrix is 4x4, got {' x '.join(map(str, matrices.shape[1:]))}")
    if convention.layout not in ("rows", "columns"):
        raise ValueError(
            f"it holds 4x4 matrices and --convention {convention.name} means"
            f" {convention.meaning}; give matrix or franka, or leave it out"
        )
    return matrices.reshape(-1, 16)
