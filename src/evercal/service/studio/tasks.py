"""One task at a time in the background, and its outcome as one line."""

import logging
import threading
from collections.abc import Callable
from typing import Any

from evercal.errors import InputError


class Tasks:
    """Runs tasks in a thread, and calls `changed` when message or progress change."""

    def __init__(self, changed: Callable[[], Any]):
        self._changed, self._running = changed, threading.Lock()
        self.stop = threading.Event()
        """Asks the running task to stop after its present step."""
        self.message, self.failed, self.progress = "", False, 0.0

    @property
    def busy(self) -> bool:
        """Whether a task runs."""
        return self._running.locked()

    def start(self, what: str, task: Callable[[], str]) -> bool:
        """Run a task, which returns what it did in one line; False if another one runs."""
        if not self._running.acquire(blocking=False):
            return False
        self.stop.clear()
        self.message, self.failed, self.progress = what, False, 0.0
        threading.Thread(target=self._run, args=(task,), daemon=True).start()
        return True

    def step(self, what: str, done: float, total: float) -> None:
        """Report progress from inside a task."""
        self.message, self.progress = what, min(done / total, 1.0) if total else 0.0
        self._changed()

    def _run(self, task: Callable[[], str]) -> None:
        self._changed()
        try:
            self.message = task()
        except (InputError, OSError) as error:
            self.message, self.failed = " ".join(str(error).split()), True
        except Exception as error:
            logging.getLogger(__name__).exception("a task of the studio failed")
            self.message, self.failed = f"internal error, {type(error).__name__}: {error}", True
        self._running.release()
        self._changed()
