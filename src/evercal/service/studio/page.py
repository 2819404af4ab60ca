"""The page of the studio: a server of viser with the controls of five steps and the scene."""

import logging
import threading
import time

from evercal.service.studio.controls import Controls
from evercal.service.studio.devices import Which
from evercal.service.studio.drawing import Drawing
from evercal.service.studio.steps import Step, step_states
from evercal.service.studio.studio import Studio
from evercal.service.studio.tasks import Tasks
from evercal.service.viewer.server import address_of, start_server

_LIVE_S, _REFRESH_S, _REST_S = 0.25, 0.5, 0.8
"""Between live images, between reports of progress, and until an arm that stands is at rest."""


class StudioPage:
    """A page that is being served; `close` ends it.

    Raises:
        InputError: The port cannot be used.
    """

    def __init__(self, studio: Studio, host: str, port: int):
        self.studio, self.tasks = studio, Tasks(self._progressed)
        self.server = start_server(host, port, "evercal studio")
        self._closed, self._lock, self._refreshed = threading.Event(), threading.RLock(), 0.0
        self.controls = Controls(self.server, studio, self.tasks, self.refresh)
        self._drawing = Drawing(self.server, studio, self.controls.choose)
        states = step_states(studio)
        left: list[Step] = [step for step, (status, _) in states.items() if status == "open"]
        first = next((step for step in left if step != "connect"), "export")
        self.controls.go(first if studio.samples.names else "connect")
        self._live = threading.Thread(target=self._run, daemon=True)
        self._live.start()

    @property
    def url(self) -> str:
        """Address of the page."""
        return address_of(self.server)

    def close(self) -> None:
        """Stop threads and server."""
        self._closed.set()
        self.tasks.stop.set()
        self._live.join(5)
        self.server.stop()

    def refresh(self) -> None:
        """Show what has changed."""
        with self._lock, self.server.atomic():
            self._refreshed = time.monotonic()
            view = self.studio.samples.next_view()
            self.controls.show(view)
            self._drawing.show_samples(view)
            if not self.tasks.busy:
                self._drawing.show_results()

    def _progressed(self) -> None:
        due = not self.tasks.busy or time.monotonic() - self._refreshed > _REFRESH_S
        if due and not self._closed.is_set():
            self.refresh()

    def _run(self) -> None:
        """Show live images while the page is open somewhere; take samples at rest if wanted."""
        connection, complete, sampled = self.studio.connection, False, 0.0
        while not self._closed.wait(_LIVE_S):
            # Learning needs the processor more than the picture does.
            if not self.server.get_clients() or (self.tasks.busy and self.controls.step == "learn"):
                continue
            try:
                self._look()
                if connection.complete != complete:
                    complete = connection.complete
                    self.refresh()
                since = connection.still_since
                if self.controls.auto.value and since != sampled and connection.rests(_REST_S):
                    sampled = since
                    gripper = connection.base_from_gripper
                    if gripper is not None and not self.studio.samples.taken_at(gripper):
                        self.tasks.start("taking a sample", self.studio.take_sample)
            except Exception:  # the next image may be better
                logging.getLogger(__name__).exception("a live image was not shown")

    def _look(self) -> None:
        """Read pose and image, and show them."""
        connection, devices = self.studio.connection, self.studio.connection.devices
        fixed = self.controls.step == "fixed" and devices.fixed_camera is not None
        which: Which = "fixed" if fixed else "wrist"
        connection.look(which if devices.live or which not in connection.images else None)
        with self._lock, self.server.atomic():
            self.controls.show_live(which)
            self._drawing.show_live()
