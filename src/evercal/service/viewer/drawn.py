"""Calibrations and answers in the scene of the page."""

from collections.abc import Sequence

import numpy as np
import viser

from evercal.geometry import SE3
from evercal.reports.scene.frusta import Ellipsoid, Frustum
from evercal.reports.scene.map_parts import THUMBNAIL_PX, resized
from evercal.service.viewer.answers import BLUE, GREEN, GREY, AnswerView
from evercal.service.viewer.calibrations import CalibrationView
from evercal.service.viewer.camera_set import linear
from evercal.service.viewer.stage import Stage, add_frustum

CALIBRATION_COLOUR = (192, 38, 211)
_TRAIL = 500
"""Positions of a stream that stay drawn."""
_NOWHERE = Frustum(SE3.identity(), 1.0, 1.0)


class DrawnCalibrations:
    """Cameras of calibrations with ellipsoids and labels.

    Args:
        stage: The scene.
        views: Calibrations.
        scale: Factor that the ellipsoids are drawn with.
    """

    def __init__(self, stage: Stage, views: Sequence[CalibrationView], scale: float):
        self._stage, self.views = stage, views
        self._scale, self._gripper = scale, SE3.identity()
        self._known = False
        server, self._nodes = stage.server, []
        for i, view in enumerate(views):
            name = f"/calibrations/{i}"
            frustum = add_frustum(
                server, f"{name}/camera", _NOWHERE, stage.frustum_m, CALIBRATION_COLOUR
            )
            self._nodes.append(
                (
                    frustum,
                    _add_ellipsoid(server, f"{name}/sigma", CALIBRATION_COLOUR),
                    server.scene.add_label(f"{name}/label", view.name, anchor="bottom-center"),
                )
            )
        self.show()

    def move(self, base_from_gripper: SE3 | None) -> None:
        """Put the gripper at a pose; None where it is not known."""
        self._known = base_from_gripper is not None
        self._gripper = base_from_gripper or self._gripper
        self.show()

    def resize(self, scale: float) -> None:
        """Draw the ellipsoids with another factor."""
        self._scale = scale
        self.show()

    def show(self) -> None:
        """Draw all calibrations of the scenes that are shown."""
        with self._stage.server.atomic():
            for view, nodes in zip(self.views, self._nodes, strict=True):
                self._show(view, *nodes)

    def _show(
        self,
        view: CalibrationView,
        frustum: viser.CameraFrustumHandle,
        sphere: viser.IcosphereHandle,
        label: viser.LabelHandle,
    ) -> None:
        shapes = view.shapes(self._gripper if self._known else None)
        # A camera on the gripper belongs to the robot, and so to every scene.
        own = view.on_gripper or self._stage.shows(view.scene)
        for node in (frustum, sphere, label):
            node.visible = shapes is not None and own
        if shapes is None:
            return
        place_frustum(frustum, shapes[0])
        place_ellipsoid(sphere, shapes[1], self._scale)
        above = shapes[0].corners(self._stage.frustum_m)[:, 2].max()
        label.position = (*shapes[1].centre_m[:2], max(above, shapes[1].centre_m[2]))
        label.text = view.label(self._scale)


class DrawnAnswer:
    """The camera of the image that was located last.

    Args:
        stage: The scene.
        name: Name of its nodes.
    """

    def __init__(self, stage: Stage, name: str):
        self._stage, server = stage, stage.server
        size = 1.3 * stage.frustum_m
        self._cameras = [
            add_frustum(server, f"{name}/{i}", _NOWHERE, size, GREEN) for i in range(2)
        ]
        # Smaller, so that both are seen where they coincide.
        self._stated = add_frustum(server, f"{name}/stated", _NOWHERE, 0.6 * size, BLUE)
        self._last = add_frustum(server, f"{name}/last", _NOWHERE, size, GREY)
        self._sphere = _add_ellipsoid(server, f"{name}/sigma", GREEN)
        self._trail = server.scene.add_line_segments(
            f"{name}/trail",
            np.zeros((0, 2, 3), np.float32),
            np.zeros((0, 2, 3), np.uint8),
            thickness=2.0,
            thickness_units="screen",
        )
        self._way: list[tuple[np.ndarray, tuple[int, int, int]]] = []
        self._before: tuple[str | None, Frustum] | None = None
        for node in (*self._cameras, self._stated, self._last, self._sphere):
            node.visible = False

    def show(self, view: AnswerView, scale: float) -> None:
        """Draw an answer; without a pose, the last one stays in grey."""
        with self._stage.server.atomic():
            visible = self._stage.shows(view.scene)
            thumbnail = resized(view.picture, THUMBNAIL_PX)
            for i, camera in enumerate(self._cameras):
                camera.visible = visible and i < len(view.frusta)
                if camera.visible:
                    place_frustum(camera, view.frusta[i])
                    camera.color, camera.image = view.colour, thumbnail
            self._show_last(view)
            self._stated.visible = view.stated is not None and visible
            if view.stated is not None:
                place_frustum(self._stated, view.stated)
            self._sphere.visible = view.ellipsoid is not None and visible
            if view.ellipsoid is not None:
                place_ellipsoid(self._sphere, view.ellipsoid, scale)
            self._trail.visible = visible

    def _show_last(self, view: AnswerView) -> None:
        if view.frusta:
            self._before = (view.scene, view.frusta[0])
            self._last.visible = False
        elif self._before is not None:
            scene, frustum = self._before
            self._last.visible = self._stage.shows(scene)
            place_frustum(self._last, frustum)

    def extend(self, view: AnswerView) -> None:
        """Lengthen the way of the camera; a lost frame interrupts it."""
        if len(view.frusta) != 1:
            self._way.append((np.full(3, np.nan), view.colour))
        else:
            self._way.append((view.frusta[0].base_from_camera.translation_m, view.colour))
        self._way = self._way[-_TRAIL:]
        points = np.array([place for place, _ in self._way])
        pairs = np.stack([points[:-1], points[1:]], axis=1)
        colours = linear(np.array([colour for _, colour in self._way[1:]])).reshape(-1, 1, 3)
        whole = np.isfinite(pairs).all((1, 2))
        self._trail.points = pairs[whole].astype(np.float32)
        self._trail.colors = np.repeat(colours, 2, axis=1)[whole]


def place_frustum(handle: viser.CameraFrustumHandle, frustum: Frustum) -> None:
    """Move a camera and change its angle of view."""
    handle.fov, handle.aspect = frustum.fov_rad, frustum.aspect
    handle.wxyz = frustum.base_from_camera.rotation_wxyz
    handle.position = frustum.base_from_camera.translation_m


def place_ellipsoid(handle: viser.IcosphereHandle, ellipsoid: Ellipsoid, scale: float) -> None:
    """Move an ellipsoid and change its axes."""
    x, y, z = (max(float(scale * axis), 1e-6) for axis in ellipsoid.axes_m)
    handle.scale = (x, y, z)
    handle.wxyz, handle.position = ellipsoid.rotation_wxyz, ellipsoid.centre_m


def _add_ellipsoid(
    server: viser.ViserServer, name: str, colour: tuple[int, int, int]
) -> viser.IcosphereHandle:
    return server.scene.add_icosphere(
        name, color=colour, opacity=0.35, cast_shadow=False, receive_shadow=False
    )
