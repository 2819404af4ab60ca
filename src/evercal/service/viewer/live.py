"""A camera that is tracked in the map while the page is open."""

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from evercal.errors import InputError
from evercal.live.camera import NewestFrame
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
    size = first.image.shape[1], first.image.shape[0]

    def begun() -> Iterator[StreamFrame]:
        yield first
        yield from frames

    whole = begun()  # closing it closes the source, which `itertools.chain` would not
    return iter(NewestFrame(whole)) if is_live(source) else paced(whole), size


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
        rate = _Rate()
        try:
            while self._wait_until_wanted(rate):
                # Taken after the wait, so that a camera that rested goes on with what it sees now.
                frame = next(self._frames, None)
                if frame is None:
                    self.panel.say(f"{self._source}: the stream has ended.")
                    self._pause.disabled = True
                    return
                tracked = self._tracker.track(frame.image, frame.stamp_s)
                located = LocatedImage(frame.name, frame.image, tracked.estimate, tracked.state)
                self.panel.show(located, [("frame rate", rate.text(time.monotonic()))])
        except InputError as error:
            self.panel.say(str(error))
        finally:
            if (close := getattr(self._frames, "close", None)) is not None:
                close()

    def _wait_until_wanted(self, rate: "_Rate") -> bool:
        """Wait while nobody looks, or on request; False once the page is closed."""
        while self._pause.value or not self._server.get_clients():
            rate.rest()
            if self._closed.wait(_IDLE_S):
                break
        return not self._closed.is_set()


class _Rate:
    """Frames per second, smoothed."""

    def __init__(self) -> None:
        self._last: float | None = None
        self._interval: float | None = None

    def rest(self) -> None:
        """Leave out the time until the next frame."""
        self._last = None

    def text(self, now_s: float) -> str:
        """Count a frame and return the rate; empty after the first one."""
        if self._last is not None:
            weight = _SMOOTH if self._interval is not None else 0.0
            passed = now_s - self._last
            self._interval = weight * (self._interval or 0.0) + (1 - weight) * passed
        self._last = now_s
        return "" if self._interval is None else f"{1 / max(self._interval, 1e-3):.1f} Hz"
