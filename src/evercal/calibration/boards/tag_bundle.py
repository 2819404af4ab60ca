"""Bundle adjustment of tags on a rigid thing, of camera poses and of intrinsics."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from evercal.calibration.boards.corners import BoardPose, board_pose, lens_vector
from evercal.calibration.boards.intrinsics import (
    LensPrior,
    lens_estimate,
    moved_camera,
)
from evercal.calibration.boards.marker_layout import Markers
from evercal.calibration.boards.row_shift import CornerNoise
from evercal.calibration.boards.tags import Corners, view_of
from evercal.geometry import SE3, Camera, cross_matrix, norms
from evercal.typing import Array

_MAX_STEP = 0.2
"""Maximum relative change of focal lengths and sides in a round."""
_STRAY = 5.0
"""Residual of a tag in an image, usual ones, above which it is left out."""
_CONVERGED = 1e-3
"""Squared Mahalanobis length of a change that ends bundle adjustment, a term."""
_FIXED = 1e-9
"""Standard deviation of what bundle adjustment keeps."""
_MAX_ROUNDS = 60
"""Maximum number of rounds of bundle adjustment."""
_TERMS = 7
"""Unknowns of a tag: position, rotation, relative size."""


class LooseTags(NamedTuple):
    """Tags that move by themselves, as a departure of a board from its drawing."""

    corners: Array
    """(t, 4, 3) metres."""

    @property
    def terms(self) -> Array:
        """(7 t,) zeros: shifts, rotations about the middle, relative sizes."""
        return np.zeros(_TERMS * len(self.corners))

    def slopes(self, points: Array) -> Array:
        """Return the (k, 3, 7 t) derivative of corners (k, 3) by the terms."""
        tag = KDTree(self.corners.reshape(-1, 3)).query(points)[1] // 4
        arms = points - self.corners.mean(1)[tag]
        slopes = np.zeros((len(points), 3, len(self.corners), _TERMS))
        row = np.arange(len(points))
        slopes[row, :, tag, :3] = np.eye(3)
        slopes[row, :, tag, 3:6] = -cross_matrix(arms)
        slopes[row, :, tag, 6] = arms
        return slopes.reshape(len(points), 3, -1)

    def moved(self, change: Array) -> "LooseTags":
        """The tags after a (7 t,) change."""
        corners = []
        for own, terms in zip(self.corners, change.reshape(-1, _TERMS), strict=True):
            middle = own.mean(0)
            turn = Rotation.from_rotvec(terms[3:6])
            arms = turn.apply(own - middle) * np.exp(terms[6])
            corners.append(middle + terms[:3] + arms)
        return LooseTags(np.array(corners))


class Bundle(NamedTuple):
    """Tags and intrinsics after bundle adjustment."""

    corners: Corners
    camera: Camera
    sigma_px: float
    """Standard deviation of a corner coordinate."""


def adjusted(
    found: Sequence[Markers], start: Bundle, kept: set[int], stated: bool
) -> Bundle:
    """Adjust camera poses, tags that are not `kept`, and intrinsics that are not stated."""
    numbers = sorted(start.corners)
    loose = LooseTags(np.array([start.corners[number] for number in numbers]))
    camera = start.camera
    prior = _prior(camera, stated, [number in kept for number in numbers])
    lens = len(lens_vector(camera))
    fits: list[BoardPose] = []
    shown = [own.without({*own.ids.tolist()} - {*numbers}) for own in found]
    starts: dict[int, SE3] = {}
    corners = start.corners
    fits: list[BoardPose] = []
    for _ in range(_MAX_ROUNDS):
        poses: dict[int, BoardPose] = {}
        for k, own in enumerate(shown):
            view = view_of(own, corners)
            if view:
                poses[k] = board_pose(
                    view,
                    camera,
                    starts.get(k),
                    loose,
                )
        starts = {k: pose.camera_from_board for k, pose in poses.items()}
        fits = list(poses.values())
        sigma_px = CornerNoise.plain(fits).sigma_px
        change, known = lens_estimate(fits, sigma_px, camera, loose, prior)
        steps = np.r_[change[:2] / camera.fx, change[lens:].reshape(-1, _TERMS)[:, 6]]
        change = change / max(1.0, np.abs(steps).max() / _MAX_STEP)
        loose = loose.moved(change[lens:])
        camera = moved_camera(camera, change[:lens])
        corners = dict(
            zip(
                numbers,
                loose.corners,
                strict=True,
            )
        )
        if change @ known @ change < _CONVERGED * len(change):
            rms = {k: norms(fit.residual_px.reshape(-1, 8)) for k, fit in poses.items()}
            most = _STRAY * float(np.median(np.concatenate([*rms.values()])))
            strays = {k: shown[k].ids[own > most].tolist() for k, own in rms.items()}
            if not any(strays.values()):
                break
            shown = [own.without(strays.get(k, ())) for k, own in enumerate(shown)]
    return Bundle(corners, camera, CornerNoise.plain(fits).sigma_px)


def _prior(
    camera: Camera,
    stated: bool,
    kept: Sequence[bool],
) -> LensPrior:
    """What is known of intrinsics and tags before."""
    usual = LensPrior.usual(camera)
    vector = lens_vector(camera)
    lens = len(vector)
    mean = np.r_[usual.mean[:lens], np.zeros(_TERMS * len(kept))]
    fixed = np.r_[np.zeros(lens), np.repeat(kept, _TERMS) / _FIXED**2]
    information = np.diag(fixed)
    information[:lens, :lens] = usual.information[:lens, :lens]
    if stated:
        mean[:lens] = vector
        information[:lens, :lens] = np.eye(lens) / _FIXED**2
    return LensPrior(mean, information)
