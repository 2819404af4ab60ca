"""The page of the studio: a server of viser with the controls of the steps and the scene."""

import logging
import threading
import time
from contextlib import suppress
from itertools import cycle

import numpy as np
import viser

from evercal.calibration.calibration import Calibration
from evercal.calibration.from_map.next_views import NextViews
from evercal.geometry import SE3
from evercal.reports.overlay import resized
from evercal.reports.scene import THUMBNAIL_PX, Frustum
from evercal.service.studio.controls import Controls, Tasks
from evercal.service.studio.studio import Studio
from evercal.service.viewer.drawing import (
    DrawnMap,
    add_base,
    add_calibrations,
    add_frustum,
    place,
)
from evercal.service.viewer.html import AMBER, BLUE, GREEN, PALE, RED
from evercal.service.viewer.page import start_server

_LIVE_S = 0.25
"""Interval of live images, seconds."""
_REFRESH_S = 0.5
"""Interval of reports of progress, seconds."""
_DRAWN_S = 10.0
"""Time in which a browser that shows the page draws it."""
_SIZE_M = 0.045
"""Length of a drawn camera."""


class StudioPage:
    """A page that is being served; `close` ends it."""

    def __init__(self, studio: Studio, host: str, port: int):
        self.studio = studio
        self.tasks = Tasks(self._progressed)
        self.server = start_server(host, port, "evercal studio")
        self._closed = threading.Event()
        self._lock = threading.RLock()
        self._refreshed = 0.0
        studio.watched = self.watched
        self.controls = Controls(self.server, studio, self.tasks)
        self._drawing = _Drawing(self.server, studio)
        self.refresh()
        self._live = threading.Thread(target=self._run, daemon=True)
        self._live.start()

    def close(self) -> None:
        """Stop threads and server."""
        self._closed.set()
        self.tasks.stop.set()
        self._live.join(5)
        self.server.stop()

    def watched(self) -> bool:
        """Whether a browser shows the page; one in the background draws nothing."""
        for client in self.server.get_clients().values():
            with suppress(RuntimeError, TimeoutError):
                client.get_render(8, 8, timeout=_DRAWN_S)
                return True
        return False

    def refresh(self) -> None:
        """Show what has changed."""
        with self._lock, self.server.atomic():
            self._refreshed = time.monotonic()
            view = self.studio.next_view()
            self.controls.show(view)
            self._drawing.show_samples(view)
            if not self.tasks.busy:
                self._drawing.show_results()

    def _progressed(self) -> None:
        due = not self.tasks.busy or time.monotonic() - self._refreshed > _REFRESH_S
        if due and not self._closed.is_set():
            self.refresh()

    def _run(self) -> None:
        """Show live images while the page is open somewhere; a task takes its own images."""
        connection = self.studio.connection
        complete = False
        turns = cycle(connection.devices.cameras)
        while not self._closed.wait(_LIVE_S):
            if not self.server.get_clients():
                continue
            try:
                which = next(turns)
                wanted = connection.devices.live and not self.tasks.busy
                if wanted or which not in connection.images:
                    connection.look(which)
                else:
                    connection.look(None)
                with self._lock, self.server.atomic():
                    self.controls.show_live()
                    self._drawing.show_live()
                if connection.complete != complete:
                    complete = connection.complete
                    self.refresh()
            except Exception:  # the next image may be better
                logging.getLogger(__name__).exception("a live image was not shown")


class _Drawing:
    """The scene of the page."""

    def __init__(self, server: viser.ViserServer, studio: Studio):
        self._server = server
        self._studio = studio
        self._samples: dict[str, viser.CameraFrustumHandle] = {}
        self._drawn: tuple[object, ...] = ()
        self._gripper = add_base(server, 3.0)
        nowhere = Frustum.of(SE3.identity(), studio.connection.devices.intrinsics)
        self._live = add_frustum(server, "/live", nowhere, 1.3 * _SIZE_M, BLUE)
        self._next = add_frustum(server, "/next", nowhere, 1.3 * _SIZE_M, AMBER)
        server.scene.add_label("/next/label", "next view")
        self._live.visible = False
        camera = server.initial_camera
        camera.position = (1.15, -0.8, 0.85)
        camera.look_at = (0.35, 0.0, 0.3)

    def show_live(self) -> None:
        """Draw arm and camera where they are."""
        connection = self._studio.connection
        gripper = connection.base_from_gripper
        arm = connection.devices.arm
        if gripper is None:
            return
        place(self._gripper, gripper)
        if "wrist" in connection.images:
            place(self._live, gripper @ self._mount())
            self._live.image = resized(connection.images["wrist"], THUMBNAIL_PX)
        if arm is not None:
            joints = np.vstack([np.zeros(3), arm()])
            pairs = np.stack([joints[:-1], joints[1:]], axis=1).astype(np.float32)
            self._server.scene.add_line_segments(
                "/arm", pairs, PALE, thickness=8.0, thickness_units="screen"
            )

    def show_samples(self, next_view: NextViews | None) -> None:
        """Draw the samples, the bad ones in red, and the next view."""
        frames = self._studio.recorders["wrist"].frames
        bad = self._studio.bad_samples()
        for name in self._samples.keys() - {frame.name for frame in frames}:
            self._samples.pop(name).remove()
        for frame in frames:
            name = frame.name
            gripper = frame.base_from_gripper
            assert gripper is not None, "a wrist recording"
            if name not in self._samples:
                self._samples[name] = add_frustum(
                    self._server,
                    f"/samples/{name}",
                    Frustum.of(gripper, frame.camera),
                    _SIZE_M,
                    GREEN,
                    frame.read_image(),
                )
            drawn = self._samples[name]
            drawn.color = RED if name in bad else GREEN
            place(drawn, gripper @ self._mount())
        place(self._next, next_view and next_view.poses[0] @ self._mount())

    def show_results(self) -> None:
        """Draw the map and the calibrations, if they have changed."""
        studio = self._studio
        calibrations: dict[str, Calibration] = {**studio.calibrations}
        drawn = (studio.cell.scenes, *calibrations.values())
        if drawn == self._drawn:
            return
        shown = None
        self._drawn = drawn
        if studio.cell.scenes:
            scenes = studio.cell.localizer.contents.scenes
            shown = DrawnMap(self._server, scenes)
            shown.show(studio.scene or scenes[0].name)
        for name in calibrations:  # by a held thing it has no scene, by the map it has
            self._server.scene.remove_by_name(f"/base/{name}")
        camera = studio.connection.devices.intrinsics
        add_calibrations(self._server, calibrations, shown, camera, 1.3 * _SIZE_M)

    def _mount(self) -> SE3:
        return self._studio.mount or SE3.identity()
