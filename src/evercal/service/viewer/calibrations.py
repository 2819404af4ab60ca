"""Calibrations in the scene: cameras, labels and ellipsoids of their positions."""

from collections.abc import Mapping

import viser

from evercal.calibration.calibration import Calibration
from evercal.geometry import SE3, Camera
from evercal.reports.scene.frusta import Ellipsoid, Frustum, readable_scale
from evercal.service.viewer.drawing import add_frustum, place
from evercal.service.viewer.html import MAGENTA


def calibration_rows(calibration: Calibration) -> list[tuple[str, str]]:
    """Names and values for a panel."""
    x, y, z = 1000 * calibration.parent_from_child.translation_m
    principal = Ellipsoid.of(calibration.uncertain_pose).sigmas_mm
    return [
        ("mount", "on the gripper" if calibration.mount == "eye_in_hand" else "fixed"),
        (f"in {calibration.parent_frame}", f"{x:+.1f} {y:+.1f} {z:+.1f} mm"),
        ("1 sigma per axis", f"{calibration.sigma_mm:.2g} mm, {calibration.sigma_deg:.2g}°"),
        ("principal axes", f"{principal} mm"),
    ]


class DrawnCalibrations:
    """Cameras of calibrations, in place of those drawn before; one on the gripper moves with it."""

    def __init__(
        self,
        server: viser.ViserServer,
        calibrations: Mapping[str, Calibration],
        default: Camera,
        size_m: float,
    ):
        self._given = list(calibrations.values())
        ellipsoids = [Ellipsoid.of(found.uncertain_pose) for found in self._given]
        scale = readable_scale(ellipsoids)
        server.scene.remove_by_name("/calibrations")
        self._parents = []
        for i, (name, found) in enumerate(calibrations.items()):
            node, ellipsoid = f"/calibrations/{i}", ellipsoids[i]
            # Camera and ellipsoid are children of the gripper or of the base.
            self._parents.append(server.scene.add_frame(node, show_axes=False))
            frustum = Frustum.of(found.parent_from_child, found.camera or default)
            add_frustum(server, f"{node}/camera", frustum, size_m, MAGENTA)
            x, y, z = (max(float(scale * axis), 1e-6) for axis in ellipsoid.axes_m)
            server.scene.add_icosphere(
                f"{node}/ellipsoid",
                scale=(x, y, z),
                color=MAGENTA,
                opacity=0.35,
                wxyz=ellipsoid.rotation_wxyz,
                position=ellipsoid.centre_m,
                cast_shadow=False,
            )
            words = f"{name}: {found.sigma_mm:.2g} mm (1 sigma), ellipsoid x {scale:g}"
            server.scene.add_label(f"{node}/label", words, position=ellipsoid.centre_m)
        self.show(None, None)

    def show(self, scene: str | None, base_from_gripper: SE3 | None) -> None:
        """Show the calibrations of a scene, or of all for None.

        One on the gripper is shown where the gripper's pose is known, in every scene.
        """
        for parent, found in zip(self._parents, self._given, strict=True):
            if found.mount == "eye_in_hand":
                parent.visible = base_from_gripper is not None
                place(parent, base_from_gripper or SE3.identity())
            else:
                own = found.source.get("scene")
                parent.visible = scene is None or own in (None, scene)
