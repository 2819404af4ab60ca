"""`solve`: estimate a calibration with uncertainty, checks and verdict from pose pairs."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from evercal.calibration.boards.corners import board_pose
from evercal.calibration.boards.intrinsics import moved_lens
from evercal.calibration.boards.row_shift import CornerNoise
from evercal.calibration.calibration import Calibration
from evercal.calibration.pose_pairs.changed_focus import focus_warning
from evercal.calibration.pose_pairs.checks import (
    SIZE_SIGMA,
    require_observable,
    require_rotations,
    require_two_lists,
    with_tested_size,
)
from evercal.calibration.pose_pairs.corner_warnings import corner_warnings
from evercal.calibration.pose_pairs.fit import (
    Agreement,
    HandEyeFit,
    agreement,
    least_sigma,
    robust_fit,
)
from evercal.calibration.pose_pairs.mistakes import require_agreement
from evercal.calibration.pose_pairs.pairs import (
    BoardCorners as BoardCorners,
    Measured,
    PosePairs,
    measured,
    middle_of,
)
from evercal.calibration.pose_pairs.pose_equation import Extras, PoseEquation, Unknowns
from evercal.calibration.pose_pairs.second_group import second_group
from evercal.calibration.pose_pairs.shared import with_shared
from evercal.calibration.pose_pairs.slips import Slip
from evercal.calibration.pose_pairs.solution import PairSolution
from evercal.calibration.pose_pairs.starts import quick_fit
from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.geometry import SE3, cross_matrix, norms, pose_distance
from evercal.robot.mount import MountName, mount_named
from evercal.robot.pose_errors import ArmErrors
from evercal.storage.provenance import call
from evercal.typing import BoolArray, IntArray

_USUAL = ArmErrors()
"""An arm of which nothing is known."""
_REACH_M = 0.4
"""Distance from the gripper of what it carries above which the mount may be the other one."""
_OTHER_MOUNT = 4.0
"""Ratio of that distance to the distance of what the base carries, above which it may be."""
_SCALE_SIGMA = 0.1
"""Maximum relative standard deviation of an unknown scale."""
_MAX_LENSES = 12
"""Maximum number of changes of the intrinsics."""
_SAME_LENS = 0.01
"""Squared Mahalanobis length of a change of the intrinsics that is ignored."""


def solve(
    pairs: PosePairs,
    mount: MountName,
    scale_known: bool = True,
    corners: BoardCorners | None = None,
    errors: ArmErrors = _USUAL,
) -> Calibration:
    """Calibrate a camera on the gripper or beside the robot from pose pairs.

    Both unknown transforms are estimated jointly, and poses are weighted by the noise estimated
    from the pairs. With corners, the intrinsics are estimated, too, and each image is weighted by
    what its corners determine. A stated size of the squares, the scale of the camera poses and a
    depth error that all images share are unknowns with a prior of 0.2 %. A size that the robot's
    motions contradict is reported and estimated.

    Errors of the robot's poses that they share, see `shared_errors`, are taken in where the pairs
    show them. The covariance allows for the uncertainty of the noise estimate: the usual chi-square
    quantiles hold (12.59 for 95 % in six dimensions).

    Args:
        pairs: Pose pairs in the order of time.
        mount: `eye_in_hand`: the gripper carries the camera and the board is fixed.
            `eye_to_hand`: the camera is fixed and the gripper carries the board.
        scale_known: Whether the camera's translations are in metres; otherwise their scale is
            estimated.
        corners: Corners of the board in the order of `pairs`.
        errors: What is known of the arm.

    Returns:
        `gripper_from_camera` or `base_from_camera`.
    """
    with call(("evercal.solve",), locals()):
        solution = solve_pose_pairs(pairs, mount, scale_known, corners, errors=errors)
        return solution.calibration()


def solve_pose_pairs(
    pairs: PosePairs,
    mount: MountName,
    scale_known: bool = True,
    corners: BoardCorners | None = None,
    of_board: bool = True,
    errors: ArmErrors = _USUAL,
) -> PairSolution:
    """Like `solve`, but return the fit. Poses in a map, not `of_board`, may have any direction."""
    mount_named(mount)
    if of_board:
        require_two_lists(pairs)
    require_observable(pairs, scale_known)
    rows, first = pairs.distinct(scale_known)
    start, scale = quick_fit(pairs[rows], mount, scale_known)
    own_camera = corners is not None or not of_board
    in_order = pairs[np.sort(rows)]
    _require_agreement(in_order, mount, scale_known, start, corners, own_camera)
    lens = None
    if corners:
        refined = _by_corners(pairs, rows, mount, scale_known, corners)
        pairs, corners, lens, start, scale = refined
    problem = _Problem(mount, scale, scale_known, corners, of_board)
    equation, fit, lens = problem.fitted(pairs, rows, start.at, lens)
    plain = equation, fit
    equation, fit, slip = with_shared(pairs, rows, errors, equation, fit)
    focused = []
    if of_board and not slip:
        focused = focus_warning(*plain, rows, pairs.names)
    warnings: list[str] = []
    if scale_known:
        equation, fit, warnings = with_tested_size(equation, fit, corners, of_board)
    if slip:
        fit = replace(fit, covariance=fit.covariance + slip.spread)
        warnings.append(_slip_warning(slip, pairs.names, of_board))
    else:
        warnings += focused or second_group(equation, fit, rows, pairs.names)
    if corners and lens:
        warnings += corner_warnings(fit, equation, corners, lens)
    if of_board:
        warnings += _mount_warnings(fit.at, mount)
    _require_determined(pairs[rows[fit.inliers]], fit, equation, scale_known)
    return PairSolution(
        pairs=pairs,
        rows=rows,
        first=first,
        equation=equation,
        fit=fit,
        mount=mount,
        scale=scale,
        warnings=tuple(warnings),
        corners=corners,
        lens=lens,
    )


def _require_agreement(
    pairs: PosePairs,
    mount: MountName,
    scale_known: bool,
    start: Agreement,
    corners: BoardCorners | None,
    own_camera: bool,
) -> None:
    """Check that pairs agree; intrinsics that the corners contradict are named first."""
    try:
        require_agreement(pairs, mount, scale_known, start, own_camera)
    except InputError as error:
        if corners and (cause := corners.contradiction()):
            raise InputError(f"{cause}. With it, {error}") from None
        raise


def _by_corners(
    pairs: PosePairs,
    rows: IntArray,
    mount: MountName,
    scale_known: bool,
    corners: BoardCorners,
) -> tuple[PosePairs, BoardCorners, Measured, Agreement, float]:
    """Fit the board poses to the corners without strays, those of outliers by the other pairs.

    Returns:
        Pairs with these poses, corners, board poses, and the agreement and scale of the pairs.
    """
    lens = measured(corners, corners.camera, pairs.camera_from_board)
    corners = corners.without_strays(pairs.names, lens.poses)
    lens = measured(corners, corners.camera, pairs.camera_from_board)
    pairs = lens.applied_to(pairs)
    start, scale = quick_fit(pairs[rows], mount, scale_known)
    predicted = _predicted(
        pairs[rows],
        mount,
        start.at,
        scale,
    )
    outliers = ~start.inliers
    corners, poses = _other_board_poses(corners, lens, rows, outliers, predicted)
    lens = measured(corners, corners.camera, poses)
    return pairs, corners, lens, start, scale


def _predicted(
    pairs: PosePairs,
    mount: MountName,
    at: Unknowns,
    scale: float,
) -> SE3:
    """Return (n,) board poses by the robot's poses, in units of the camera poses."""
    fixed_from_parent = mount_named(mount).scene_from_parent(pairs.base_from_gripper)
    fixed_from_camera = fixed_from_parent @ at.parent_from_camera
    predicted = fixed_from_camera.inverse() @ at.fixed_from_board
    return SE3(predicted.rotation_wxyz, predicted.translation_m / scale)


def _slip_warning(
    slip: Slip,
    names: Sequence[str],
    of_board: bool,
) -> str:
    what = slip.what
    if not of_board:
        what = what.replace("board", "map")
    return (
        f"the {what} looks moved by {1000 * slip.metres:.1f} mm and"
        f" {np.rad2deg(slip.radians):.2f} deg before {names[slip.row]}, or the"
        " robot's base, or the arm drifts: calibrate from the poses before or after it, or fasten"
        " it and record again"
    )


@frozen_arrays
class _Problem:
    """What is known of the pairs besides their poses."""

    mount: MountName
    scale: float
    """Metres per unit of the camera's lengths, roughly if it is unknown."""
    scale_known: bool
    corners: BoardCorners | None
    of_board: bool

    def fitted(
        self,
        pairs: PosePairs,
        rows: IntArray,
        start: Unknowns,
        lens: Measured | None,
    ) -> tuple[PoseEquation, HandEyeFit, Measured | None]:
        """Fit all unknowns; with corners, until the intrinsics no longer change."""
        # The board's origin becomes the middle of its corners, see `equation`.
        shifts = start.translations.copy()
        shifts[1] += start.rotations[1] @ middle_of(self.corners)
        at = replace(start, translations=shifts)
        accepted = np.ones(len(pairs), bool)
        with_shift = False
        for remaining in reversed(range(_MAX_LENSES)):
            equation = self.equation(pairs, lens, accepted)[rows]
            at = replace(at, extras=np.zeros(len(equation.extras.names)))
            fit = robust_fit(equation, agreement(equation, at))
            if not self.corners or not lens:
                return equation, fit, None
            before = accepted
            accepted = np.isin(np.arange(len(pairs)), rows[fit.inliers])
            group = equation.extras.indices("intrinsics")
            at = fit.at
            change = at.extras[group]
            information = equation.extras.information[np.ix_(group, group)]
            length2 = change @ information @ change
            same = (accepted == before).all() and length2 < _SAME_LENS
            # A pose at the threshold of rejection may alternate for ever, and the lens with it.
            most_shift_px = lens.noise.row_shift_px
            if same or (not remaining and length2 < len(change)):
                if with_shift or not CornerNoise.of(lens.poses).row_shift_px:
                    return equation, fit, lens
                with_shift = True
                most_shift_px = np.inf
            try:
                camera, bend = moved_lens(lens.camera, lens.bend, change)
            except ValueError:
                break
            poses = SE3.stack([pose.camera_from_board for pose in lens.poses])
            lens = measured(self.corners, camera, poses, bend, most_shift_px)
        raise InputError(
            "the corners and the robot's motions leave the intrinsics open; tilt the board by 20 to"
            " 45 deg in several directions, or give `camera` to evercal detect"
        )

    def equation(
        self, pairs: PosePairs, lens: Measured | None, accepted: BoolArray
    ) -> PoseEquation:
        """Return the equation with all extras, about the middle of the board.

        The corners of `accepted` (n,) images estimate the intrinsics.
        """
        extras = Extras.nothing(len(pairs))
        if self.corners and lens:
            pairs = lens.applied_to(pairs)
            extras = lens.extras(self.corners.prior, accepted)
        # The board's origin is a convention; noise about its middle is the same in any other.
        middle = middle_of(self.corners)
        rotations = pairs.camera_from_board.rotation_matrix()
        lever = np.broadcast_to(np.eye(6), (len(pairs), 6, 6)).copy()
        lever[:, :3, 3:] = -rotations @ cross_matrix(middle)
        lever[:, :3] *= self.scale
        extras = replace(extras, slopes=lever @ extras.slopes)
        about = pairs.camera_from_board @ SE3.from_translation(middle)
        moved = replace(pairs, camera_from_board=about).scaled(self.scale)
        if pairs.camera_covariance is not None:
            spread = lever @ pairs.camera_covariance @ lever.transpose(0, 2, 1)
            moved = replace(moved, camera_covariance=spread)
        length = moved.camera_from_board.translation_m
        if not lens and self.scale_known and self.of_board:
            depth = np.pad(length[:, 2:], ((0, 0), (2, 3)))
            extras = extras.with_one("shared depth", depth, SIZE_SIGMA)
        size = np.pad(length, ((0, 0), (0, 3)))
        sigma = SIZE_SIGMA if self.scale_known else np.inf
        extras = extras.with_one("size", size, sigma)
        if pairs.velocity is not None:
            extras = extras.with_one("clock", np.zeros((len(pairs), 6)), np.inf)
        return moved.equation(self.mount, extras)


def _mount_warnings(at: Unknowns, mount: MountName) -> list[str]:
    """The other mount with inverted robot poses obeys the same equation."""
    camera, board = norms(at.translations).tolist()
    mounted = mount_named(mount)
    carried = board
    if mounted.moves:
        carried = camera
    if carried < max(_REACH_M, _OTHER_MOUNT * min(camera, board)):
        return []
    return [
        f"the camera is {camera:.2f} m from the {mounted.parent} and the board {board:.2f} m from"
        f" the {mounted.scene}: if it is the other way round, the robot poses are"
        f" gripper_from_base, as easy_handeye states for a fixed camera; use `mount`"
        f" {mounted.other.name} and `invert` robot"
    ]


def _other_board_poses(
    corners: BoardCorners,
    lens: Measured,
    rows: IntArray,
    outliers: BoolArray,
    predicted: SE3,
) -> tuple[BoardCorners, SE3]:
    """Fit the board pose of each outlier again, starting from the predicted pose.

    A flat board has two similar poses, and a symmetric board several orders of its corners.
    """
    views = list(corners.views)
    poses = [pose.camera_from_board for pose in lens.poses]
    for row in np.flatnonzero(outliers):
        i = int(rows[row])
        nearest = np.inf
        view = corners.views[i]
        old = lens.poses[i]
        most = 4 * old.squared_px + 0.1 * old.corners
        for candidate in (view, *corners.turned(view)):
            pose = board_pose(candidate, lens.camera, predicted[row])
            # All orders of a symmetric board fit; the other poses decide between them.
            _, turn = pose_distance(pose.camera_from_board, predicted[row])
            if pose.squared_px < most and turn < nearest:
                views[i] = candidate
                poses[i] = pose.camera_from_board
                nearest = float(turn)
    return replace(corners, views=tuple(views)), SE3.stack(poses)


def _require_determined(
    used: PosePairs, fit: HandEyeFit, equation: PoseEquation, scale_known: bool
) -> None:
    """Check that the inliers alone determine the calibration."""
    require_rotations(used.base_from_gripper)
    least = least_sigma(equation, fit)
    size = 12 + equation.extras.names.index("size")
    if not scale_known and not max(float(fit.sigma[size]), least[size]) < _SCALE_SIGMA:
        raise InputError(
            "pure rotation: the poses turn about one point and leave the camera's scale open; also"
            " move the gripper by 10 cm or more between poses"
        )
    spread = np.sqrt(np.abs(fit.covariance[:3, :3].trace()))
    finite = np.isfinite(fit.covariance).all()
    if not (finite and spread < 1.0 and least[:3].max() < 0.1):
        raise InputError(
            "the poses leave the position of the camera open by more than a metre; record 15 to 25"
            " poses that turn by 20 to 60 deg about two axes"
        )
