"""Fixed cameras beside each other, by a board that moves before them.

For every sighting, `base_from_camera @ camera_from_board = base_from_board`; the first camera is
the base. The covariance holds errors that sightings share: of intrinsics and of the board's size.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.distance import pdist
from scipy.stats import f

from evercal.calibration.calibration import Calibration, Rig, RigPair
from evercal.calibration.checks import Checks
from evercal.calibration.fixed.corner_fit import widening
from evercal.calibration.fixed.sightings import Sightings, judged
from evercal.calibration.held_thing.slip import CLEAR_SHARE, largest_step
from evercal.calibration.pose_pairs.checks import SIZE_SIGMA
from evercal.errors import InputError
from evercal.geometry import (
    SE3,
    UncertainPose,
    average_poses,
    deviations,
    length_mm_deg,
    norms,
    spread,
)
from evercal.geometry.normal_equations import normal_inverse
from evercal.recordings.poses.pairing import counted
from evercal.robot.frame_names import FrameNames
from evercal.typing import Array, BoolArray, IntArray

_LEAST = 3
"""Least number of moments that a camera shares with the others."""
_GROSS = 0.001
"""Probability of a distance from which on a sighting counts less."""
_USED = 0.3
"""Weight below which a sighting contradicts the others."""
_LEAST_USED = 0.66
"""Share of sightings that agree with the others."""
_LEAST_FOR_SIZE = 5
"""Least number of moments that tell the size of the board."""
_MOST_FOR_SIZE = 100
"""Number of moments whose distances are compared."""
_OTHER_SIZE = 0.015
"""Logarithm of a ratio of lengths above which two boards differ in size."""
_MOST_APART = 0.03
"""Largest usual residual of a position, share of the distance to the board."""
_MOST_APART_RAD = np.deg2rad(5.0)
"""Largest usual residual of a rotation."""
_ROUNDS = 10
_TIED = 4.0
"""Degrees of freedom by which noise of positions and of rotations have one size."""


def _adjusted(
    seen: Sequence[Sightings],
) -> Iterator[tuple[UncertainPose, Array, BoolArray]]:
    """Estimate all cameras and boards with the noise of positions and rotations.

    Yield each camera in the frame of the first one, the residuals (n, 2) of its sightings in metres
    and radians, and whether they are used.
    """
    cameras, known = _placed(seen)
    boards = SE3.stack([*known.values()])
    numbers = {name: number for number, name in enumerate(known)}
    moment = np.array([numbers[name] for own in seen for name in own.moments])
    camera = np.repeat(np.arange(len(seen)), [len(own.poses) for own in seen])
    poses = SE3.stack([pose for own in seen for pose in own.poses])
    root = np.linalg.cholesky(np.concatenate([own.own for own in seen]))
    noise = np.ones(2)
    end = 6 * len(seen)
    # Of each kind; the cameras take half of theirs from it.
    freedom = 3 * (len(poses) - len(boards) - len(seen) + 1)
    most = 6 * f.isf(_GROSS, 6, freedom + _TIED)
    rounds = 0
    while True:
        rows = _rows(seen, poses, cameras[camera], boards[moment], camera)
        white = np.linalg.solve(np.repeat(noise, 3)[:, None] * root, rows)
        squares = (white[..., end] ** 2).sum(1).clip(1e-12)
        weights = np.minimum(1.0, most / squares) ** 2
        white *= weights[:, None, None] ** 0.5
        # Motions of the boards are eliminated.
        by_board = white[..., :6]
        sums = np.zeros((len(boards), *white.shape[1:]))
        np.add.at(sums, moment, by_board.transpose(0, 2, 1) @ white)
        moves = np.linalg.solve(sums[..., :6], sums)
        rest = (white - by_board @ moves[moment]).reshape(-1, white.shape[2])
        slope = rest[:, 6:end]
        covariance = normal_inverse(slope.T @ slope, 1e-14)
        gain = covariance @ slope.T
        step = np.r_[np.zeros(6), gain @ rest[:, end]]
        cameras = SE3.exp(step.reshape(-1, 6)) @ cameras
        boards = SE3.exp(moves[..., end] - moves[..., :end] @ step) @ boards
        squares = noise**2 * (white[..., end].reshape(-1, 2, 3) ** 2).sum((0, 2))
        # Usual noise has one size of both.
        common = squares.mean() / freedom
        noise = np.sqrt((squares + _TIED * common) / (freedom + _TIED))
        rounds += 1
        if rounds == _ROUNDS:
            break
    by_shared = gain @ rest[:, end + 1 :]
    covariance = widening(freedom) * covariance + by_shared @ by_shared.T
    covariance = np.pad(covariance, ((6, 0), (6, 0)))
    apart = norms(rows[..., end].reshape(-1, 2, 3))
    for i, pose in enumerate(cameras):
        own = slice(6 * i, 6 * i + 6)
        moved = UncertainPose(SE3.identity(), covariance[own, own])
        yield moved @ pose, apart[camera == i], weights[camera == i] > _USED


def _rows(
    seen: Sequence[Sightings], poses: SE3, ours: SE3, shown: SE3, camera: IntArray
) -> Array:
    """(n, 6, k) of the sightings by cameras `ours` and boards `shown` in the base.

    By motions of the board and of the cameras but the first, the residuals, and errors that
    sightings share: of intrinsics, and of the size of the board.
    """
    predicted = ours.inverse() @ shown
    by_board = shown.inverse().adjoint()
    by_board[:, :3] = predicted.rotation_matrix() @ by_board[:, :3]
    motions = np.zeros((len(poses), 6, len(seen), 6))
    motions[np.arange(len(poses)), :, camera] = -by_board
    motions[:, :, 0] = by_board
    lenses = block_diag(*[np.concatenate(own.shared) for own in seen])
    size = np.pad(SIZE_SIGMA * poses.translation_m, ((0, 0), (0, 3)))
    parts = [motions, deviations(poses, predicted), lenses, size]
    parts = [part.reshape(len(poses), 6, -1) for part in parts]
    return np.concatenate(parts, 2)


def _placed(
    seen: Sequence[Sightings],
) -> tuple[SE3, dict[str, SE3]]:
    """First poses of all cameras, one after the other, and of the board by moment."""
    first, *rest = seen
    placed = {first.name: SE3.identity()}
    boards = dict(zip(first.moments, first.poses, strict=True))

    def common(camera: Sightings) -> list[int]:
        return [i for i, moment in enumerate(camera.moments) if moment in boards]

    while rest:
        camera = max(rest, key=lambda camera: len(common(camera)))
        rest.remove(camera)
        rows = common(camera)
        if len(rows) < _LEAST:
            raise InputError(
                f"{camera.name} ({counted(len(camera.poses), 'image')}, first {camera.images[0]})"
                f" and {' + '.join(placed)} saw the board together at"
                f" {counted(len(rows), 'moment')}; record {_LEAST} or more, better 10, and give"
                " images of one moment one name"
            )
        theirs = camera.poses[rows]
        ours = SE3.stack([boards[camera.moments[row]] for row in rows])
        _require_one_size(camera.name, theirs.translation_m, ours.translation_m)
        each = ours @ theirs.inverse()
        pose = average_poses(each)
        step = largest_step(deviations(each, pose))
        if step and step.share > CLEAR_SHARE:
            millimetres, degrees = length_mm_deg(step.size)
            raise InputError(
                f"{camera.name}, or a camera beside it, moved by {millimetres:.0f} mm and"
                f" {degrees:.1f} deg before {camera.images[rows[step.before]]}: fasten the cameras"
                " and record again, or use the images before or after"
            )
        placed[camera.name] = pose
        for moment, shown in zip(camera.moments, camera.poses, strict=True):
            boards.setdefault(moment, pose @ shown)
    return SE3.stack([placed[camera.name] for camera in seen]), boards


def _require_one_size(
    name: str,
    theirs: Array,
    ours: Array,
) -> None:
    """Refuse a camera for which a board went other ways than for others."""
    if len(ours) < _LEAST_FOR_SIZE:
        return
    rows = spread(len(ours), _MOST_FOR_SIZE)
    ratios = np.log(pdist(theirs[rows]).clip(1e-9) / pdist(ours[rows]).clip(1e-9))
    ratio = np.median(ratios)
    scatter = np.median(np.abs(ratios - ratio))
    if abs(ratio) > max(_OTHER_SIZE, 5 * scatter / len(rows) ** 0.5):
        raise InputError(
            f"{name}: the board moves {np.exp(ratio):.3g} times as far as before the others: check"
            " the side of its squares, the unit, and that poses are camera_from_board (else"
            " `invert` camera)"
        )


def solve_rig(
    cameras: Sequence[Sightings],
) -> Rig:
    """Estimate fixed cameras beside the first one by a board that moves before them."""
    if len(cameras) < 2:
        raise InputError(
            "`camera_poses`: one camera alone has no place; give the poses of two or more cameras,"
            " or `robot_poses`, or the place of the board with `board_at`"
        )
    first = cameras[0]
    solved: dict[str, Calibration] = {}
    pairs = []
    for seen, (pose, apart, used) in zip(cameras, _adjusted(cameras), strict=True):
        metres, radians = np.median(apart, 0)
        far = metres > _MOST_APART * (seen.distance + 0.1) or radians > _MOST_APART_RAD
        if far or used.mean() < _LEAST_USED:
            raise InputError(
                f"{seen.name}: its poses of the board and those of the others differ by"
                f" {1000 * metres:.0f} mm and {np.rad2deg(radians):.1f} deg: do all see one board;"
                " do images of one moment have one name; are the poses camera_from_board (else"
                " `invert` camera); and did cameras stand still?"
            )
        if seen is first:
            continue
        checks = Checks(target_m=seen.distance)
        calibration = judged(pose, seen.images, used, apart, checks, seen.fit)
        frames = FrameNames(base=first.name)
        solved[seen.name] = replace(calibration, frames=frames)
        common = len({*first.moments} & {*seen.moments})
        pairs.append(RigPair(first.name, seen.name, pose, common))
    return Rig(solved, tuple(pairs))
