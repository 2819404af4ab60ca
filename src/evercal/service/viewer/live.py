"""A camera that is tracked in the map while the page is open."""

import threading
import time
from collections.abc import Callable, Iterator
from itertools import chain
from queue import Empty, Queue
from typing import Any

from evercal.errors import InputError
from evercal.localization.localizer import Localizer
from evercal.localization.tracking import Tracker
from evercal.recordings.streams import StreamFrame, is_live, stream
from evercal.service.viewer.answer_panel import AnswerPanel
from evercal.service.viewer.answers import LocatedImage
from evercal.service.viewer.stage import Stage

_IDLE_S = 0.1
_SMOOTH = 0.9
"""Weight of the past in the frame rate."""


def open_source(source: str) -> tuple[Iterator[StreamFrame], tuple[int, int]]:
    """Frames at the pace of their times, of a camera always the newest; and their size, pixels.

    Raises:
        InputError: As `recordings.streams.stream`, or there is no frame.
    """
    frames = stream(source)
    first = next(frames, None)
    if first is None:
        raise InputError(f"{source}: no frame could be read")
    whole = chain([first], frames)
    size = first.image.shape[1], first.image.shape[0]
    return newest(whole) if is_live(source) else paced(whole), size


def paced(
    frames: Iterator[StreamFrame],
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], Any] = time.sleep,
) -> Iterator[StreamFrame]:
    """Frames of a file, none before its time; after a delay the pace begins anew."""
    offset: float | None = None
    for frame in frames:
        if offset is not None:
            ahead = frame.stamp_s + offset - clock()
            if 0 < ahead < 1:
                sleep(ahead)
        offset = clock() - frame.stamp_s
        yield frame


def newest(frames: Iterator[StreamFrame]) -> Iterator[StreamFrame]:
    """Frames of a camera without the ones that arrived while another was located.

    A thread empties the camera's buffer, which would let answers fall behind.
    """
    slot: Queue[StreamFrame | Exception | None] = Queue(maxsize=1)
    stopped = threading.Event()

    def put(item: StreamFrame | Exception | None) -> None:
        while True:
            try:
                slot.get_nowait()
            except Empty:
                break
        slot.put(item)

    def read() -> None:
        try:
            for frame in frames:
                if stopped.is_set():
                    return
                put(frame)
            put(None)
        except Exception as error:  # shown where the frames are used
            put(error)

    threading.Thread(target=read, daemon=True).start()
    try:
        while (item := slot.get()) is not None:
            if isinstance(item, Exception):
                raise item
            yield item
    finally:
        stopped.set()


class Live:
    """The folder "Live".

    Args:
        stage: The scene.
        source: What is tracked, for the page.
        frames: Its frames.
        tracker: Tracks them.
        follow: Called with the scene of an answer.
    """

    def __init__(
        self,
        stage: Stage,
        source: str,
        frames: Iterator[StreamFrame],
        tracker: Tracker,
        follow: Callable[[str | None], Any],
    ):
        self._server, self._source, self._frames = stage.server, source, frames
        self._tracker, self._closed = tracker, threading.Event()
        gui = stage.server.gui
        with gui.add_folder("Live"):
            self._pause = gui.add_checkbox("Pause", False)
            localizer: Localizer = tracker.localizer
            self.panel = AnswerPanel(stage, "/live", localizer, True, follow)
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        """Track from now on, while the page is open somewhere."""
        self._thread.start()

    def close(self) -> None:
        """Stop after the frame under way."""
        self._closed.set()
        if self._thread.is_alive():
            self._thread.join(5)

    def _run(self) -> None:
        last, interval = None, None
        try:
            for frame in self._frames:
                while self._idle() and not self._closed.is_set():
                    time.sleep(_IDLE_S)
                    last = None
                if self._closed.is_set():
                    return
                tracked = self._tracker.track(frame.image, frame.stamp_s)
                now = time.monotonic()
                if last is not None:
                    passed = now - last
                    weight = _SMOOTH if interval is not None else 0.0
                    interval = weight * (interval or 0.0) + (1 - weight) * passed
                last = now
                rate = "" if interval is None else f"{1 / max(interval, 1e-3):.1f} Hz"
                located = LocatedImage(frame.name, frame.image, tracked.estimate, tracked.state)
                self.panel.show(located, [("frame rate", rate)])
            self.panel.say(f"{self._source}: the stream has ended.")
        except InputError as error:
            self.panel.say(str(error))

    def _idle(self) -> bool:
        return self._pause.value or not self._server.get_clients()
