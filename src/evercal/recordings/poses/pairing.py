"""Pairing of poses with images by name, by time, or in order."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path, PureWindowsPath
from typing import Any, NamedTuple

import numpy as np

from evercal.choices import ConventionName
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.joint_tables import interpolate
from evercal.recordings.poses.pose_track import MAX_GAP_S, PoseTrack
from evercal.recordings.poses.robot_poses import RobotPoses, read_robot_poses
from evercal.recordings.poses.row_files import is_number, same_numbers, times_in_names
from evercal.storage.text_files import (
    few,
    named_errors,
    natural_key,
    refuse_repeated,
)
from evercal.typing import Array, BoolArray, Strings


class Pairing(NamedTuple):
    """What n images were paired with; None for images without a row, or in a gap."""

    poses: list[SE3 | None]
    joints: list[Array | None]
    """(k,) values of the joints of the arm; none are stated with poses."""
    notes: list[str]


def pair_images(
    images: Sequence[Path],
    rows: RobotPoses,
    stamps_s: Mapping[str, float] | None,
    file: Path,
) -> Pairing:
    """Find the pose, and the joint values, of every image.

    Rows with names are paired with the images of these names. Rows with times are interpolated at
    the image times `stamps_s`, by name, or the times in the image names. Otherwise rows and images,
    in natural order, are paired in order, and their numbers must be equal.
    """
    joints = rows.joints
    if joints is None:
        joints = np.empty((len(rows), 0))
    if rows.names is not None:
        numbers, notes = _by_name(images, rows.names, file)
        return Pairing(_of_rows(rows.poses, numbers), _of_rows(joints, numbers), notes)
    times = _image_times(images, rows, stamps_s)
    if times is not None and rows.stamps_s is not None:
        poses, valid = PoseTrack(rows.stamps_s, rows.poses).at(times)
        notes = _notes_of_times(times, valid, rows.stamps_s, file)
        values = np.empty((len(times), joints.shape[1]))
        is_known = np.ones(len(times), bool)
        for column, positions in enumerate(joints.T):
            moved, is_valid = interpolate(rows.stamps_s, positions, times)
            values[:, column] = moved
            is_known &= is_valid
        return Pairing(_where(poses, valid), _where(values, is_known), notes)
    if len(rows.poses) != len(images):
        remedy = "a stamps.csv (image, stamp_s)"
        if rows.stamps_s is None:
            remedy = "an image column"
        raise InputError(
            f"{file}: {len(rows.poses)} poses for {len(images)} images in {images[0].parent}; give"
            f" each image a row, or add {remedy} to pair them"
        )
    # A shell's *.png puts image-10 before image-2, unlike the rows.
    for before, after in itertools.pairwise(images):
        same_folder = before.parent == after.parent
        if same_folder and natural_key(before.name) > natural_key(after.name):
            raise InputError(
                f"{file}: {after.name} is given after {before.name}, so the order of the rows is"
                f" ambiguous; give the folder, or name the images in a column image"
            )
    ends = f"{images[0].name} to {images[-1].name}"
    note = f"images and poses were paired in order, {ends}"
    return Pairing(list(rows.poses), list(joints), [note])


def poses_of_images(
    file: Path, images: Sequence[Path], convention: ConventionName | str | None = None
) -> tuple[SE3, list[str]]:
    """Read (n,) base_from_gripper of n images, with notes, for the commands with `--convention`."""
    rows = read_robot_poses(file, convention, option="`convention`")
    paired = pair_images(images, rows, None, file)
    names = _names(images)
    poses = []
    missing = []
    for name, pose in zip(names, paired.poses, strict=True):
        if not pose:
            missing.append(name)
        else:
            poses.append(pose)
    if missing:
        listed = few(missing, {*(rows.names or ())}.difference(names))
        raise InputError(
            f"{file}: has no pose for {listed}; add it or leave the image out"
        )
    return SE3.stack(poses), paired.notes


def unpaired(images: Sequence[str], rows: Sequence[str], file: str) -> list[str]:
    """Notes of images and rows of a file whose names have no counterpart."""
    notes = []
    if images:
        count = counted(len(images), "image")
        notes.append(f"{count} without a row in {file}: {few(images, rows)}")
    if rows:
        count = counted(len(rows), "row")
        notes.append(f"{count} of {file} without an image: {few(rows)}")
    return notes


def _where(values: Any, valid: BoolArray) -> list[Any]:
    """Values (n,) that are valid (n,), and None for others."""
    return [value if v else None for value, v in zip(values, valid, strict=True)]


def _of_rows(values: Any, numbers: Sequence[int | None]) -> list[Any]:
    """Values of rows, and None for None."""
    return [None if number is None else values[number] for number in numbers]


def _by_name(
    images: Sequence[Path], names: Sequence[str], file: Path
) -> tuple[list[int | None], list[str]]:
    """Number of each image's row, and notes."""
    keys = [PureWindowsPath(name).name for name in names]
    files = _names(images)
    with named_errors(file, "poses"):
        refuse_repeated(keys, "give every image one row")
    # A table may omit the ending.
    rows, unused = _rows_of_keys([(image.stem, image.name) for image in images], keys)
    if len(unused) == len(keys):
        # Such as frame-1.color.png and frame-1.pose, but not 1.5.png.
        starts = [*map(_start, files)]
        key_starts = [*map(_start, keys)]
        if _are_names(starts) and _are_names(key_starts):
            rows, unused = _rows_of_keys([*zip(starts)], key_starts)
    if len(unused) < len(keys):
        pairs = zip(files, rows, strict=True)
        alone = [name for name, row in pairs if row is None]
        return rows, unpaired(alone, unused, file.name)
    if same_numbers(names, files):
        note = f"paired by numbers: {names[0]} with {files[0]}, and so on"
        return [*range(len(images))], [note]
    raise InputError(
        f"{file}: names no image of {images[0].parent}; its first is {names[0]!r}, the first"
        f" image is {files[0]!r}; correct the names, or leave them out to pair in order"
    )


def _rows_of_keys(
    names: Sequence[Strings], keys: Sequence[str]
) -> tuple[list[int | None], list[str]]:
    """Number of the key that is one of each image's names, the last if several; unused keys."""
    unused = {key: number for number, key in enumerate(keys)}
    rows = []
    for names_of_image in names:
        row = None
        for name in names_of_image:
            row = unused.pop(name, row)
        rows.append(row)
    return rows, [*unused]


def _names(images: Sequence[Path]) -> list[str]:
    return [image.name for image in images]


def _start(name: str) -> str:
    return name.partition(".")[0]


def _are_names(starts: Sequence[str]) -> bool:
    is_unique = len({*starts}) == len(starts)
    return is_unique and not is_number(starts[0])


def _notes_of_times(
    times: Array, valid: BoolArray, stamps_s: Array, file: Path
) -> list[str]:
    """What is said of images (n,) at times of which some are valid (n,)."""
    if not valid.any():
        raise InputError(
            f"{file}: no image was taken while poses were recorded: images at {times.min():.3f} to"
            f" {times.max():.3f} s, poses at {stamps_s.min():.3f} to {stamps_s.max():.3f} s; are"
            f" the clocks the same? If not, name the image of each row in a column image"
        )
    notes = [f"poses were interpolated at the times of {counted(len(times), 'image')}"]
    if not valid.all():
        invalid = counted(int((~valid).sum()), "image")
        notes.append(
            f"{invalid} taken outside the recorded poses or in a gap of more than {MAX_GAP_S:g} s"
            f" with motion"
        )
    return notes


def _image_times(
    images: Sequence[Path], rows: RobotPoses, stamps_s: Mapping[str, float] | None
) -> Array | None:
    """(n,) seconds of images, if rows have times and images are at known times."""
    if rows.stamps_s is None:
        return None
    if stamps_s is None:
        return times_in_names(_names(images))
    times = []
    for image in images:
        time = stamps_s.get(image.name, stamps_s.get(image.stem))
        if time is None:
            raise InputError(
                f"{image}: stamps.csv has no row for it; add one for every image"
            )
        times.append(time)
    return np.array(times, float)


def counted(number: int, what: str) -> str:
    """A number of things in words: 1 image, 2 images."""
    if number != 1:
        what += "s"
    return f"{number} {what}"
