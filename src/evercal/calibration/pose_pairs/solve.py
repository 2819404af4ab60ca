"""`solve`: estimate a calibration with uncertainty, checks and verdict from pose pairs."""

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.boards.corners import BoardView, board_pose
from evercal.calibration.boards.lens import lens_vector, moved_camera
from evercal.calibration.calibration import Calibration, ErrorTerm, ImageUse, Mount
from evercal.calibration.pose_pairs.checks import held_out_error, left_open, repeatability
from evercal.calibration.pose_pairs.fit import (
    Agreement,
    HandEyeFit,
    agreement,
    least_sigma,
    robust_fit,
)
from evercal.calibration.pose_pairs.measured import BoardCorners as BoardCorners
from evercal.calibration.pose_pairs.measured import Measured, measured
from evercal.calibration.pose_pairs.mistakes import quick_fit, require_agreement
from evercal.calibration.pose_pairs.observability import require_observable, require_rotations
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.pose_equation import Extras, PoseEquation, Unknowns
from evercal.calibration.verdict import verdict
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, cross_matrix

Array = NDArray[np.floating]

_SIZE_SIGMA = 0.002
"""Relative standard deviation of a stated square size, and of a depth error of all images."""
_SIZE_SIGMAS = 3.0
"""Significance of a wrong size, standard deviations."""
_LARGE_SIZE, _MUCH_BETTER = 0.1, 3.0
"""An error of the size above the first number is believed only if the residuals fall by the second
factor."""
_SCALE_SIGMA = 0.1
"""Maximum relative standard deviation of an unknown scale."""
_MOST_LENSES = 8
"""Number of times that the intrinsics are changed, at most."""
_SAME_LENS = 0.01
"""Squared Mahalanobis length of a change of the intrinsics that is not worth another round."""
_LENS_WARNING = 3.0
"""Deviation of stated intrinsics from the estimate that is reported, standard deviations."""
_CAUSES = {
    "translation": "position of robot and camera poses",
    "depth": "distance from camera to board, image by image",
    "rotation about board": "rotation of the board in the image",
    "rotation about gripper": "rotation of the robot's gripper",
}
_EXTRA_CAUSES = {
    "known": "corners of the board",
    "intrinsics": "intrinsics",
    "shared depth": "distance from camera to board, all images",
    "size": "size of the squares, or scale",
}


def solve(
    pairs: PosePairs,
    mount: Mount,
    scale_known: bool = True,
    corners: BoardCorners | None = None,
) -> Calibration:
    """Calibrate a camera on the gripper or beside the robot from pose pairs.

    Both unknown transforms are estimated jointly: closed-form solutions of many subsets give a
    robust start, then every pose is weighted by the noise estimated from the pairs. With corners,
    the intrinsics are estimated together with the transforms, and each image is weighted by what
    its corners determine.

    A stated size of the squares, the scale of the camera poses and a depth error that all images
    share are unknowns with a prior of 0.2 %. A size that the robot's motions contradict is
    reported and estimated.

    The covariance is enlarged for the uncertainty of the noise estimate, so that the usual
    chi-square quantiles hold (12.59 for 95 % in six dimensions).

    Args:
        pairs: Pose pairs; their order does not matter.
        mount: `eye_in_hand`: the gripper carries the camera and the board is fixed.
            `eye_to_hand`: the camera is fixed and the gripper carries the board.
        scale_known: Whether the camera's translations are in metres; otherwise their scale is
            estimated.
        corners: Corners of the board in the order of `pairs`.

    Returns:
        `gripper_from_camera` or `base_from_camera`.

    Raises:
        InputError: The poses do not determine the calibration or do not agree, or look like another
            convention. The message states the reason and a remedy.
    """
    return solve_pairs(pairs, mount, scale_known, corners).calibration()


@dataclass(frozen=True, eq=False)
class PairSolution:
    """A fit and its pose pairs."""

    pairs: PosePairs
    rows: NDArray[np.int64]
    """Pairs of the equation, sorted by value."""
    first: NDArray[np.int64]
    """(n,) for every pair, the first equal pair."""
    equation: PoseEquation
    fit: HandEyeFit
    mount: Mount
    scale: float
    """Metres per unit of the camera's lengths."""
    warnings: tuple[str, ...]
    corners: BoardCorners | None = None
    lens: Measured | None = None

    @property
    def parent(self) -> str:
        """Frame that carries the camera."""
        return "gripper" if self.mount == "eye_in_hand" else "base"

    @property
    def camera(self) -> Camera | None:
        """Estimated intrinsics, with corners."""
        if self.lens is None:
            return None
        change = self.fit.at.extras[_group(self.equation, "intrinsics")]
        return moved_camera(self.lens.camera, change)

    @property
    def fixed_from_board(self) -> SE3:
        """Estimated pose of the board."""
        return self.fit.at.fixed_from_board @ _shift(_middle(self.corners)).inverse()

    def calibration(self, time_offset_s: float | None = None) -> Calibration:
        """Return the calibration, with another time offset than that of the fit if given."""
        covariance = self.fit.factor * self.fit.covariance[:6, :6]
        calibration = Calibration(
            mount=self.mount,
            parent_from_child=self.fit.at.parent_from_camera,
            covariance=(covariance + covariance.T) / 2,
            parent_frame=self.parent,
            camera=self.camera,
            images=self._images(),
            error_terms=self._error_terms(),
            checks=self._checks(time_offset_s),
            created=datetime.now(UTC).isoformat(timespec="seconds"),
        )
        return replace(calibration, verdict=verdict(calibration))

    def _checks(self, time_offset_s: float | None) -> dict[str, Any]:
        fit, extras = self.fit, self.equation.extras
        used = fit.residual[fit.inliers].reshape(-1, 2, 3)
        rms = np.sqrt((used**2).sum(2).mean(0))
        board = self.fixed_from_board
        distance = np.linalg.norm(self.equation.camera_translation[fit.inliers], axis=1)
        fixed = "base" if self.mount == "eye_in_hand" else "gripper"
        checks: dict[str, Any] = {
            "poses_given": len(self.pairs),
            "poses_used": int(fit.inliers.sum()),
            "residual_mm": 1000 * float(rms[0]),
            "residual_deg": float(np.rad2deg(rms[1])),
            **held_out_error(self.equation, fit),
            **repeatability(self.equation, fit),
            "target_m": float(np.median(distance)),
            f"{fixed}_from_board": {
                "translation_m": board.translation_m.tolist(),
                "quaternion_wxyz": board.rotation_wxyz.tolist(),
            },
            "leave_one_out_mm": self._by_name(1000 * np.linalg.norm(fit.moved[:, :3], axis=1)),
            "information_percent": self._by_name(100 * fit.information),
            "left_open": left_open(fit, self.parent),
            "warnings": list(self.warnings),
        }
        sigma = dict(zip(extras.names, fit.sigma[12:].tolist(), strict=True))
        value = dict(zip(extras.names, fit.at.extras.tolist(), strict=True))
        if "clock" in sigma:
            offset = value["clock"] if time_offset_s is None else time_offset_s
            checks |= {"time_offset_s": offset, "time_offset_sigma_s": sigma["clock"]}
        checks |= {"scale": self.scale * (1 + value["size"]), "scale_sigma": sigma["size"]}
        if self.lens is not None:
            checks["corner_sigma_px"] = self.lens.sigma_px
            lens = [name for name, g in zip(extras.names, extras.groups, strict=True)
                    if g == "intrinsics"]  # fmt: skip
            checks["camera_sigma"] = {name: sigma[name] for name in lens}
        return checks

    def _by_name(self, values: Array) -> dict[str, float]:
        named = zip(self.rows, self.fit.inliers, values.tolist(), strict=True)
        return {self.pairs.names[i]: value for i, used, value in named if used}

    def _images(self) -> tuple[ImageUse, ...]:
        """Return the use of every pair in the given order."""
        row_of = {int(pair): row for row, pair in enumerate(self.rows)}
        uses = []
        for i, name in enumerate(self.pairs.names):
            if i not in row_of:
                other = self.pairs.names[self.first[i]]
                uses.append(ImageUse(name, False, f"repeats {other}, which adds nothing"))
                continue
            row = row_of[i]
            lengths = np.linalg.norm(self.fit.residual[row].reshape(2, 3), axis=1)
            mm, deg = 1000 * float(lengths[0]), float(np.rad2deg(lengths[1]))
            sigmas = float(np.sqrt(self.fit.distance2[row] / 6))
            reason = (
                f"disagrees with the others by {mm:.1f} mm and {deg:.2f} deg, {sigmas:.1f} times"
                " their noise"
            )
            used = bool(self.fit.inliers[row])
            uses.append(ImageUse(name, used, "" if used else reason, mm, deg))
        return tuple(uses)

    def _error_terms(self) -> tuple[ErrorTerm, ...]:
        fit, terms = self.fit, []
        for name, cause in (_CAUSES | _EXTRA_CAUSES).items():
            part = fit.contributions.get(name)
            if part is not None and np.trace(part) > 1e-12 * np.trace(fit.covariance[:6, :6]):
                terms.append(ErrorTerm.of(cause, part))
        rest = fit.factor * fit.covariance[:6, :6] - sum(fit.contributions.values())
        return (*terms, ErrorTerm.of("few poses, and errors alike in similar poses", rest))


def solve_pairs(
    pairs: PosePairs,
    mount: Mount,
    scale_known: bool = True,
    corners: BoardCorners | None = None,
    of_board: bool = True,
) -> PairSolution:
    """Solve pose pairs like `solve`, and return the fit.

    Poses in a map, not `of_board`, may have any direction.
    """
    require_observable(pairs, scale_known)
    rows, first = pairs.distinct(scale_known)
    start, scale = quick_fit(pairs[rows], mount, scale_known)
    require_agreement(pairs[np.sort(rows)], mount, scale_known, start, of_board)
    lens = None
    if corners is not None:
        lens = measured(corners, corners.camera, pairs.camera_from_board)
        pairs = lens.applied_to(pairs)
        start, scale = quick_fit(pairs[rows], mount, scale_known)
        robot = pairs[rows].base_from_gripper
        predicted = _predicted(robot if mount == "eye_in_hand" else robot.inverse(), start, scale)
        corners, poses = _other_board_poses(corners, lens, rows, ~start.inliers, predicted)
        lens = measured(corners, corners.camera, poses)
    problem = _Problem(mount, scale, scale_known, corners)
    equation, fit, lens = problem.fitted(pairs, rows, start.at, lens)
    warnings: list[str] = []
    if scale_known:
        equation, fit, warnings = _with_tested_size(equation, fit, corners)
    else:
        fit = _widened(equation, fit)
    warnings += _lens_warnings(fit, equation, corners, lens)
    _require_determined(pairs[rows[fit.inliers]], fit, equation, scale_known)
    return PairSolution(
        pairs, rows, first, equation, fit, mount, scale, tuple(warnings), corners, lens
    )


@dataclass(frozen=True, eq=False)
class _Problem:
    """What is known of the pairs besides their poses."""

    mount: Mount
    scale: float
    """Metres per unit of the camera's lengths, roughly if it is unknown."""
    scale_known: bool
    corners: BoardCorners | None

    def fitted(
        self, pairs: PosePairs, rows: NDArray[np.int64], start: Unknowns, lens: Measured | None
    ) -> tuple[PoseEquation, HandEyeFit, Measured | None]:
        """Fit all unknowns; with corners, until the intrinsics no longer change."""
        at = _in_the_middle(start, _middle(self.corners))
        for turn in range(_MOST_LENSES):
            equation = self.equation(pairs, lens)[rows]
            at = replace(at, extras=np.zeros(len(equation.extras.names)))
            fit = robust_fit(equation, agreement(equation, at))
            if self.corners is None or lens is None:
                return equation, fit, None
            group, at = _group(equation, "intrinsics"), fit.at
            change = at.extras[group]
            information = equation.extras.information[np.ix_(group, group)]
            # A pose at the threshold of rejection may alternate for ever, and the lens with it.
            least = len(change) if turn == _MOST_LENSES - 1 else _SAME_LENS
            if change @ information @ change < least:
                return equation, fit, lens
            try:
                camera = moved_camera(lens.camera, change)
            except ValueError:
                break
            poses = SE3.stack([pose.camera_from_board for pose in lens.poses])
            lens = measured(self.corners, camera, poses)
        raise InputError(
            "the corners and the robot's motions leave the intrinsics open; tilt the board by 20 to"
            " 45 deg in several directions, or give --camera to evercal detect"
        )

    def equation(self, pairs: PosePairs, lens: Measured | None) -> PoseEquation:
        """Return the equation with all extras, about the middle of the board."""
        extras = Extras.nothing(len(pairs))
        if self.corners is not None and lens is not None:
            pairs, extras = lens.applied_to(pairs), lens.extras(self.corners.prior)
        # The board's origin is a convention; noise about its middle is the same in any other.
        middle = _middle(self.corners)
        lever = np.broadcast_to(np.eye(6), (len(pairs), 6, 6)).copy()
        lever[:, :3, 3:] = -pairs.camera_from_board.rotation_matrix() @ cross_matrix(middle)
        lever[:, :3] *= self.scale
        extras = replace(extras, slopes=lever @ extras.slopes)
        about = pairs.camera_from_board @ _shift(middle)
        moved = replace(pairs, camera_from_board=about).scaled(self.scale)
        if pairs.camera_covariance is not None:
            spread = lever @ pairs.camera_covariance @ lever.transpose(0, 2, 1)
            moved = replace(moved, camera_covariance=spread)
        length = moved.camera_from_board.translation_m
        if lens is None and self.scale_known:
            depth = np.pad(length[:, 2:], ((0, 0), (2, 3)))
            extras = extras.with_one("shared depth", depth, _SIZE_SIGMA)
        size = np.pad(length, ((0, 0), (0, 3)))
        extras = extras.with_one("size", size, _SIZE_SIGMA if self.scale_known else np.inf)
        if pairs.velocity is not None:
            extras = extras.with_one("clock", np.zeros((len(pairs), 6)), np.inf)
        return moved.equation(self.mount, extras)


def _with_tested_size(
    equation: PoseEquation, fit: HandEyeFit, corners: BoardCorners | None
) -> tuple[PoseEquation, HandEyeFit, list[str]]:
    """Free the size of the squares if the robot's motions contradict what was stated.

    The noise is estimated again with the free size: a wrong size looks like noise otherwise.
    """
    free = replace(equation, extras=equation.extras.without_prior("size"))
    freed = robust_fit(free, agreement(free, fit.at))
    k = equation.extras.names.index("size")
    off, sigma = float(freed.at.extras[k]), float(freed.sigma[12 + k])
    sigma *= float(np.sqrt(1 + _alike(freed)))
    if abs(off) < max(_SIZE_SIGMAS * sigma, _SIZE_SIGMA):
        return equation, fit, []
    better = _misfit(fit) / _misfit(freed)
    larger = "larger" if off > 0 else "smaller"
    if abs(off) > _LARGE_SIZE and better < _MUCH_BETTER:
        warning = (
            f"a board {100 * abs(off):.0f} % {larger} than stated would fit the robot's motions"
            f" better, but not well: check its size, the robot poses and the intrinsics"
        )
        return equation, fit, [warning]
    stated = None if corners is None else corners.size_m
    size = f"a square or tag of 24 mm would measure {24 * (1 + off):.2f} mm"
    if stated is not None:
        size = f"its side measures {1000 * stated * (1 + off):.2f} mm, not {1000 * stated:.2f} mm"
    warning = (
        f"the board is {100 * abs(off):.2f} +- {100 * sigma:.2f} % {larger} than stated, by the"
        f" robot's motions"
        f" ({abs(off) / sigma:.0f} standard deviations): {size}; check its size and the focal"
        f" length. The calibration uses the estimated size"
    )
    return free, freed, [warning]


def _alike(fit: HandEyeFit) -> float:
    """Return by how much errors that are alike in similar poses enlarge the variance of the size.

    Errors of an arm depend on its pose. Together as large as the noise, they may move the size by
    as much as all poses together, where independent noise averages out.
    """
    noise = sum(np.trace(fit.contributions[kind][:3, :3]) for kind in fit.levels.kinds)
    return float(noise / np.trace(fit.covariance[:3, :3]) * fit.inliers.sum())


def _widened(equation: PoseEquation, fit: HandEyeFit) -> HandEyeFit:
    """Add what errors of an arm that are alike in similar poses do through an unknown size."""
    k = 12 + equation.extras.names.index("size")
    column = fit.covariance[:, k]
    added = _alike(fit) * np.outer(column, column) / max(fit.covariance[k, k], 1e-300)
    return replace(fit, covariance=fit.covariance + added)


def _misfit(fit: HandEyeFit) -> float:
    """Root mean square residual of the translations, metres."""
    return float(np.sqrt((fit.residual[fit.inliers, :3] ** 2).mean()))


def _lens_warnings(
    fit: HandEyeFit, equation: PoseEquation, corners: BoardCorners | None, lens: Measured | None
) -> list[str]:
    """Compare a stated focal length with the estimate."""
    if corners is None or lens is None or not corners.stated:
        return []
    stated = corners.prior
    change = fit.at.extras[_group(equation, "intrinsics")][0]
    now = lens_vector(lens.camera)[0] + change
    sigma = stated.information[0, 0] ** -0.5
    if abs(now - stated.mean[0]) < _LENS_WARNING * sigma:
        return []
    return [
        f"the stated focal length is {stated.mean[0]:.1f} px, corners and motions give {now:.1f}"
        f" px: check --camera, or omit it"
    ]


def _middle(corners: BoardCorners | None) -> NDArray[np.float64]:
    """(3,) middle of the board's corners, metres; the origin without corners."""
    if corners is None:
        return np.zeros(3)
    return np.mean([view.points_m.mean(0) for view in corners.views], 0)


def _shift(point: NDArray[np.float64]) -> SE3:
    return SE3(np.array([1.0, 0.0, 0.0, 0.0]), point)


def _in_the_middle(at: Unknowns, middle: Array) -> Unknowns:
    """Return the unknowns with the board's origin moved to a point (3,) of the board."""
    moved = at.translations.copy()
    moved[1] += at.rotations[1] @ middle
    return replace(at, translations=moved)


def _group(equation: PoseEquation, name: str) -> NDArray[np.int64]:
    return np.flatnonzero([group == name for group in equation.extras.groups])


def _predicted(fixed_from_parent: SE3, start: Agreement, scale: float) -> SE3:
    """Return camera_from_board by the other poses, in the camera's unit of length."""
    at = start.at
    poses = (fixed_from_parent @ at.parent_from_camera).inverse() @ at.fixed_from_board
    return SE3(poses.rotation_wxyz, poses.translation_m / scale)


def _other_board_poses(
    corners: BoardCorners,
    lens: Measured,
    rows: NDArray[np.int64],
    outliers: NDArray[np.bool_],
    predicted: SE3,
) -> tuple[BoardCorners, SE3]:
    """Fit the board pose of each outlier again, starting from the predicted pose.

    A flat board has two similar poses, and the corners of a symmetric board may be in reverse
    order.
    """
    views, poses = list(corners.views), [pose.camera_from_board for pose in lens.poses]
    for row in np.flatnonzero(outliers):
        i = int(rows[row])
        view, old = corners.views[i], lens.poses[i]
        candidates = [view]
        if corners.half_turn:
            candidates.append(BoardView(view.points_m, view.pixels[::-1]))
        for candidate in candidates:
            pose = board_pose(candidate, lens.camera, predicted[row])
            if pose.squared_px < 4 * old.squared_px + 0.1 * old.corners:
                views[i], poses[i] = candidate, pose.camera_from_board
    return replace(corners, views=tuple(views)), SE3.stack(poses)


def _require_determined(
    used: PosePairs, fit: HandEyeFit, equation: PoseEquation, scale_known: bool
) -> None:
    """Check that the inliers alone determine the calibration."""
    require_rotations(used.base_from_gripper)
    least, size = least_sigma(equation, fit), 12 + equation.extras.names.index("size")
    if not scale_known and not max(float(fit.sigma[size]), least[size]) < _SCALE_SIGMA:
        raise InputError(
            "pure rotation: the poses turn about one point and leave the camera's scale open; also"
            " move the gripper by 10 cm or more between poses"
        )
    spread = np.sqrt(np.abs(fit.covariance[:3, :3].trace()))
    if not (np.isfinite(fit.covariance).all() and spread < 1.0 and least[:3].max() < 0.1):
        raise InputError(
            "the poses leave the position of the camera open by more than a metre; record 15 to 25"
            " poses that turn by 20 to 60 deg about two axes"
        )
