"""`LiveMap`: a map that answers while other processes change it."""

import logging
import math
import os
import threading
import time
from pathlib import Path

import numpy as np

from evercal.errors import InputError, UnavailableError
from evercal.localization.localizer import Localizer
from evercal.map import Map
from evercal.storage.manifest import MANIFEST, Manifest
from evercal.storage.stages import STAGES

_PROBED = 100
"""Changed scenes that are tried before a state is served; each takes as long as an image."""
_FIRST_PAUSE_S = 1.0
"""Time until a state that could not be served is tried again; it doubles each time."""
_LONGEST_PAUSE_S = 60.0


class LiveMap:
    """The last good state of a map on disk.

    A request takes `localizer` once and answers from it, so that no answer mixes two states. The
    folder may be missing until a first scene is learned. What was there once and is gone is a
    fault, and so is a map that cannot locate its own keyframes.

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
        self._checksums: set[tuple[str, object]] = set()
        self._pause_s = _FIRST_PAUSE_S
        self._again_s = math.inf
        self.current = self._opened()

    @property
    def localizer(self) -> Localizer:
        """The localizer of the last good state, or UnavailableError."""
        try:
            return self.current.localizer
        except InputError as error:
            raise UnavailableError(self.fault or str(error)) from None

    @property
    def status(self) -> str:
        """For /health: `ok`, or what the service lacks."""
        if self.fault is None:
            return "ok"
        if self.current.scenes:
            return "the map cannot be read; its last state is served"
        return "the map cannot be read"

    def refresh(self) -> bool:
        """Open the map again if another process has changed it; True if that was tried.

        A state that cannot be served is logged once, and the last good state stays. It is tried
        again when the manifest changes, and after pauses, because files may arrive one by one.
        """
        with self._lock:
            if _found(self._path) == self._stamp and time.monotonic() < self._again_s:
                return False
            try:
                self.current = self._opened()
                self.fault = None
                self._pause_s = _FIRST_PAUSE_S
                self._again_s = math.inf
            except InputError as error:
                self._again_s = time.monotonic() + self._pause_s
                self._pause_s = min(2 * self._pause_s, _LONGEST_PAUSE_S)
                if self.fault != str(error):
                    self.fault = str(error)
                    log = logging.getLogger(__name__)
                    log.warning("%s; the last state is served", error)
            return True

    def distrust(self) -> None:
        """Open the map again soon, because a file of it could not be read."""
        if self.fault is None:
            self._again_s = 0.0

    def _opened(self) -> Map:
        # Read first: a change while the map is opened is then noticed the next time.
        self._stamp = _found(self._path)
        if len(self._stamp) < self._most_found:
            raise InputError(f"{self._path}: the map is gone; mount or restore it")
        self._most_found = len(self._stamp)
        try:
            manifest = None
            if len(self._stamp) > 1:
                manifest = Manifest.read(self._path)
            opened = Map.open(self._path)
            if manifest is not None and opened.scenes:
                self._probe(opened.localizer, manifest)
        except InputError:
            raise
        except Exception as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise InputError(f"{self._path}: cannot be used ({reason})") from error
        return opened

    def _probe(self, localizer: Localizer, manifest: Manifest) -> None:
        """Locate a keyframe of each scene that is not as it was in the last good state."""
        checksums: set[tuple[str, object]] = {("", manifest.payload.get("short_side"))}
        for file, record in manifest.files.items():
            checksums.add((file, record["sha256"]))
        changed = {file for file, _ in checksums - self._checksums}
        for_all = any(not file.startswith(STAGES) for file in changed)
        folders = {file.split("/")[1] for file in changed if file.startswith(STAGES)}
        scenes = localizer.contents.scenes
        numbers = []
        for number, stage in enumerate(manifest.payload["stages"][: len(scenes)]):
            if for_all or stage in folders:
                numbers.append(number)
        for number in numbers[-_PROBED:]:
            keyframes = scenes[number].keyframes
            alone = localizer.only(number, np.arange(len(keyframes)))
            alone.localize(keyframes.grey(0), keyframes.cameras[0])
        self._checksums = checksums


def _found(path: Path) -> tuple[int, ...]:
    """Changes with the manifest; shorter without one, and empty without a folder."""
    try:
        status = os.stat(path / MANIFEST)
    except OSError:
        return (0,) * path.is_dir()
    return status.st_ino, status.st_mtime_ns, status.st_size
