"""A camera that is tracked in the map while the page is open somewhere."""

import threading
from collections.abc import Callable
from typing import Any

import viser

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.live.camera import StreamCamera
from evercal.localization.tracking import Tracker
from evercal.reports.answers import unit_known
from evercal.reports.scene.frusta import Frustum
from evercal.reports.scene.map_parts import THUMBNAIL_PX, resized
from evercal.service.viewer.drawing import add_frustum, place
from evercal.service.viewer.html import GREEN, RED, chip_html, rows_html

_IDLE_S = 0.1


class Live:
    """The tracked camera in the scene, and the folder "Live" with its state."""

    def __init__(
        self,
        server: viser.ViserServer,
        camera: StreamCamera,
        tracker: Tracker,
        size_m: float,
        on_scene: Callable[[str], Any],
    ):
        self._server, self._camera, self._tracker = server, camera, tracker
        self._on_scene, self._closed = on_scene, threading.Event()
        intrinsics = tracker.camera or tracker.localizer.contents.scenes[0].adjusted_camera
        nowhere = Frustum.of(SE3.identity(), intrinsics)
        self._node = add_frustum(server, "/live", nowhere, size_m, GREEN)
        self._node.visible = False
        with server.gui.add_folder("Live"):
            self._text = server.gui.add_html("")
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop after the frame under way."""
        self._closed.set()
        self._thread.join(5)
        self._camera.close()

    def _run(self) -> None:
        while not self._closed.is_set():
            if not self._server.get_clients():
                self._closed.wait(_IDLE_S)
                continue
            try:
                self._show(*self._camera.read())
            except InputError as error:  # the source has ended
                self._text.content += chip_html("ended", RED, str(error))
                return

    def _show(self, stamp_s: float, image: Any) -> None:
        tracked = self._tracker.track(image, stamp_s)
        estimate, rows = tracked.estimate, [("time", f"{tracked.estimate.milliseconds:.0f} ms")]
        pose = estimate.uncertain_pose if estimate.status == "ok" else None
        self._node.visible = pose is not None
        if pose is not None and estimate.scene is not None:
            self._on_scene(estimate.scene)
            place(self._node, pose.pose)
            self._node.image = resized(image, THUMBNAIL_PX)
            rows.append(("scene", estimate.scene))
            if unit_known(self._tracker.localizer, estimate.scene):
                x, y, z = 1000 * pose.pose.translation_m
                rows.append(("position", f"{x:+.1f} {y:+.1f} {z:+.1f} mm"))
                rows.append(("1 sigma per axis", f"{pose.sigma_mm:.2g} mm"))
        chip = chip_html(tracked.state, RED if pose is None else GREEN, estimate.reason)
        self._text.content = chip + rows_html(rows)
