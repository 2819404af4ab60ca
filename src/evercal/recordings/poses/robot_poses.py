"""Pose files: a table (CSV, TUM, text), JSON, YAML, NPY, NPZ or MAT, in a named convention.

A convention is required if the file does not define the meaning of its numbers. A folder may hold
one such file for each pose. docs/formats.md has examples of all kinds.
"""

import os
import re
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from evercal.choices import ConventionName
from evercal.classes import frozen_arrays
from evercal.geometry import SE3
from evercal.recordings.images import files_in
from evercal.recordings.poses.array_files import arrays_as_lists
from evercal.recordings.poses.conventions import (
    ConventionError,
    Given,
    PoseConvention,
    asking_for,
    pose_convention,
)
from evercal.recordings.poses.pose_columns import PoseTable
from evercal.recordings.poses.pose_data import pose_data
from evercal.recordings.poses.pose_table import read_pose_table
from evercal.recordings.poses.pose_units import checked_poses
from evercal.recordings.poses.row_files import Names
from evercal.robot.arm import Arm
from evercal.robot.frame_names import UNKNOWN, FrameNames
from evercal.storage.text_files import (
    documents,
    named_errors,
    read_text,
    refuse_repeated,
)
from evercal.typing import Array, Floats, PathLike

POSE_ENDINGS = (
    ".csv",
    ".json",
    ".jsonl",
    ".yaml",
    ".yml",
    ".npy",
    ".npz",
    ".mat",
    ".tum",
    ".txt",
    ".dat",
    ".log",
    ".tf",
)
_YAML = re.compile(
    r"(?:\s*#.*\n)*(?:%YAML|---\s*\n|(?:- )?[A-Za-z_]\w*:(?:[^\S\n]*\n\s*(?:- )?[A-Za-z_]\w*:"
    r"| \{\s*[a-z]))"
)
"""Beginning of YAML in a file with another ending."""
_END_BYTES = 1 << 16
"""Bytes read at each end of a file that grows."""
_UNTRACKED = re.compile(r"(?i)\b(?:nan|inf)\b|1\.?#(?:IND|INF|[QS]NAN)")
"""A number in a file of one pose that an image lacks, also as Windows prints it."""


@frozen_arrays
class RobotPoses:
    """Poses in the order of their file."""

    names: Names
    """(n,) unique names of images or rows, if the file has any."""
    stamps_s: Array | None
    """(n,) seconds, if the file has any."""
    poses: SE3
    """(n,) base_from_gripper, or the transforms that the file holds instead."""
    numbers: Array | None = None
    """(n, k) numbers of the file, to be read by `poses_from_numbers`."""
    convention: PoseConvention | None = None
    """Convention of the numbers; numbers and convention are None for JSON's quaternion_wxyz."""
    arm: Arm | None = None
    """Arm whose joint values are stated instead of poses."""
    joints: Array | None = None
    """(n, k) values of its joints, radians, or metres of sliding joints."""
    frames: FrameNames = UNKNOWN
    """Names of base and gripper, where they are known."""

    def __len__(self) -> int:
        """Number of poses."""
        return len(self.poses)

    def joints_of(self, row: int) -> Floats | None:
        """Joint values of a row, if they are stated."""
        if self.joints is None:
            return None
        return tuple(self.joints[row].tolist())


def read_robot_poses(
    path: PathLike,
    convention: ConventionName | str | None = None,
    *,
    what: str = "file of robot poses",
    option: str | None = None,
    camera_from: bool = False,
    robot: bool = True,
) -> RobotPoses:
    """Read a pose file.

    Args:
        path: A `.json`, `.yaml`, `.npy`, `.npz` or `.mat` file, a folder of files of one pose each;
            other endings are read as a table.
        convention: Convention of the numbers, such as `kuka`, `ur` or `matrix:mm`. Required if the
            file does not define it.
        what: Kind of file, for messages.
        option: Argument of the convention in backquotes, for messages.
        camera_from: Whether the file states camera_from_something, for `:opengl`.
        robot: Whether the poses are of the robot, in files with those of the camera, too.

    Raises:
        InputError: The file is missing or broken, or the numbers do not fit the convention.
    """
    path = Path(path)
    with named_errors(path, what), asking_for(option):
        given = _given(path, convention)
        if path.is_dir():
            table = _folder(path, given, what, robot)
        else:
            table = _file(path, given, what, robot)
        poses = _poses(table, camera_from)
        refuse_repeated(table.names or (), "names are unique")
        rows = RobotPoses(table.names, table.stamps_s, poses, frames=table.frames)
        if table.fixed:
            return rows
        return replace(rows, numbers=table.numbers, convention=table.convention)


def read_last_robot_pose(
    path: PathLike, convention: ConventionName | str | None = None
) -> SE3:
    """Read the last complete row of a table or of JSON lines that another program appends to.

    A row is complete once its line break is written. Long files are read at both ends only.
    """
    path = Path(path)
    with named_errors(path, "file of robot poses"):
        with path.open("rb") as file:
            lines = _complete_lines(file.read(_END_BYTES))
            file.seek(max(0, file.seek(0, os.SEEK_END) - _END_BYTES))
            last = _complete_lines(file.read())[-1:]
        rows = [line for line in lines if line[:1] != "#"]
        if not rows:
            raise ValueError("no complete line of a pose in it yet")
        ending = path.suffix.lower().removesuffix("l")  # one line of .jsonl is JSON
        if ending != ".json":
            # The first line is the header, or a row and perhaps the only one.
            before = lines[: lines.index(rows[0]) + 1]
            if last == rows[:1]:
                last = []
            last = before + last
        return _poses(_table("\n".join(last), ending, _given(path, convention)))[-1]


def _complete_lines(part: bytes) -> list[str]:
    if b"\0" in part:
        raise ValueError("it is UTF-16; let the program that writes it write UTF-8")
    text = part[: part.rfind(b"\n") + 1].decode("utf-8", "replace")
    return [line for line in text.splitlines() if line.strip()]


def _given(path: Path, convention: str | None) -> Given:
    if convention is None and path.suffix.lower() == ".tum":
        convention = "tum"
    if convention is None:
        return None
    return pose_convention(convention)


def _file(path: Path, given: Given, what: str, robot: bool) -> PoseTable:
    ending = path.suffix.lower()
    if ending in (".npy", ".npz", ".mat"):
        return pose_data(arrays_as_lists(path), given, robot)
    return _table(read_text(path, what), ending, given, robot)


def _folder(path: Path, given: Given, what: str, robot: bool) -> PoseTable:
    """Poses of files that are named alike, in the order of the numbers in their names."""
    tables: dict[str, PoseTable] = {}
    for file in _files_named_alike(path, robot):
        with named_errors(file, what):
            is_text = file.suffix.lower() == ".txt"
            if is_text and _UNTRACKED.search(read_text(file, what)):
                continue
            table = _file(file, given, what, robot)
            if len(table.numbers) != 1:
                raise ValueError(
                    "holds several poses, in a folder of one file for each pose"
                )
            tables[file.stem] = table
    if not tables:
        raise ValueError(
            "all poses in its files are inf or nan; give those of tracked images"
        )
    numbers = np.concatenate([table.numbers for table in tables.values()])
    first = next(iter(tables.values()))
    return PoseTable(numbers, first.convention, tuple(tables))


def _files_named_alike(folder: Path, robot: bool) -> list[Path]:
    """Files whose names differ in numbers only."""
    kinds: dict[str, list[Path]] = {}
    for file in files_in(folder, POSE_ENDINGS):
        kinds.setdefault(re.sub(r"\d+", "N", file.name), []).append(file)
    several = [kind for kind, files in kinds.items() if len(files) > 1]
    several = several or [*kinds]
    # ViSP's poses of the end effector, or of the object in the camera.
    word = "fPe" if robot else "cPo"
    chosen = [kind for kind in several if word in kind] or several
    if len(chosen) == 1:
        (kind,) = chosen
        return kinds[kind]
    names = " and ".join(chosen)
    if not names:
        names = f"no file of {', '.join(POSE_ENDINGS)}"
    raise ValueError(
        f"the folder holds {names}; give a folder of one file for each pose"
    )


def _table(text: str, ending: str, given: Given, robot: bool = True) -> PoseTable:
    is_json = ending in (".json", ".jsonl")
    is_yaml = ending in (".yaml", ".yml") or _YAML.match(text)
    if not is_json and not is_yaml:
        return read_pose_table(text, given)
    data = [value for value in documents(text, is_json) if value is not None]
    if len(data) == 1:
        (data,) = data
    return pose_data(data, given, robot)


def _poses(table: PoseTable, camera_from: bool = False) -> SE3:
    """Poses of a table; ValueError if the numbers are none, and what may be the matter."""
    convention = table.convention
    try:
        return checked_poses(table.numbers, convention, camera_from)
    except ValueError as error:
        problem: ValueError = error
    with suppress(ValueError):
        if not convention.is_matrix:
            checked_poses(np.roll(table.numbers, 3, axis=-1), convention)
            words = convention.meaning.partition(",")[0].split()
            columns = ",".join(words[3:] + words[:3])
            remedy = f"{columns}:{convention.name}"
            problem = ConventionError("the rotation is before the position", remedy)
    raise problem
