"""`LiveMap`: a map that answers while other processes change it."""

import logging
import os
import threading
from pathlib import Path

from evercal.errors import InputError, printable
from evercal.map import Map
from evercal.storage.manifest import MANIFEST


class LiveMap:
    """The last complete state of a map on disk.

    A request takes `current` once and answers from it, so that no answer mixes two states. The
    folder may be missing until a first scene is learned.
    """

    def __init__(self, path: Path):
        self._path = path
        self._lock = threading.Lock()
        self.current = self._opened()

    def refresh(self) -> bool:
        """Open the map again if another process has changed it; True if it has.

        A map that cannot be read is logged, and the last state stays.
        """
        with self._lock:
            if _stamp(self._path) == self._stamp:
                return False
            try:
                self.current = self._opened()
            except Exception as error:
                # Perhaps for a moment only: try again.
                if not isinstance(error, InputError):
                    self._stamp = None
                logging.getLogger(__name__).warning(
                    "%s; the last state is served", printable(str(error))
                )
            return True

    def _opened(self) -> Map:
        # Read first: a change while the map is opened is then noticed the next time.
        self._stamp = _stamp(self._path)
        opened = Map.open(self._path)
        if opened.scenes:
            _ = opened.localizer  # loaded before requests wait for it
        return opened


def _stamp(path: Path) -> tuple[int, ...] | None:
    try:
        status = os.stat(path / MANIFEST)
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns, status.st_size
