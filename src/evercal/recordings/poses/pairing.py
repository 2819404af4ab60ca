"""Pairing of poses with images by name, by time, or in order."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path, PureWindowsPath

import numpy as np

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
from evercal.typing import Array

Pairing = tuple[list[SE3 | None], list[str]]
"""The pose of each image, if it has one, and notes."""


def pair_images(
    images: Sequence[Path],
    rows: RobotPoses,
    stamps_s: Mapping[str, float] | None,
    file: Path,
) -> Pairing:
    """Find the pose of every image.

    Rows with names are paired with the images of these names. Rows with times are interpolated at
    the image times `stamps_s`, by name, or the times in the image names. Otherwise rows and images,
    in natural order, are paired in order, and their numbers must be equal.
    """
    if rows.names is not None:
        which, notes = _by_name(images, rows.names, file)
        return [None if i is None else rows.poses[i] for i in which], notes
    times = None if rows.stamps_s is None else _image_times(images, stamps_s)
    if times is not None and rows.stamps_s is not None:
        return _by_time(times, PoseTrack(rows.stamps_s, rows.poses), file)
    if len(rows.poses) != len(images):
        how = (
            "an image column"
            if rows.stamps_s is None
            else "a stamps.csv (image, stamp_s)"
        )
        raise InputError(
            f"{file}: {len(rows.poses)} poses for {len(images)} images in {images[0].parent}; give"
            f" each image a row, or add {how} to pair them"
        )
    # A shell's *.png puts image-10 before image-2, unlike the rows.
    for before, after in itertools.pairwise(images):
        same_folder = before.parent == after.parent
        if same_folder and natural_key(before.name) > natural_key(after.name):
            raise InputError(
                f"{file}: {after.name} is given after {before.name}, so the order of the rows is"
                f" ambiguous; give the folder, or name the images in a column image"
            )
    first = images[0].name
    last = images[-1].name
    return list(rows.poses), [
        f"images and poses were paired in order, {first} to {last}"
    ]


def pair_joints(
    images: Sequence[Path],
    rows: RobotPoses,
    stamps_s: Mapping[str, float] | None,
    file: Path,
) -> list[Array | None]:
    """Joint values (k,) of every image, paired as its pose; None without any."""
    values = rows.joints
    times = rows.stamps_s
    if values is None:
        return [None] * len(images)
    if rows.names is not None:
        which, _ = _by_name(images, rows.names, file)
        return [None if i is None else values[i] for i in which]
    at = None if times is None else _image_times(images, stamps_s)
    if at is None or times is None:
        return list(values)
    return list(
        np.stack([interpolate(times, column, at)[0] for column in values.T], axis=1)
    )


def poses_of_images(
    file: Path, images: Sequence[Path], convention: str | None = None
) -> tuple[SE3, list[str]]:
    """Read (n,) base_from_gripper of n images, with notes, for the commands with `--convention`."""
    rows = read_robot_poses(file, convention, option="--convention")
    poses, notes = pair_images(images, rows, None, file)
    missing = [
        image.name for image, pose in zip(images, poses, strict=True) if pose is None
    ]
    if missing:
        alone = few(missing, {*(rows.names or ())} - {image.name for image in images})
        raise InputError(
            f"{file}: has no pose for {alone}; add it or leave the image out"
        )
    return SE3.stack([pose for pose in poses if pose is not None]), notes


def _by_name(
    images: Sequence[Path], names: Sequence[str], file: Path
) -> tuple[list[int | None], list[str]]:
    """Number of each image's row, and notes."""
    keys = [PureWindowsPath(name).name for name in names]
    files = [image.name for image in images]
    with named_errors(file, "poses"):
        refuse_repeated(keys, "give every image one row")
    by_name = {key: number for number, key in enumerate(keys)}
    # A table may omit the ending.
    paired = [by_name.pop(i.name, by_name.pop(i.stem, None)) for i in images]
    # Such as frame-1.color.png and frame-1.pose, but not 1.5.png.
    if len(by_name) == len(keys):
        heads = [[name.partition(".")[0] for name in part] for part in (files, keys)]
        if all(len({*part}) == len(part) and not is_number(part[0]) for part in heads):
            by_name = {head: number for number, head in enumerate(heads[1])}
            paired = [by_name.pop(head, None) for head in heads[0]]
    if all(row is None for row in paired) and same_numbers(names, files):
        return [*range(len(images))], [
            f"paired by numbers: {names[0]} with {images[0].name}, and so on"
        ]
    if all(row is None for row in paired):
        raise InputError(
            f"{file}: names no image of {images[0].parent}; its first is {names[0]!r}, the first"
            f" image is {images[0].name!r}; correct the names, or leave them out to pair in order"
        )
    alone = [name for name, row in zip(files, paired, strict=True) if row is None]
    return paired, unpaired(alone, [*by_name], file.name)


def unpaired(images: Sequence[str], rows: Sequence[str], file: str) -> list[str]:
    """Notes of images and rows of a file whose names have no counterpart."""
    notes = []
    if images:
        count = _count(len(images), "image")
        notes.append(f"{count} without a row in {file}: {few(images, rows)}")
    if rows:
        notes.append(
            f"{_count(len(rows), 'row')} of {file} without an image: {few(rows)}"
        )
    return notes


def _by_time(times: Array, track: PoseTrack, file: Path) -> Pairing:
    poses, valid = track.at(times)
    if not valid.any():
        first = track.stamps_s[0]
        last = track.stamps_s[-1]
        raise InputError(
            f"{file}: no image was taken while poses were recorded: images at {times.min():.3f} to"
            f" {times.max():.3f} s, poses at {first:.3f} to {last:.3f} s; are the clocks the same?"
            f" If not, name the image of each row in a column image"
        )
    notes = [f"poses were interpolated at the times of {_count(len(times), 'image')}"]
    if not valid.all():
        notes.append(
            f"{_count(int((~valid).sum()), 'image')} taken outside the recorded poses or in a gap"
            f" of more than {MAX_GAP_S:g} s with motion"
        )
    return [pose if ok else None for pose, ok in zip(poses, valid, strict=True)], notes


def _image_times(
    images: Sequence[Path], stamps_s: Mapping[str, float] | None
) -> Array | None:
    if stamps_s is None:
        return times_in_names([image.name for image in images])
    times = [stamps_s.get(i.name, stamps_s.get(i.stem)) for i in images]
    if None in times:
        missing = images[times.index(None)]
        raise InputError(
            f"{missing}: stamps.csv has no row for it; add one for every image"
        )
    return np.array(times, dtype=np.float64)


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
