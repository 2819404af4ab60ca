"""`solve`: pose pairs in, a `Calibration` with its uncertainty, checks and verdict out."""

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.boards.corners import BoardPose, BoardView, board_pose, pixel_sigma
from evercal.calibration.calibration import Calibration, ErrorTerm, ImageUse, Mount
from evercal.calibration.pose_pairs.checks import held_out_error, repeatability
from evercal.calibration.pose_pairs.disagreement import require_agreement
from evercal.calibration.pose_pairs.hand_eye import (
    Agreement,
    HandEyeFit,
    SolveOptions,
    agreement,
    fit_weights,
    least_sigma,
    robust_fit,
)
from evercal.calibration.pose_pairs.observability import require_observable, require_turns
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.plausibility import warnings_of
from evercal.calibration.pose_pairs.pose_equation import PoseEquation
from evercal.calibration.verdict import verdict
from evercal.errors import InputError
from evercal.geometry import SE3, Camera

Array = NDArray[np.floating]

_SCALE_SIGMA = 0.1
"""Share of the scale that it must be sure to."""


@dataclass(frozen=True, eq=False)
class BoardCorners:
    """The corners behind the camera poses of pose pairs."""

    camera: Camera
    """Intrinsics of all images."""
    views: tuple[BoardView, ...]
    """One for each pair."""
    half_turn: bool = False
    """Whether the board looks the same turned by half a turn, so that its corners may have been
    counted from the other end."""


def solve(
    pairs: PosePairs,
    mount: Mount,
    scale_known: bool = True,
    corners: BoardCorners | None = None,
    options: SolveOptions | None = None,
) -> Calibration:
    """Finds where a camera sits on the gripper, or where it stands in the robot's base.

    Both unknown transforms are found together: a consensus of closed-form answers, then a joint
    robust refinement that weighs every pose by the noise that the pairs themselves show. With
    corners, each image counts along each axis as much as its corners tell of it, and the robot's
    poses have an error of their own.

    The covariance contains that the noise was judged from few poses: it is enlarged so that the
    usual chi-square quantiles hold (12.59 for 95 % in six dimensions).

    Args:
        pairs: in any order; the answer does not depend on it.
        mount: `eye_in_hand`, the gripper carries the camera and sees a fixed board, or
            `eye_to_hand`, the camera stands still and sees a board in the gripper.
        scale_known: whether the camera's translations are in metres; else their scale is found.
        corners: of a board, in the order of `pairs`.
        options: of the rejection of outliers.

    Returns:
        `gripper_from_camera` or `base_from_camera`.

    Raises:
        InputError: The poses cannot give an answer, or do not agree; the message says why and what
            to do.
    """
    measured: list[BoardPose] | None = None
    if corners is not None:
        pairs, measured = _with_corners(pairs, corners)
    require_observable(pairs, scale_known)
    order = pairs.order()
    repeats = _repeats(pairs, order, scale_known)
    kept = order[repeats[order] == order]
    equation = pairs[kept].equation(mount, scale_known)
    found = agreement(equation)
    require_agreement(pairs[np.sort(kept)], mount, scale_known, found)
    if corners is not None and measured is not None:
        pairs, measured = _seen_again(pairs, corners, measured, kept, found, mount)
        equation = pairs[kept].equation(mount, scale_known)
        found = agreement(equation)
    fit = robust_fit(equation, found, options)
    _require_answer(pairs[kept[fit.inliers]], fit, equation)
    result = _Result(pairs, kept, repeats, equation, fit, mount)
    checks = result.checks()
    if measured is not None:
        checks["corner_sigma_px"] = pixel_sigma([measured[i] for i in kept[fit.inliers]])
    return result.calibration(checks, None if corners is None else corners.camera)


@dataclass(frozen=True, eq=False)
class _Result:
    """A fit with the pairs it was made from."""

    pairs: PosePairs
    kept: NDArray[np.int64]
    """The pairs of the equation, sorted."""
    repeats: NDArray[np.int64]
    """(n,) for every pair the one that it repeats, or its own number."""
    equation: PoseEquation
    fit: HandEyeFit
    mount: Mount

    def checks(self) -> dict[str, Any]:
        fit, noise = self.fit, fit_weights(self.equation, self.fit)
        used = fit.residual[fit.inliers].reshape(-1, 2, 3)
        rms = np.sqrt((used**2).sum(2).mean(0))
        checks: dict[str, Any] = {
            "poses_given": len(self.pairs),
            "poses_used": int(fit.inliers.sum()),
            "residual_mm": 1000 * float(rms[0]),
            "residual_deg": float(np.rad2deg(rms[1])),
            **held_out_error(self.equation, fit, noise),
            **repeatability(self.equation, fit, noise),
        }
        at = fit.at.fixed_from_board
        name = "base_from_board" if self.mount == "eye_in_hand" else "gripper_from_board"
        checks[name] = {
            "translation_m": at.translation_m.tolist(),
            "quaternion_wxyz": at.rotation_wxyz.tolist(),
        }
        checks["warnings"] = warnings_of(self.equation, fit, noise, self.mount)
        if self.equation.velocity is not None:
            checks["time_offset_s"] = fit.at.offset_s
            checks["time_offset_sigma_s"] = float(np.sqrt(fit.factor * fit.covariance[-1, -1]))
        if not self.equation.scale_known:
            checks["scale"] = fit.at.scale
            checks["scale_sigma"] = fit.at.scale * _log_scale_sigma(fit)
        return checks

    def images(self) -> tuple[ImageUse, ...]:
        """What became of every pair, in the order that they were given in."""
        row_of = {int(pair): row for row, pair in enumerate(self.kept)}
        uses = []
        for i, name in enumerate(self.pairs.names):
            if i not in row_of:
                other = self.pairs.names[self.repeats[i]]
                uses.append(ImageUse(name, False, f"repeats {other}, which adds nothing"))
                continue
            row = row_of[i]
            lengths = np.linalg.norm(self.fit.residual[row].reshape(2, 3), axis=1)
            mm, deg = 1000 * float(lengths[0]), float(np.rad2deg(lengths[1]))
            used = bool(self.fit.inliers[row])
            uses.append(ImageUse(name, used, "" if used else self._why(row, mm, deg), mm, deg))
        return tuple(uses)

    def error_terms(self) -> tuple[ErrorTerm, ...]:
        fit = self.fit
        answer = fit.covariance[:6, :6]
        terms = [
            _term(_IN_WORDS[kind], fit.contributions[i])
            for i, kind in enumerate(fit.levels.kinds)
            if fit.levels.variance[i] > 0
        ]
        rest = answer - fit.contributions.sum(0)
        if self.pairs.camera_covariance is not None:
            terms.append(_term("stated noise of the camera poses", rest))
        terms.append(_term("noise judged from few poses", (fit.factor - 1) * answer))
        return tuple(terms)

    def calibration(self, checks: dict[str, Any], camera: Camera | None) -> Calibration:
        covariance = self.fit.factor * self.fit.covariance[:6, :6]
        made = Calibration(
            mount=self.mount,
            parent_from_child=self.fit.at.parent_from_camera,
            covariance=(covariance + covariance.T) / 2,
            parent_frame="gripper" if self.mount == "eye_in_hand" else "base",
            camera=camera,
            images=self.images(),
            error_terms=self.error_terms(),
            checks=checks,
            created=datetime.now(UTC).isoformat(timespec="seconds"),
        )
        return replace(made, verdict=verdict(made))

    def _why(self, row: int, mm: float, deg: float) -> str:
        times = float(np.sqrt(self.fit.distance2[row] / 6))
        return (
            f"disagrees with the others by {mm:.1f} mm and {deg:.2f} deg, {times:.1f} times what"
            f" their noise explains"
        )


def _with_corners(pairs: PosePairs, corners: BoardCorners) -> tuple[PosePairs, list[BoardPose]]:
    """The pairs with poses fitted to the corners, and their covariances."""
    if len(corners.views) != len(pairs):
        raise ValueError(f"{len(corners.views)} views of corners for {len(pairs)} pose pairs")
    measured = [
        board_pose(view, corners.camera, start)
        for view, start in zip(corners.views, pairs.camera_from_board, strict=True)
    ]
    return _measured(pairs, measured), measured


def _measured(pairs: PosePairs, measured: list[BoardPose]) -> PosePairs:
    variance = pixel_sigma(measured) ** 2
    return replace(
        pairs,
        camera_from_board=SE3.stack([pose.camera_from_board for pose in measured]),
        camera_covariance=np.stack([variance * pose.unit_covariance for pose in measured]),
    )


def _seen_again(
    pairs: PosePairs,
    corners: BoardCorners,
    measured: list[BoardPose],
    kept: NDArray[np.int64],
    found: Agreement,
    mount: Mount,
) -> tuple[PosePairs, list[BoardPose]]:
    """Second look at images that disagree.

    A flat board has two poses that look nearly alike, and one that looks the same turned by half a
    turn may have been counted from the wrong end.
    """
    at, again = found.at, list(measured)
    robot = pairs[kept].base_from_gripper
    robot = robot if mount == "eye_in_hand" else robot.inverse()
    predicted = (robot @ at.parent_from_camera).inverse() @ at.fixed_from_board
    for row in np.flatnonzero(~found.inliers):
        i = int(kept[row])
        view, old = corners.views[i], measured[i]
        views = [view]
        if corners.half_turn:
            views.append(BoardView(view.points_m, view.pixels[::-1]))
        for seen in views:
            pose = board_pose(seen, corners.camera, predicted[row])
            if pose.squared_px < 4 * old.squared_px + 0.1 * old.corners:
                again[i] = pose
    return _measured(pairs, again), again


def _repeats(pairs: PosePairs, order: NDArray[np.int64], scale_known: bool) -> NDArray[np.int64]:
    """(n,) for every pair the one that it repeats, whatever order they were given in."""
    repeats = np.empty(len(pairs), dtype=np.int64)
    repeats[order] = order[pairs[order].repeats(scale_known)]
    return repeats


def _require_answer(used: PosePairs, fit: HandEyeFit, equation: PoseEquation) -> None:
    """The poses that were not rejected must suffice as well.

    Raises:
        InputError: They turn about one axis only, or leave the scale open.
    """
    require_turns(used.base_from_gripper)
    least = least_sigma(equation, fit)
    if not equation.scale_known and not max(_log_scale_sigma(fit), least[12]) < _SCALE_SIGMA:
        raise InputError(
            "pure rotation: the poses turn about one point and leave the camera's scale open; move"
            " the gripper by 10 cm or more between poses as well"
        )
    spread = np.sqrt(np.abs(fit.covariance[:3, :3].trace()))
    if not (np.isfinite(fit.covariance).all() and spread < 1.0 and least[:3].max() < 0.1):
        raise InputError(
            "the poses leave the answer open by more than a metre; record 15 to 25 poses that turn"
            " by 20 to 60 deg about two axes"
        )


def _log_scale_sigma(fit: HandEyeFit) -> float:
    return float(np.sqrt(fit.factor * fit.covariance[12, 12]))


def _term(name: str, covariance: Array) -> ErrorTerm:
    mm2, rad2 = np.trace(covariance[:3, :3]) / 3, np.trace(covariance[3:, 3:]) / 3
    return ErrorTerm(
        name, 1000 * float(np.sqrt(max(mm2, 0))), float(np.rad2deg(np.sqrt(max(rad2, 0))))
    )


_IN_WORDS = {
    "translation": "translation of robot and camera poses",
    "depth": "distance from camera to board",
    "turn about board": "rotation of the board as seen",
    "turn about camera": "direction in which the board is seen",
    "turn about gripper": "rotation of the robot's gripper",
    "turn about base": "rotation of the robot about its base",
}
