"""What fixed cameras saw of one board, moment by moment."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from evercal.calibration.calibration import Calibration, ImageUse
from evercal.calibration.checks import Checks
from evercal.calibration.fixed.corner_fit import CornerFit, corner_fit
from evercal.calibration.pose_pairs.checks import SIZE_SIGMA
from evercal.calibration.pose_pairs.pair_files import PoseRows, read_camera_poses
from evercal.calibration.verdict import verdict
from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.geometry import SE3, UncertainPose, norms
from evercal.recordings.poses.row_files import last_number, without_ending
from evercal.typing import Array, BoolArray, Strings

_ACROSS = 0.002
"""Usual error of the position of a board across the ray, parts of its distance."""
_ALONG = 0.005
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

    @property
    def distance(self) -> float:
        """Median distance of the board, metres."""
        return float(np.median(norms(self.poses.translation_m)))

    @classmethod
    def of(
        cls,
        name: str,
        table: PoseRows,
        moments: Strings,
    ) -> "Sightings":
        """The images of a table that show the board."""
        rows = np.flatnonzero(table.measured)
        if not len(rows):
            raise InputError(f"{name}: no image shows the board")
        names = table.row_names()
        images = tuple(names[row] for row in rows)
        shown = tuple(moments[row] for row in rows)
        poses = table.poses[rows]
        if corners := table.corners_of(rows):
            fit = corner_fit(corners)
            return cls(name, images, shown, fit.poses, fit.covariance, fit.slopes, fit)
        depth = SIZE_SIGMA * poses.translation_m * [0, 0, 1]
        shared = np.pad(depth, ((0, 0), (0, 3)))[..., None]
        return cls(name, images, shown, poses, _usual(poses), shared)


def read_sightings(
    files: Sequence[Path],
    convention: str | None = None,
    inverted: bool = False,
) -> list[Sightings]:
    """Read camera_from_board of every camera and pair their images.

    By names without folder and ending, by the numbers in them, or in order.
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
    moments = _moments(tables)
    return [*map(Sightings.of, names, tables, moments)]


def _usual(
    poses: SE3,
) -> Array:
    """(n, 6, 6) usual covariance of poses, whose size is estimated later."""
    place = poses.translation_m
    covariance = np.zeros((len(poses), 6, 6))
    covariance[:, :3, :3] = _ALONG**2 * place[:, :, None] * place[:, None]
    across = (_ACROSS * norms(place)) ** 2
    covariance[:, :3, :3] += across[:, None, None] * np.eye(3)
    covariance[:, 3:, 3:] = _TURNED**2 * np.eye(3)
    return covariance


def _moments(
    tables: Sequence[PoseRows],
) -> list[Strings]:
    """Names of the moments of all rows."""
    names = [tuple(map(without_ending, table.row_names())) for table in tables]
    if not all(table.names for table in tables):
        counts = [len(own) for own in names]
        if len({*counts}) > 1:
            raise InputError(
                f"`camera_poses`: the files hold {counts} poses; give images of one moment one"
                " name, in a column image"
            )
        return [names[0] for _ in names]
    if any({*first} & {*second} for first, second in combinations(names, 2)):
        return names
    return [tuple(map(_numbered, own)) for own in names]


def _numbered(
    name: str,
) -> str:
    """The last number in a name, else the name."""
    number = last_number(name)
    return name if number is None else str(number)


def judged(
    pose: UncertainPose,
    names: Sequence[str],
    used: BoolArray,
    apart: Array,
    checks: Checks,
    fit: CornerFit | None = None,
) -> Calibration:
    """A fixed camera with its verdict.

    Args:
        pose: base_from_camera.
        names: (n,) images or points.
        used: (n,) whether they agree with the others.
        apart: (n, 2) how far they are off, metres and radians.
        checks: The other checks.
        fit: Corners, with the intrinsics.
    """
    usual = np.sqrt((apart[used] ** 2).mean(0))
    checks = replace(
        checks,
        poses_given=len(used),
        poses_used=int(used.sum()),
        residual_mm=1000 * float(usual[0]),
        residual_deg=float(np.rad2deg(usual[1])),
        corner_sigma_px=fit.sigma_px if fit else None,
    )
    images = []
    away = (1000 * apart[:, 0]).tolist()
    for name, agrees, mm in zip(names, used.tolist(), away, strict=True):
        reason = "" if agrees else f"is {mm:.1f} mm from where the others put it"
        images.append(ImageUse(name, agrees, reason, mm))
    calibration = Calibration(
        "eye_to_hand",
        pose.pose,
        pose.covariance,
        camera=fit.camera if fit else None,
        images=tuple(images),
        lenses=fit.lenses if fit else {},
        checks=checks,
    )
    return replace(calibration, verdict=verdict(calibration))
