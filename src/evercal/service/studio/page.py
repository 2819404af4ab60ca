"""The page of the studio: a server of viser with five panels and the scene."""

import contextlib
import io
import logging
import threading
import time
from collections.abc import Callable
from typing import Any, Literal

import viser

from evercal.service.studio.calibrate_panels import ExportPanel, FixedPanel, LearnPanel
from evercal.service.studio.devices import Seen
from evercal.service.studio.drawing import Drawing
from evercal.service.studio.html import live_html, message_html, way_html
from evercal.service.studio.jobs import Jobs
from evercal.service.studio.panels import ConnectPanel, Panel, RecordPanel, on_click
from evercal.service.studio.rest import RestTrigger
from evercal.service.studio.steps import STEPS, Step, StepState, current_step
from evercal.service.studio.studio import Studio
from evercal.service.viewer.page import address_of, start_server

_NUMBERS = [str(number + 1) for number in range(len(STEPS))]
_LIVE_S, _REFRESH_S = 0.25, 0.2
"""Intervals between live images, and between reports of progress."""


class StudioPage:
    """A page that is being served; `close` ends it.

    Args:
        studio: what is done.
        host: address to listen on.
        port: 0 for any free port.
        command: the command that started it, shown on the page.

    Raises:
        InputError: The port cannot be used.
    """

    def __init__(self, studio: Studio, host: str, port: int, command: str):
        self.studio, self.jobs = studio, Jobs(self._changed)
        self.server = start_server(host, port, "evercal studio")
        self.server.gui.main_panel.dock_right()
        self._closed = threading.Event()
        self.panels: dict[Step, Panel] = {}
        self._live: threading.Thread | None = None
        try:
            self._build(command)
        except BaseException:
            self.close()
            raise

    @property
    def url(self) -> str:
        """Address of the page."""
        return address_of(self.server)

    @property
    def step(self) -> Step:
        """The step that is shown."""
        return self._frame.step

    def go(self, step: Step) -> None:
        """Show a step."""
        self._frame.step = step
        for name, panel in self.panels.items():
            panel.folder.visible = name == step
        self._refresher.refresh()

    def close(self) -> None:
        """Stop threads and server."""
        self._closed.set()
        self.jobs.stop()
        if self._live is not None and self._live.is_alive():
            self._live.join(5)
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _build(self, command: str) -> None:
        gui, studio = self.server.gui, self.studio
        self._frame = _Frame(gui, self)
        connect = ConnectPanel(gui, studio, self.jobs, command)
        record = RecordPanel(gui, studio, self.jobs)
        self.panels |= {
            "connect": connect,
            "record": record,
            "learn": LearnPanel(gui, studio, self.jobs),
            "fixed": FixedPanel(gui, studio, self.jobs),
            "export": ExportPanel(gui, studio, self.jobs),
        }
        self._frame.add_keys()
        self._drawing = Drawing(self.server, studio, record.choose)
        self._refresher = _Refresher(self, self._drawing, record)
        self._live = threading.Thread(target=self._run, args=(connect, record), daemon=True)
        # A continued studio opens at the first step that is left to do.
        left = current_step(studio.steps()[1:])
        self.go(left if studio.book.frames else "connect")
        self._live.start()

    def show_frame(self, states: tuple[StepState, ...]) -> None:
        """Show the row of steps and the last message."""
        self._frame.show(states, self.jobs)

    def _changed(self) -> None:
        """A task began, went on or ended."""
        if not self._closed.is_set():
            self._refresher.soon(not self.jobs.busy)

    def _run(self, connect: ConnectPanel, record: RecordPanel) -> None:
        """Show live images while the page is open somewhere; take samples at rest if wanted."""
        rest, was = RestTrigger(), False
        while not self._closed.wait(_LIVE_S):
            # Learning needs the processor more than the picture does.
            if not self.server.get_clients() or (self.jobs.busy and self.step == "learn"):
                continue
            try:
                seen = self._look()
                connect.show_seen(seen)
                if seen.complete != was:
                    was = seen.complete
                    self._refresher.refresh()
                if record.auto.value and not self.jobs.busy and rest.fires(seen, self.studio.book):
                    record.take()
            except Exception:  # the next image may be better
                logging.getLogger(__name__).exception("a live image was not shown")

    def _look(self) -> Seen:
        """Read an image where one is shown, and show it."""
        connection, devices = self.studio.connection, self.studio.devices
        which = "wrist"
        if self.step == "fixed" and devices.fixed_camera is not None:
            which = "fixed"
        reads = devices.live or connection.seen.image is None
        seen = connection.look(which if reads and self.step in _PICTURED else None)
        self._frame.show_picture(seen, self.step)
        self._drawing.show_live(seen, seen.image)
        return seen


_PICTURED: tuple[Step, ...] = ("connect", "record", "fixed")
"""Steps with a live picture."""


class _Frame:
    """What all steps share: the row of steps, the message, the picture, the way to the next one."""

    def __init__(self, gui: viser.GuiApi, page: StudioPage):
        self.step: Step = "connect"
        self._gui, self._page = gui, page
        self._way = gui.add_html("")
        self._steps = gui.add_button_group("Step", _NUMBERS)
        self._message = gui.add_html("")
        self._progress = gui.add_progress_bar(0.0, visible=False, animated=True)
        self._stop = gui.add_button("Stop", visible=False, color="red")
        # Above the controls of a step, so that it is seen without scrolling.
        self._next = gui.add_button("Next", color="teal", icon=viser.Icon.ARROW_RIGHT)
        # An image of viser that changes often asks the browser for addresses that are gone.
        self._picture = gui.add_html("")
        self._steps.on_click(lambda _: self._chosen())
        on_click(self._stop, page.jobs.stop)
        on_click(self._next, lambda: self._by(1))

    def add_keys(self) -> None:
        """Add the keys, once the panels are there."""
        gui = self._gui
        record: Any = self._page.panels["record"]
        keys: tuple[tuple[str, Literal["N", "B", "T"], Callable[[], None]], ...] = (
            ("Next step", "N", lambda: self._by(1)),
            ("Previous step", "B", lambda: self._by(-1)),
            ("Take sample", "T", record.take),
        )
        for label, key, action in keys:
            gui.add_command(label, hotkey=key).on_trigger(lambda _, action=action: action())
        if self._page.studio.devices.can_move:
            gui.add_command("Move there", hotkey="M").on_trigger(lambda _: record.move())

    def show(self, states: tuple[StepState, ...], jobs: Jobs) -> None:
        """Show statuses, message and progress."""
        by_step = {state.step: state for state in states}
        busy = jobs.busy
        self._message.content = message_html(jobs.message)
        self._progress.visible, self._progress.value = busy, 100 * jobs.progress
        self._stop.visible = busy and self.step == "record"
        self._picture.visible = self.step in _PICTURED
        self._way.content = way_html(states, self.step)
        following = STEPS[STEPS.index(self.step) + 1 :]
        open_ones = [step for step in following if by_step[step].status != "locked"]
        self._next.visible = bool(following)
        if following:
            self._next.label = f"Next: {by_step[following[0]].title[2:]}"
            self._next.disabled = not open_ones

    def show_picture(self, seen: Seen, step: Step) -> None:
        """Show the newest image of the camera of a step."""
        image = seen.fixed if step == "fixed" else seen.image
        if image is not None and step in _PICTURED:
            self._picture.content = live_html(image)

    def _chosen(self) -> None:
        self._page.go(STEPS[_NUMBERS.index(self._steps.value)])

    def _by(self, steps: int) -> None:
        number = STEPS.index(self.step) + steps
        if 0 <= number < len(STEPS):
            self._page.go(STEPS[number])


class _Refresher:
    """Updates everything that is shown, at most every `_REFRESH_S` while a task runs."""

    def __init__(self, page: StudioPage, drawing: Drawing, record: RecordPanel):
        self._page, self._drawing, self._record = page, drawing, record
        self._lock, self._last = threading.RLock(), 0.0
        self._samples: tuple[object, ...] | None = None

    def soon(self, now: bool) -> None:
        """Refresh, unless that was done a moment ago and need not be done now."""
        if now or time.monotonic() - self._last > _REFRESH_S:
            self.refresh()

    def refresh(self) -> None:
        """Update the page."""
        page, studio = self._page, self._page.studio
        with self._lock, page.server.atomic():
            self._last = time.monotonic()
            states, busy = studio.steps(), page.jobs.busy
            key = (studio.book.names, studio.calibrations.get("wrist"))
            if key != self._samples:
                self._samples = key
                covered, proposal = studio.book.coverage(), studio.proposal()
                self._record.show_samples(covered, proposal)
                self._drawing.show_samples({r.name for r in covered.samples if r.problems})
                self._drawing.show_proposal(proposal)
            if not busy:
                self._drawing.show_results()
            for state in states:
                page.panels[state.step].show(state, busy)
            page.show_frame(states)
