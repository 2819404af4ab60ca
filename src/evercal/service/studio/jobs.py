"""One task at a time in the background, and its outcome as one line."""

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from evercal.errors import InputError

Task = Callable[[], str]
"""Does something and returns what was done in one line."""


@dataclass(frozen=True)
class Message:
    """One line for the page."""

    kind: Literal["good", "working", "error"]
    text: str


class Jobs:
    """Runs tasks in a thread; a second one is refused while one runs.

    Args:
        changed: called whenever message or progress change.
    """

    def __init__(self, changed: Callable[[], Any] = lambda: None):
        self._changed = changed
        self._running, self._stop = threading.Lock(), threading.Event()
        self._thread: threading.Thread | None = None
        self.message = Message("good", "")
        self.progress = 0.0
        """How much of the present step is done, 0 to 1."""

    @property
    def busy(self) -> bool:
        """Whether a task runs."""
        return self._running.locked()

    @property
    def stopping(self) -> bool:
        """Whether the running task was asked to stop."""
        return self._stop.is_set()

    def start(self, what: str, task: Task) -> bool:
        """Run a task in the background; False if another one runs."""
        if not self._running.acquire(blocking=False):
            return False
        self._stop.clear()
        self.message, self.progress = Message("working", what), 0.0
        self._thread = threading.Thread(target=self._run, args=(task,), daemon=True)
        self._thread.start()
        return True

    def run(self, what: str, task: Task) -> bool:
        """Run a task and wait for it."""
        started = self.start(what, task)
        self.wait()
        return started

    def step(self, what: str, done: float, total: float) -> None:
        """Report progress from inside a task."""
        self.progress = min(done / total, 1.0) if total else 0.0
        self.message = Message("working", what)
        self._changed()

    def stop(self) -> None:
        """Ask the running task to stop after its present step."""
        self._stop.set()

    def wait(self, seconds: float | None = None) -> None:
        """Wait until no task runs."""
        if self._thread is not None:
            self._thread.join(seconds)

    def say(self, message: Message) -> None:
        """Show a line, unless a task runs."""
        if not self.busy:
            self.message = message

    def _run(self, task: Task) -> None:
        self._changed()
        try:
            message = Message("good", task())
        except InputError as error:
            message = Message("error", " ".join(str(error).split()))
        except OSError as error:
            where = f"{error.filename}: " if error.filename else ""
            message = Message("error", f"{where}{error.strerror or error}")
        except Exception as error:  # the page shows a line; the log has the rest
            logging.getLogger(__name__).exception("a task of the studio failed")
            text = " ".join(f"{type(error).__name__}: {error}".split())
            message = Message("error", f"internal error, {text}")
        self.message, self.progress = message, 0.0
        self._running.release()
        self._changed()
