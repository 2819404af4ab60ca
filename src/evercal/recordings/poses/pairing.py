"""Which gripper pose belongs to which image: by name, by time, or in order."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.pose_track import MAX_GAP_S, PoseTrack
from evercal.recordings.poses.robot_poses import RobotPoses, read_robot_poses
from evercal.recordings.poses.row_files import natural_key, times_in_names


def pair_images(
    images: Sequence[Path], rows: RobotPoses, stamps_s: Mapping[str, float] | None, file: Path
) -> tuple[list[SE3 | None], list[str]]:
    """Gives every image its gripper pose.

    Rows with names go to the images of these names. Rows with times are interpolated at the times
    of the images, which a file states or the images' names are. Else rows and images are as many
    and go together in their order.

    Args:
        images: in natural order.
        rows: as read.
        stamps_s: time of each image by its name; None if no file states them.
        file: that the rows came from, for the messages.

    Returns:
        One pose for each image, None where it has none, and notes on what was done.

    Raises:
        InputError: they cannot be paired.
    """
    if rows.names is not None:
        return _by_name(images, rows.names, rows.poses, file)
    times = None
    if rows.stamps_s is not None:
        times = _image_times(images, stamps_s)
    if times is not None and rows.stamps_s is not None:
        return _by_time(times, PoseTrack(rows.stamps_s, rows.poses), file)
    if len(rows.poses) != len(images):
        how = "an image column" if rows.stamps_s is None else "a stamps.csv (image, stamp_s)"
        raise InputError(
            f"{file}: {len(rows.poses)} poses for {len(images)} images in {images[0].parent}; give"
            f" each image a row, or add {how} that says which belong together"
        )
    # A shell's *.png puts image-10 before image-2, the rows do not.
    for before, after in itertools.pairwise(images):
        same = before.parent == after.parent
        if same and natural_key(before.name) > natural_key(after.name):
            raise InputError(
                f"{file}: {after.name} is given after {before.name}, so which row is whose is open;"
                f" give the folder, or name the images in a column image"
            )
    first, last = images[0].name, images[-1].name
    return list(rows.poses), [f"images and poses were paired in order, {first} to {last}"]


def poses_of_images(file: Path, images: Sequence[Path], convention: str | None = None) -> SE3:
    """(n,) base_from_gripper of images, paired with the rows of a file as `pair_images` does.

    Args:
        file: as `read_robot_poses` takes it.
        images: in the order of the rows, where neither names nor times pair them.
        convention: how the file is written, where it does not say it.

    Raises:
        InputError: they cannot be paired, or an image has no pose.
    """
    poses, _ = pair_images(images, read_robot_poses(file, convention), None, file)
    missing = [image.name for image, pose in zip(images, poses, strict=True) if pose is None]
    if missing:
        raise InputError(
            f"{file}: has no pose for {_few(missing)}; give every image one, or leave the image out"
        )
    return SE3.stack([pose for pose in poses if pose is not None])


def _by_name(
    images: Sequence[Path], names: Sequence[str], poses: SE3, file: Path
) -> tuple[list[SE3 | None], list[str]]:
    by_name: dict[str, SE3] = {}
    for name, pose in zip(names, poses, strict=True):
        key = PurePath(name).name
        if key in by_name:
            raise InputError(f"{file}: {name!r} comes twice; give every image one row")
        by_name[key] = pose
    # A table may leave the ending out.
    found = [by_name.pop(i.name, None) or by_name.pop(i.stem, None) for i in images]
    if not any(pose is not None for pose in found):
        raise InputError(
            f"{file}: names no image of {images[0].parent}; its first is {names[0]!r}, the first"
            f" image is {images[0].name!r}; mend the names, or leave them out to pair in order"
        )
    notes = []
    if None in found:
        alone = [i.name for i, pose in zip(images, found, strict=True) if pose is None]
        notes.append(f"{_count(len(alone), 'image')} without a row in {file.name}: {_few(alone)}")
    if by_name:
        notes.append(f"{_count(len(by_name), 'row')} of {file.name} without an image:"
                     f" {_few(list(by_name))}")  # fmt: skip
    return found, notes


def _by_time(
    times: NDArray[np.float64], track: PoseTrack, file: Path
) -> tuple[list[SE3 | None], list[str]]:
    poses, known = track.at(times)
    if not known.any():
        first, last = track.stamps_s[0], track.stamps_s[-1]
        raise InputError(
            f"{file}: no image was taken while poses were recorded: images at {times.min():.3f} to"
            f" {times.max():.3f} s, poses at {first:.3f} to {last:.3f} s; are the clocks the same?"
            f" If not, name the image of each row in a column image"
        )
    notes = [f"gripper poses were interpolated at the times of {_count(len(times), 'image')}"]
    if not known.all():
        notes.append(
            f"{_count(int((~known).sum()), 'image')} lie outside the recorded poses or in a gap of"
            f" more than {MAX_GAP_S:g} s in which the gripper moved"
        )
    return [pose if ok else None for pose, ok in zip(poses, known, strict=True)], notes


def _image_times(
    images: Sequence[Path], stamps_s: Mapping[str, float] | None
) -> NDArray[np.float64] | None:
    """(n,) seconds; from the stamps file, else from names that are times."""
    if stamps_s is not None:
        times = [stamps_s.get(i.name, stamps_s.get(i.stem)) for i in images]
        if None in times:
            missing = images[times.index(None)]
            raise InputError(f"{missing}: stamps.csv has no row for it; add one for every image")
        return np.array(times, dtype=np.float64)
    return times_in_names([image.name for image in images])


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _few(names: Sequence[str], most: int = 4) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
