"""The studio in 3D: arm, live camera, samples, the next view, map and calibrations."""

from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from evercal.calibration.next_views import NextViews
from evercal.geometry import SE3
from evercal.reports.scene.frusta import Frustum
from evercal.reports.scene.map_parts import THUMBNAIL_PX, resized
from evercal.service.studio.studio import Studio
from evercal.service.viewer.calibrations import DrawnCalibrations
from evercal.service.viewer.drawing import DrawnMap, add_base, add_frustum, place
from evercal.service.viewer.html import AMBER, BLUE, GREEN, RED

_SIZE_M = 0.045
"""Length of a drawn camera."""


class Drawing:
    """The scene of the page; `on_sample` is called with the name of a sample that is clicked."""

    def __init__(self, server: viser.ViserServer, studio: Studio, on_sample: Callable[[str], Any]):
        self._server, self._studio, self._on_sample = server, studio, on_sample
        self._samples: dict[str, viser.CameraFrustumHandle] = {}
        self._calibrations: DrawnCalibrations | None = None
        self._drawn: tuple[object, ...] = ()
        nowhere = Frustum.of(SE3.identity(), studio.connection.devices.intrinsics)
        self._live = add_frustum(server, "/live", nowhere, 1.3 * _SIZE_M, BLUE)
        self._next = add_frustum(server, "/next", nowhere, 1.3 * _SIZE_M, AMBER)
        server.scene.add_label("/next/label", "next view")
        self._live.visible = self._next.visible = False
        add_base(server, 3.0)
        camera = server.initial_camera
        camera.position, camera.look_at = (1.15, -0.8, 0.85), (0.35, 0.0, 0.3)

    def show_live(self) -> None:
        """Draw arm and camera where they are."""
        connection, arm = self._studio.connection, self._studio.connection.devices.arm
        gripper = connection.base_from_gripper
        if gripper is None:
            return
        place(self._live, gripper @ self._mount())
        self._live.visible = True
        if "wrist" in connection.images:
            self._live.image = resized(connection.images["wrist"], THUMBNAIL_PX)
        if self._calibrations is not None:
            self._calibrations.show(None, gripper)
        if arm is not None:
            joints = np.vstack([np.zeros(3), arm()])
            pairs = np.stack([joints[:-1], joints[1:]], axis=1).astype(np.float32)
            self._server.scene.add_line_segments(
                "/arm", pairs, (203, 213, 225), thickness=8.0, thickness_units="screen"
            )

    def show_samples(self, next_view: NextViews | None) -> None:
        """Draw the samples, the bad ones in red, and the next view."""
        bad = self._studio.samples.bad()
        for name in self._samples.keys() - set(self._studio.samples.names):
            self._samples.pop(name).remove()
        for frame in self._studio.samples.frames:
            name, gripper = frame.name, frame.base_from_gripper
            assert gripper is not None, "a wrist recording"
            if name not in self._samples:
                node, frustum = f"/samples/{name}", Frustum.of(gripper, frame.camera)
                image = frame.read_image()
                drawn = add_frustum(self._server, node, frustum, _SIZE_M, GREEN, image)
                drawn.on_click(lambda _, name=name: self._on_sample(name))
                self._samples[name] = drawn
            place(self._samples[name], gripper @ self._mount())
            self._samples[name].color = RED if name in bad else GREEN
        self._next.visible = next_view is not None
        if next_view is not None:
            place(self._next, next_view.poses[0] @ self._mount())

    def show_results(self) -> None:
        """Draw the map and the calibrations, if they have changed."""
        studio = self._studio
        drawn = (studio.cell.scenes, *studio.calibrations.values())
        if not studio.cell.scenes or drawn == self._drawn:
            return
        self._drawn, scenes = drawn, studio.cell.localizer.contents.scenes
        shown = DrawnMap(self._server, scenes)
        shown.show_keyframes(False)
        shown.show(studio.scene)
        camera = scenes[0].adjusted_camera
        found = {str(which): calibration for which, calibration in studio.calibrations.items()}
        self._calibrations = DrawnCalibrations(self._server, found, camera, 1.3 * _SIZE_M)

    def _mount(self) -> SE3:
        return self._studio.samples.mount or SE3.identity()
