"""`solve`: estimate a calibration with uncertainty, checks and verdict from pose pairs."""

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.boards.corners import BoardPose, BoardView, board_pose, pixel_sigma
from evercal.calibration.calibration import Calibration, ErrorTerm, ImageUse, Mount
from evercal.calibration.pose_pairs.checks import (
    held_out_error,
    plausibility_warnings,
    repeatability,
)
from evercal.calibration.pose_pairs.disagreement import require_agreement
from evercal.calibration.pose_pairs.hand_eye import (
    Agreement,
    HandEyeFit,
    agreement,
    fit_weights,
    least_sigma,
    robust_fit,
)
from evercal.calibration.pose_pairs.observability import require_observable, require_rotations
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.pose_equation import PoseEquation
from evercal.calibration.verdict import verdict
from evercal.errors import InputError
from evercal.geometry import SE3, Camera

Array = NDArray[np.floating]

_SCALE_SIGMA = 0.1
"""Maximum relative standard deviation of the scale."""
_NOISE_NAMES = {
    "translation": "translation of robot and camera poses",
    "depth": "distance from camera to board",
    "rotation about board": "rotation of the board in the image",
    "rotation about camera": "direction from camera to board",
    "rotation about gripper": "rotation of the robot's gripper",
    "rotation about base": "rotation of the robot about its base",
}


@dataclass(frozen=True, eq=False)
class BoardCorners:
    """Board corners of the images of pose pairs."""

    camera: Camera
    """Intrinsics of all images."""
    views: tuple[BoardView, ...]
    """One for each pair."""
    half_turn: bool = False
    """Whether the board looks the same after half a turn, so that its corners may be in reverse
    order."""


def solve(
    pairs: PosePairs,
    mount: Mount,
    scale_known: bool = True,
    corners: BoardCorners | None = None,
) -> Calibration:
    """Calibrate a camera on the gripper or beside the robot from pose pairs.

    Both unknown transforms are estimated jointly: closed-form solutions of many subsets give a
    robust start, then every pose is weighted by the noise estimated from the pairs. With corners,
    each image is weighted by the covariance of its board pose, and noise of the robot is added.

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
        InputError: The poses do not determine the calibration or do not agree. The message states
            the reason and a remedy.
    """
    return solve_pairs(pairs, mount, scale_known, corners).calibration()


def solve_pairs(
    pairs: PosePairs, mount: Mount, scale_known: bool, corners: BoardCorners | None
) -> "PairSolution":
    """Solve pose pairs like `solve`, and return the fit."""
    measured: list[BoardPose] | None = None
    if corners is not None:
        pairs, measured = _with_corners(pairs, corners)
    require_observable(pairs, scale_known)
    order = pairs.order()
    first = np.empty(len(pairs), dtype=np.int64)
    first[order] = order[pairs[order].repeats(scale_known)]
    rows = order[first[order] == order]
    equation = pairs[rows].equation(mount, scale_known)
    start = agreement(equation)
    require_agreement(pairs[np.sort(rows)], mount, scale_known, start)
    if corners is not None and measured is not None:
        pairs, measured = _with_other_board_poses(pairs, corners, measured, rows, start, mount)
        equation = pairs[rows].equation(mount, scale_known)
        start = agreement(equation)
    fit = robust_fit(equation, start)
    _require_determined(pairs[rows[fit.inliers]], fit, equation)
    sigma = None
    if measured is not None:
        sigma = pixel_sigma([measured[i] for i in rows[fit.inliers]])
    camera = None if corners is None else corners.camera
    return PairSolution(pairs, rows, first, equation, fit, mount, camera, sigma)


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
    camera: Camera | None
    """Intrinsics, with corners."""
    corner_sigma_px: float | None
    """Standard deviation of a corner coordinate, with corners."""

    @property
    def offset_sigma_s(self) -> float:
        """Standard deviation of the time offset."""
        return float(np.sqrt(self.fit.factor * self.fit.covariance[-1, -1]))

    def calibration(self, time_offset_s: float | None = None) -> Calibration:
        """Return the calibration, with another time offset than that of the fit if given."""
        covariance = self.fit.factor * self.fit.covariance[:6, :6]
        calibration = Calibration(
            mount=self.mount,
            parent_from_child=self.fit.at.parent_from_camera,
            covariance=(covariance + covariance.T) / 2,
            parent_frame="gripper" if self.mount == "eye_in_hand" else "base",
            camera=self.camera,
            images=self._images(),
            error_terms=self._error_terms(),
            checks=self._checks(time_offset_s),
            created=datetime.now(UTC).isoformat(timespec="seconds"),
        )
        return replace(calibration, verdict=verdict(calibration))

    def _checks(self, time_offset_s: float | None) -> dict[str, Any]:
        fit, noise = self.fit, fit_weights(self.equation, self.fit)
        used = fit.residual[fit.inliers].reshape(-1, 2, 3)
        rms = np.sqrt((used**2).sum(2).mean(0))
        board = fit.at.fixed_from_board
        name = "base_from_board" if self.mount == "eye_in_hand" else "gripper_from_board"
        checks: dict[str, Any] = {
            "poses_given": len(self.pairs),
            "poses_used": int(fit.inliers.sum()),
            "residual_mm": 1000 * float(rms[0]),
            "residual_deg": float(np.rad2deg(rms[1])),
            **held_out_error(self.equation, fit, noise),
            **repeatability(self.equation, fit, noise),
            name: {
                "translation_m": board.translation_m.tolist(),
                "quaternion_wxyz": board.rotation_wxyz.tolist(),
            },
            "warnings": plausibility_warnings(self.equation, fit, noise, self.mount),
        }
        if self.equation.velocity is not None:
            offset = fit.at.offset_s if time_offset_s is None else time_offset_s
            checks |= {"time_offset_s": offset, "time_offset_sigma_s": self.offset_sigma_s}
        if not self.equation.scale_known:
            scale = fit.at.scale
            checks |= {"scale": scale, "scale_sigma": scale * _log_scale_sigma(fit)}
        if self.corner_sigma_px is not None:
            checks["corner_sigma_px"] = self.corner_sigma_px
        return checks

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
        fit = self.fit
        covariance = fit.covariance[:6, :6]
        terms = [
            _error_term(_NOISE_NAMES[kind], fit.contributions[i])
            for i, kind in enumerate(fit.levels.kinds)
            if fit.levels.variance[i] > 0
        ]
        if self.pairs.camera_covariance is not None:
            rest = covariance - fit.contributions.sum(0)
            terms.append(_error_term("stated noise of the camera poses", rest))
        few = _error_term("noise estimated from few poses", (fit.factor - 1) * covariance)
        return (*terms, few)


def _with_corners(pairs: PosePairs, corners: BoardCorners) -> tuple[PosePairs, list[BoardPose]]:
    """Replace the camera poses by poses fitted to the corners, with covariances."""
    if len(corners.views) != len(pairs):
        raise ValueError(f"{len(corners.views)} views of corners for {len(pairs)} pose pairs")
    measured = [
        board_pose(view, corners.camera, start)
        for view, start in zip(corners.views, pairs.camera_from_board, strict=True)
    ]
    return _with_board_poses(pairs, measured), measured


def _with_board_poses(pairs: PosePairs, measured: list[BoardPose]) -> PosePairs:
    variance = pixel_sigma(measured) ** 2
    return replace(
        pairs,
        camera_from_board=SE3.stack([pose.camera_from_board for pose in measured]),
        camera_covariance=np.stack([variance * pose.unit_covariance for pose in measured]),
    )


def _with_other_board_poses(
    pairs: PosePairs,
    corners: BoardCorners,
    measured: list[BoardPose],
    rows: NDArray[np.int64],
    start: Agreement,
    mount: Mount,
) -> tuple[PosePairs, list[BoardPose]]:
    """Fit the board pose of each outlier again, starting from the pose that the others predict.

    A flat board has two similar poses, and the corners of a symmetric board may be in reverse
    order.
    """
    at, corrected = start.at, list(measured)
    robot = pairs[rows].base_from_gripper
    robot = robot if mount == "eye_in_hand" else robot.inverse()
    predicted = (robot @ at.parent_from_camera).inverse() @ at.fixed_from_board
    for row in np.flatnonzero(~start.inliers):
        i = int(rows[row])
        view, old = corners.views[i], measured[i]
        views = [view]
        if corners.half_turn:
            views.append(BoardView(view.points_m, view.pixels[::-1]))
        for candidate in views:
            pose = board_pose(candidate, corners.camera, predicted[row])
            if pose.squared_px < 4 * old.squared_px + 0.1 * old.corners:
                corrected[i] = pose
    return _with_board_poses(pairs, corrected), corrected


def _require_determined(used: PosePairs, fit: HandEyeFit, equation: PoseEquation) -> None:
    """Check that the inliers alone determine the calibration."""
    require_rotations(used.base_from_gripper)
    least = least_sigma(equation, fit)
    if not equation.scale_known and not max(_log_scale_sigma(fit), least[12]) < _SCALE_SIGMA:
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


def _log_scale_sigma(fit: HandEyeFit) -> float:
    return float(np.sqrt(fit.factor * fit.covariance[12, 12]))


def _error_term(name: str, covariance: Array) -> ErrorTerm:
    m2, rad2 = np.trace(covariance[:3, :3]) / 3, np.trace(covariance[3:, 3:]) / 3
    metres, radians = np.sqrt(max(m2, 0)), np.sqrt(max(rad2, 0))
    return ErrorTerm(name, 1000 * float(metres), float(np.rad2deg(radians)))
