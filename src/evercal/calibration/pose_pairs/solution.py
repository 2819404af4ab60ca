"""`PairSolution`: a fit of pose pairs, and the calibration made of it."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from evercal.calibration.boards.intrinsics import LENS, moved_lens
from evercal.calibration.calibration import Calibration, ErrorTerm, ImageUse
from evercal.calibration.checks import Checks
from evercal.calibration.pose_pairs.checks import (
    held_out_error,
    left_open,
    repeatability,
)
from evercal.calibration.pose_pairs.fit import HandEyeFit
from evercal.calibration.pose_pairs.pairs import (
    BoardCorners,
    Measured,
    PosePairs,
    middle_of,
)
from evercal.calibration.pose_pairs.pose_equation import PoseEquation
from evercal.calibration.verdict import verdict
from evercal.classes import frozen_arrays
from evercal.geometry import SE3, Camera, length_mm_deg, norms, pose_to_dict
from evercal.robot.mount import MountName, mount_named
from evercal.typing import Array, IntArray, JsonObject, Strings

_CAUSES = {
    "translation": "position of robot and camera poses",
    "depth": "distance from camera to board, image by image",
    "rotation about board": "rotation of the board in the image",
    "rotation about gripper": "rotation of the robot's gripper",
    "joint offsets": "offsets of the arm's joints",
    "smooth translation": "smooth errors of the arm or the board, translation",
    "smooth rotation": "smooth errors of the arm or the board, rotation",
    "drift translation": "drift of the arm over the recording, translation",
    "drift rotation": "drift of the arm over the recording, rotation",
    "known": "corners of the board",
    "intrinsics": "intrinsics",
    "shared depth": "distance from camera to board, all images",
    "size": "size of the squares, or scale",
}
"""Names of the error terms, by kind of noise and group of extras."""


_OF_ARM = ("joint", "smooth", "drift", "rotation about gripper")
"""Kinds that come from the arm begin so; intrinsics from the lens, and others from the images."""


def _origin(kind: str) -> str:
    if kind.startswith(_OF_ARM):
        return "arm"
    return "lens" if kind == "intrinsics" else "images"


@frozen_arrays
class PairSolution:
    """A fit and its pose pairs."""

    pairs: PosePairs
    rows: IntArray
    """Pairs of the equation, sorted by value."""
    first: IntArray
    """(n,) the first pair that is equal to each pair."""
    equation: PoseEquation
    """The equation of `rows`, with all unknowns."""
    fit: HandEyeFit
    """Its fit."""
    mount: MountName
    scale: float
    """Metres per unit of the camera's lengths."""
    warnings: Strings
    corners: BoardCorners | None = None
    lens: Measured | None = None

    @property
    def parent(self) -> str:
        """Frame that carries the camera."""
        return mount_named(self.mount).parent

    @property
    def camera(self) -> Camera | None:
        """Estimated intrinsics, with corners."""
        if not self.lens:
            return None
        change = self.fit.at.extras[self.equation.extras.indices("intrinsics")]
        return moved_lens(
            self.lens.camera,
            self.lens.bend,
            change,
        )[0]

    @property
    def fixed_from_board(self) -> SE3:
        """Estimated pose of the board."""
        middle = self.board_scale * middle_of(self.corners)
        return self.fit.at.fixed_from_board @ SE3.from_translation(-middle)

    @property
    def board_scale(self) -> float:
        """Metres per unit of the lengths of the board, or of the map."""
        size = self.fit.at.extras[self.equation.extras.indices("size")]
        return self.scale * (1 + float(size[0]))

    @property
    def camera_from_board(self) -> SE3:
        """(len(rows),) board poses by the robot's poses and the calibration."""
        equation = self.equation
        carried = self.fit.at.parent_from_camera
        rotation = Rotation.from_matrix(equation.robot_rotation)
        translation = equation.robot_translation
        fixed_from_parent = SE3.of(rotation, translation, canonical=False)
        return (fixed_from_parent @ carried).inverse() @ self.fixed_from_board

    def calibration(self, time_offset_s: float | None = None) -> Calibration:
        """Return the calibration, with another time offset than that of the fit if given."""
        covariance = self.fit.covariance[:6, :6]
        calibration = Calibration(
            mount=self.mount,
            parent_from_child=self.fit.at.parent_from_camera,
            covariance=(covariance + covariance.T) / 2,
            camera=self.camera,
            lenses=self._lenses(),
            images=self._images(),
            error_terms=self._error_terms(),
            checks=Checks(**self._checks(time_offset_s)),
        )
        return replace(calibration, verdict=verdict(calibration))

    def _lenses(self) -> dict[str, Camera]:
        lenses = {}
        if self.camera and self.corners:
            lenses["estimated"] = self.camera
            if self.corners.stated:
                lenses["stated"] = self.corners.camera
        return lenses

    def _checks(
        self,
        time_offset_s: float | None,
    ) -> JsonObject:
        fit = self.fit
        names = self.pairs.names
        residuals = fit.residual[fit.inliers].reshape(-1, 2, 3)
        rms = np.sqrt((residuals**2).sum(2).mean(0))
        distance = norms(self.equation.camera_translation[fit.inliers])
        moved = 1000 * norms(fit.moved[:, :3])
        rows = zip(self.rows, self.camera_from_board, strict=True)
        boards = {names[i]: pose_to_dict(pose) for i, pose in rows}
        scene = mount_named(self.mount).scene
        checks: JsonObject = {
            "poses_given": len(self.pairs),
            "poses_used": int(fit.inliers.sum()),
            "residual_mm": 1000 * float(rms[0]),
            "residual_deg": float(np.rad2deg(rms[1])),
            **held_out_error(self.equation, fit),
            **repeatability(self.equation, fit),
            "target_m": float(np.median(distance)),
            f"{scene}_from_board": pose_to_dict(self.fixed_from_board),
            "leave_one_out_mm": self._by_name(moved),
            "information_percent": self._by_name(100 * fit.information),
            "camera_from_board": boards,
            "left_open": left_open(fit, self.parent),
            "warnings": list(self.warnings),
        }
        extras = self.equation.extras.names
        sigma = dict(zip(extras, fit.sigma[12:].tolist(), strict=True))
        if "clock" in sigma:
            if time_offset_s is None:
                time_offset_s = float(fit.at.extras[extras.index("clock")])
            checks["time_offset_s"] = time_offset_s
            checks["time_offset_sigma_s"] = sigma["clock"]
        checks["scale"] = self.board_scale
        checks["scale_sigma"] = sigma["size"]
        if self.lens and self.corners:
            checks["corner_sigma_px"] = self.lens.sigma_px
            checks["corners_left_out"] = list(self.corners.left_out)
            intrinsics = LENS[self.lens.camera.model]
            checks["camera_sigma"] = {k: sigma[k] for k in intrinsics if k in sigma}
        return checks

    def _by_name(
        self,
        values: Array,
    ) -> dict[str, float]:
        named = zip(self.rows, self.fit.inliers, values.tolist(), strict=True)
        return {self.pairs.names[i]: value for i, used, value in named if used}

    def _images(self) -> tuple[ImageUse, ...]:
        names = self.pairs.names
        row_of = {int(pair): row for row, pair in enumerate(self.rows)}
        uses = []
        for i, name in enumerate(names):
            row = row_of.get(i)
            if row is None:
                reason = f"repeats {names[self.first[i]]}, which adds nothing"
                uses.append(ImageUse(name, False, reason))
                continue
            mm, deg = length_mm_deg(self.fit.residual[row])
            used = bool(self.fit.inliers[row])
            reason = ""
            if not used:
                sigmas = float(np.sqrt(self.fit.distance2[row] / 6))
                reason = (
                    f"disagrees with the others by {mm:.1f} mm and {deg:.2f} deg, {sigmas:.1f}"
                    " times their noise"
                )
            uses.append(ImageUse(name, used, reason, mm, deg))
        return tuple(uses)

    def _error_terms(self) -> tuple[ErrorTerm, ...]:
        fit = self.fit
        least = 1e-6 * np.trace(fit.covariance[:6, :6])
        terms = []
        for name, cause in _CAUSES.items():
            part = fit.contributions.get(name, np.zeros((6, 6)))
            if np.trace(part) > least:
                terms.append(ErrorTerm.of(cause, part, _origin(name)))
        rest = fit.covariance[:6, :6] - sum(fit.contributions.values())
        return (*terms, ErrorTerm.of("few poses", rest))
