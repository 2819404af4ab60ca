"""What fixed cameras saw of one board, moment by moment."""

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from evercal.calibration.fixed.corner_fit import CornerFit, corner_fit
from evercal.calibration.pose_pairs.checks import SIZE_SIGMA
from evercal.calibration.pose_pairs.pair_files import PoseRows, read_camera_poses
from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.geometry import SE3, unit_vectors
from evercal.recordings.poses.pairing import counted
from evercal.recordings.poses.row_files import last_number, without_ending
from evercal.typing import Array, Strings

_APART_S = 0.02
"""Times of different cameras that differ by less are one moment."""
_ACROSS = 0.002
"""Usual error of the position of a board across the ray, parts of its distance."""
_ALONG = 0.01
"""The same along the ray."""
_TURNED = 0.01
"""Usual error of its rotation, radians."""


@frozen_arrays
class Sightings:
    """Poses of a board that one camera stated."""

    name: str
    """Name of the camera."""
    images: Strings
    """(n,) names of images or rows."""
    moments: Strings
    """(n,) what cameras saw at one moment has one name."""
    poses: SE3
    """(n,) camera_from_board."""
    own: Array
    """(n, 6, 6) covariance of each, or a usual one where none is stated."""
    shared: Array
    """(n, 6, q) errors that all share, of one standard deviation each."""
    fit: CornerFit | None = None
    """What the corners say, where there are corners."""
    size: float = SIZE_SIGMA
    """Relative error of the board's size."""

    @classmethod
    def of(
        cls,
        name: str,
        table: PoseRows,
        moments: Sequence[str],
    ) -> "Sightings":
        """The images of a table that show the board."""
        rows = np.flatnonzero(table.measured)
        if not len(rows):
            raise InputError(f"{name}: no image shows the board")
        poses = table.poses[rows]
        fit = None
        if corners := table.corners_of(rows):
            fit = corner_fit(corners, poses)
            poses = fit.poses
            own = fit.covariance
            shared = fit.slopes
        else:
            own = _usual(poses)
            shared = SIZE_SIGMA * poses.translation_m * [0, 0, 1]
            shared = np.pad(shared, ((0, 0), (0, 3)))[..., None]
        names = table.row_names()
        images = tuple(names[row] for row in rows.tolist())
        return cls(
            name,
            images,
            tuple(moments[row] for row in rows.tolist()),
            poses,
            own,
            shared,
            fit,
        )


def read_sightings(
    files: Sequence[Path],
    convention: str | None = None,
    inverted: bool = False,
) -> list[Sightings]:
    """Read camera_from_board of every camera and pair their images.

    By names without folder and ending, by the numbers in them, by times, or in order.
    """
    names = [file.stem for file in files]
    if len({*names}) < len(names):
        names = [file.absolute().parent.name for file in files]
    if len({*names}) < len(names):
        raise InputError(
            "`camera_poses`: files name one camera twice; name them after the cameras, such as"
            " left.json right.json"
        )
    tables = [read_camera_poses(file, convention, inverted) for file in files]
    rows = zip(names, tables, _moments(tables, names), strict=True)
    return [Sightings.of(*row) for row in rows]


def _usual(
    poses: SE3,
) -> Array:
    """(n, 6, 6) usual covariance of poses, whose size is estimated later."""
    place = poses.translation_m
    ray = unit_vectors(place)[:, :, None]
    along = ray @ ray.transpose(0, 2, 1)
    covariance = np.zeros((len(poses), 6, 6))
    covariance[:, :3, :3] = _ACROSS**2 * np.eye(3) + _ALONG**2 * along
    covariance[:, :3, :3] *= (place**2).sum(1)[:, None, None]
    covariance[:, 3:, 3:] = _TURNED**2 * np.eye(3)
    return covariance


def _moments(
    tables: Sequence[PoseRows],
    cameras: Strings | list[str],
) -> list[list[str]]:
    """Names of the moments of all rows."""
    if all(table.names for table in tables):
        names = [[*map(without_ending, table.row_names())] for table in tables]
        if any({*first} & {*second} for first, second in combinations(names, 2)):
            return names
        return [[str(last_number(name)) for name in own] for own in names]
    stamps = [table.stamps_s for table in tables if table.stamps_s is not None]
    if len(stamps) == len(tables):
        every = np.sort(np.concatenate(stamps))
        first = every[np.r_[True, np.diff(every) > _APART_S]]
        return [[*map(str, np.searchsorted(first, own, "right"))] for own in stamps]
    counts = [len(table.poses) for table in tables]
    if len({*counts}) > 1:
        listed = ", ".join(map("{} {}".format, cameras, counts))
        raise InputError(
            f"`camera_poses`: the files differ in their number of poses ({listed}); give images of"
            " one moment one name, in a column image"
        )
    return [[*map(str, range(count))] for count in counts]


def require_connected(
    cameras: Sequence[Sightings],
) -> None:
    """Refuse cameras that share no moment with the others, by name."""
    parts: list[list[Sightings]] = []
    for camera in cameras:
        apart = []
        joined = [camera]
        for part in parts:
            if any({*camera.moments} & {*other.moments} for other in part):
                joined = part + joined
            else:
                apart.append(part)
        parts = [*apart, joined]
    if len(parts) == 1:
        return
    listed = []
    for part in parts:
        names = " + ".join(camera.name for camera in part)
        images = part[0].images
        listed.append(f"{names} ({counted(len(images), 'image')}, first {images[0]})")
    raise InputError(
        f"`camera_poses`: cameras in {len(parts)} parts never saw the board at one moment:"
        f" {'; '.join(listed)}. Record images in which cameras of two parts see it; images of one"
        " moment have one name"
    )
