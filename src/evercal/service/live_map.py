"""`LiveMap`: a map that answers while other processes change it."""

import logging
import math
import os
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from evercal.errors import InputError, UnavailableError
from evercal.localization.localizer import Localizer
from evercal.map import Map
from evercal.mapping.store import MapStore
from evercal.storage.manifest import MANIFEST

_PAUSE_S = 5.0
"""Time until a state that could not be served is tried again, seconds."""


class LiveMap:
    """The last good state of a map on disk.

    A request takes `localizer` once and answers from it, so that no answer mixes two states. The
    folder may be missing until a first scene is learned. What was there once and is gone is a
    fault, and so is a map whose contents contradict each other.

    Args:
        path: Folder of the map.
        known: Whether a map was there already.
    """

    def __init__(self, path: Path, known: bool = False):
        self.fault: str | None = None
        """Why the state on disk is not served."""
        self._path = path
        self._lock = threading.Lock()
        self._most_found = int(known)
        self._again_s = math.inf
        self.current = self._opened()

    @property
    def localizer(self) -> Localizer:
        """The localizer of the last good state, or UnavailableError."""
        try:
            return self.current.localizer
        except InputError as error:
            raise UnavailableError(self.fault or str(error)) from None

    def within(self, scenes: Sequence[str]) -> Localizer:
        """The localizer of some scenes, or of all where none is named; pages send empty names."""
        localizer = self.localizer
        named = [*filter(None, scenes)]
        return localizer.within(named) if named else localizer

    def refresh(self) -> bool:
        """Open the map again if another process has changed it; True if that was tried.

        A state that cannot be served is logged once, and the last good state stays. It is tried
        again when the manifest changes, and after a while: files may arrive one by one.
        """
        with self._lock:
            if _found(self._path) == self._stamp and time.monotonic() < self._again_s:
                return False
            try:
                self.current = self._opened()
                self.fault = None
                self._again_s = math.inf
            except InputError as error:
                self._again_s = time.monotonic() + _PAUSE_S
                if self.fault != str(error):
                    self.fault = str(error)
                    log = logging.getLogger(__name__)
                    log.warning("%s; the last state is served", error)
            return True

    def failed(self, error: Exception) -> None:
        """Open the map again soon, if a request failed because a file of it was changed."""
        if isinstance(error, UnavailableError) and self.fault is None:
            self._again_s = 0.0

    def _opened(self) -> Map:
        # Read first: a change while the map is opened is then noticed the next time.
        self._stamp = _found(self._path)
        if len(self._stamp) < self._most_found:
            raise InputError(f"{self._path}: the map is gone; mount or restore it")
        self._most_found = len(self._stamp)
        try:
            opened = Map.open(self._path)
            if not opened.scenes and len(self._stamp) > 1:
                opened = Map(MapStore.open(self._path))  # or it is away by now
            if opened.scenes:
                _ = opened.localizer  # loaded before requests wait for it
        except InputError:
            raise
        except Exception as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise InputError(f"{self._path}: cannot be used ({reason})") from error
        return opened


def _found(path: Path) -> tuple[int, ...]:
    """Changes with the manifest; shorter without one, and empty without a folder."""
    try:
        status = os.stat(path / MANIFEST)
    except OSError:
        return (0,) * path.is_dir()
    return status.st_ino, status.st_mtime_ns, status.st_size
