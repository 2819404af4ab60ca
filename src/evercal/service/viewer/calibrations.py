"""What is shown of a calibration: its camera in the base frame, or the reason why not."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from evercal.calibration.calibration import Calibration, read_calibration
from evercal.geometry import SE3, Camera, UncertainPose
from evercal.reports.scene.frusta import Ellipsoid, Frustum


@dataclass(frozen=True, eq=False)
class CalibrationView:
    """A calibration, and where it is."""

    name: str
    """Name of the file."""
    calibration: Calibration
    camera: Camera
    """Its intrinsics; those of the map where it states none."""

    @property
    def scene(self) -> str | None:
        """The scene in whose frame it is; None if the file names none."""
        scene = self.calibration.source.get("scene")
        return None if scene is None else str(scene)

    @property
    def on_gripper(self) -> bool:
        """Whether the gripper carries the camera."""
        return self.calibration.mount == "eye_in_hand"

    def base_from_camera(self, base_from_gripper: SE3 | None) -> UncertainPose | None:
        """The camera in the base frame; None for one on the gripper without a gripper pose."""
        if not self.on_gripper:
            return self.calibration.uncertain_pose
        if base_from_gripper is None:
            return None
        return base_from_gripper @ self.calibration.uncertain_pose

    def shapes(self, base_from_gripper: SE3 | None) -> tuple[Frustum, Ellipsoid] | None:
        """Frustum and ellipsoid in the base frame, or None as `base_from_camera`."""
        pose = self.base_from_camera(base_from_gripper)
        return None if pose is None else (Frustum.of(pose.pose, self.camera), Ellipsoid.of(pose))

    def label(self, scale: float) -> str:
        """Name, standard deviation, and the scale of the ellipsoid."""
        sigma = self.calibration.sigma_mm
        return f"{self.name}: {sigma:.2g} mm (1 sigma), ellipsoid x {scale:g}"

    def rows(self) -> list[tuple[str, str]]:
        """Names and values for the panel."""
        calibration = self.calibration
        where = "on the gripper" if self.on_gripper else "fixed"
        x, y, z = 1000 * calibration.parent_from_child.translation_m
        principal = Ellipsoid.of(calibration.uncertain_pose).sigmas_mm
        rows = [
            ("mount", where),
            (f"in {calibration.parent_frame}", f"{x:+.1f} {y:+.1f} {z:+.1f} mm"),
            ("1 sigma per axis", f"{calibration.sigma_mm:.2g} mm, {calibration.sigma_deg:.2g}°"),
            ("principal axes", f"{principal} mm"),
        ]
        if self.scene is not None:
            rows.append(("scene", self.scene))
        if self.on_gripper:
            rows.append(("drawn", "where --recording or --urdf states the gripper's pose"))
        return rows


def read_views(paths: Sequence[Path], default: Camera) -> list[CalibrationView]:
    """Read calibration files; `default` are intrinsics for files without.

    Raises:
        InputError: A file is missing or holds no calibration.
    """
    calibrations = [read_calibration(path) for path in paths]
    names = [path.stem for path in paths]
    # Two files of one name from two folders stay apart.
    unique = [
        name if names.count(name) == 1 else f"{name} ({i + 1})" for i, name in enumerate(names)
    ]
    return [
        CalibrationView(name, calibration, calibration.camera or default)
        for name, calibration in zip(unique, calibrations, strict=True)
    ]
