"""Fixed cameras beside each other, by a board that moves before them.

For every sighting, `base_from_camera @ camera_from_board = base_from_board`; the first camera is
the base. The covariance holds errors that sightings share: of intrinsics and of the board's size.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.distance import pdist
from scipy.stats import chi2, f

from evercal.calibration.calibration import Calibration, Rig, RigPair
from evercal.calibration.checks import Checks
from evercal.calibration.evidence import plus
from evercal.calibration.fixed.sightings import Sightings, image_uses, judged
from evercal.calibration.pose_pairs.checks import SIZE_SIGMA
from evercal.errors import InputError
from evercal.geometry import SE3, average_poses, deviations, length_mm_deg, norms
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
_OTHER_SIZE = 0.04
"""Logarithm of a ratio of lengths above which two boards differ in size."""
_MOST_APART = (0.03, np.deg2rad(5.0))
"""Largest usual residual: share of the distance to the board, and radians."""
_ROUNDS = 10
_TIED = 4.0
"""Degrees of freedom by which noise of positions and of rotations have one size."""
_STEP = 1e-6
"""Step of numerical derivatives."""


class _Adjusted(NamedTuple):
    """All cameras in the frame of the first one."""

    cameras: SE3
    covariance: Array
    """Of the cameras but the first, then the boards."""
    residual: Array
    """(n, 6) of the sightings."""
    weights: Array
    """(n,) of the sightings."""


def _adjusted(
    seen: Sequence[Sightings],
) -> _Adjusted:
    """Estimate all cameras and boards with the noise of positions and rotations."""
    placed, moments = _placed(seen)
    cameras = SE3.stack(placed)
    boards = SE3.stack([*moments.values()])
    names = [*moments]
    moment = np.array([names.index(name) for own in seen for name in own.moments])
    camera = np.repeat(np.arange(len(seen)), [len(own.poses) for own in seen])
    poses = SE3.stack([pose for own in seen for pose in own.poses])
    root = np.linalg.cholesky(np.concatenate([own.own for own in seen]))
    noise = np.ones(2)
    freedom = np.full(2, 3.0 * len(cameras))
    rounds = 0
    while True:
        predicted = cameras[camera].inverse() @ boards[moment]
        residual = deviations(poses, predicted)
        scaled = np.repeat(noise, 3)[:, None] * root
        white = np.linalg.solve(scaled, residual[..., None])[..., 0]
        squares = (white**2).sum(1).clip(1e-12)
        weights = np.minimum(1.0, 6 * f.isf(_GROSS, 6, freedom.min()) / squares) ** 2
        scaled /= weights[:, None, None] ** 0.5
        slope = np.linalg.solve(scaled, _slopes(cameras, boards, camera, moment))
        slope = slope.reshape(residual.size, -1)
        pull = np.linalg.solve(scaled, residual[..., None]).ravel()
        covariance = normal_inverse(slope.T @ slope, 1e-14)
        gain = covariance @ slope.T
        moved = np.r_[np.zeros(6), gain @ pull].reshape(-1, 6)
        cameras = plus(cameras, moved[: len(cameras)])
        boards = plus(boards, moved[len(cameras) :])
        # Unknowns that follow the residuals of a kind take its degrees of freedom.
        left = 1 - (gain.T * slope).sum(1)
        freedom = left.reshape(-1, 2, 3).sum((0, 2)) + _TIED
        squares = (pull.reshape(-1, 2, 3) ** 2).sum((0, 2))
        # Usual noise has one size of both.
        common = (squares * noise**2).sum() / (freedom - _TIED).sum()
        noise = np.sqrt((squares * noise**2 + _TIED * common) / freedom)
        rounds += 1
        if rounds == _ROUNDS:
            break
    few = 6 * f.isf(0.05, 6, freedom.min() - _TIED) / chi2.isf(0.05, 6)
    shared = np.linalg.solve(scaled, _shared(seen, poses)).reshape(residual.size, -1)
    by_shared = gain @ shared
    covariance = few * covariance + by_shared @ by_shared.T
    return _Adjusted(cameras, covariance, residual, weights)


def _slopes(
    cameras: SE3,
    boards: SE3,
    camera: IntArray,
    moment: IntArray,
) -> Array:
    """(n, 6, p) of the predicted sightings by cameras but the first, and boards."""
    ours = cameras[camera]
    shown = boards[moment]
    predicted = ours.inverse() @ shown
    slopes = np.zeros((len(camera), 6, len(cameras) + len(boards), 6))
    rows = np.arange(len(camera))
    for axis, step in enumerate(_STEP * np.eye(6)):
        by_camera = plus(ours, step[None]).inverse() @ shown
        by_board = ours.inverse() @ plus(shown, step[None])
        slopes[rows, :, camera, axis] = deviations(by_camera, predicted) / _STEP
        moved = deviations(by_board, predicted) / _STEP
        slopes[rows, :, len(cameras) + moment, axis] = moved
    return slopes.reshape(len(camera), 6, -1)[:, :, 6:]


def _shared(
    seen: Sequence[Sightings],
    poses: SE3,
) -> Array:
    """(n, 6, q) errors that sightings share: of intrinsics, and of the size of the board."""
    lenses = block_diag(*[np.concatenate(own.shared) for own in seen])
    size = np.pad(SIZE_SIGMA * poses.translation_m, ((0, 0), (0, 3)))
    return np.c_[lenses, size.ravel()].reshape(len(poses), 6, -1)


def _placed(
    seen: Sequence[Sightings],
) -> tuple[list[SE3], dict[str, SE3]]:
    """First poses of all cameras, one after the other, and of the board by moment."""
    placed = {0: SE3.identity()}
    boards = dict(zip(seen[0].moments, seen[0].poses, strict=True))
    while len(placed) < len(seen):
        rest = [i for i in range(len(seen)) if i not in placed]
        common = {i: [m for m in seen[i].moments if m in boards] for i in rest}
        new = max(rest, key=lambda i: len(common[i]))
        camera = seen[new]
        moments = common[new]
        if len(moments) < _LEAST:
            known = " + ".join(seen[i].name for i in placed)
            raise InputError(
                f"{camera.name} ({counted(len(camera.poses), 'image')}, first {camera.images[0]})"
                f" and {known} saw the board together at {counted(len(moments), 'moment')}; record"
                f" {_LEAST} or more, better 10, and give images of one moment one name"
            )
        theirs = camera.poses[np.array([camera.moments.index(m) for m in moments])]
        ours = SE3.stack([boards[moment] for moment in moments])
        _require_one_size(camera.name, theirs.translation_m, ours.translation_m)
        placed[new] = average_poses(ours @ theirs.inverse())
        for moment, pose in zip(camera.moments, camera.poses, strict=True):
            boards.setdefault(moment, placed[new] @ pose)
    return [placed[i] for i in range(len(seen))], boards


def _require_one_size(
    name: str,
    theirs: Array,
    ours: Array,
) -> None:
    """Refuse a camera for which a board went other ways than for others."""
    if len(ours) < _LEAST_FOR_SIZE:
        return
    ratios = np.log(pdist(theirs).clip(1e-9) / pdist(ours).clip(1e-9))
    ratio = np.median(ratios)
    scatter = np.median(np.abs(ratios - ratio))
    if abs(ratio) > max(_OTHER_SIZE, 5 * scatter / len(ours) ** 0.5):
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
    adjusted = _adjusted(cameras)
    first = cameras[0]
    solved: dict[str, Calibration] = {}
    pairs = []
    row = 0
    for i, seen in enumerate(cameras):
        rows = slice(row, row + len(seen.poses))
        row = rows.stop
        residual = adjusted.residual[rows]
        used = adjusted.weights[rows] > _USED
        _require_agreement(seen, residual, used)
        if seen is first:
            continue
        own = slice(6 * i - 6, 6 * i)
        mm, deg = length_mm_deg(np.sqrt((residual[used] ** 2).mean(0)))
        solved[seen.name] = judged(
            Calibration(
                mount="eye_to_hand",
                parent_from_child=adjusted.cameras[i],
                covariance=adjusted.covariance[own, own],
                frames=FrameNames(base=first.name),
                images=image_uses(seen.images, used, 1000 * norms(residual[:, :3])),
                checks=Checks(residual_mm=mm, residual_deg=deg, target_m=seen.distance),
            ),
            seen.fit,
        )
        pose = solved[seen.name].uncertain_pose
        common = len({*first.moments} & {*seen.moments})
        pairs.append(RigPair(first.name, seen.name, pose, common))
    return Rig(solved, tuple(pairs))


def _require_agreement(
    seen: Sightings,
    residual: Array,
    used: BoolArray,
) -> None:
    """Refuse a camera whose sightings contradict the others."""
    lengths = np.median(norms(residual.reshape(-1, 2, 3)), 0)
    far = lengths > np.multiply(_MOST_APART, [seen.distance + 0.1, 1])
    if far.any() or used.mean() < _LEAST_USED:
        mm, deg = length_mm_deg(np.median(np.abs(residual), 0))
        raise InputError(
            f"{seen.name}: its poses of the board and those of the others differ by {mm:.0f} mm"
            f" and {deg:.1f} deg: do all see one board; do images of one moment have one name; are"
            " the poses camera_from_board (else `invert` camera); and did cameras stand still?"
        )
